"""Several learners side by side on one device: their parameters stacked, their products batched, on a GPU in one graph.

Nothing is computed here that ``actor_critic`` does not: this is where the numbers lie. A learner is on the host, where it
acts, validates and is saved; what it learns in a stack is its own again when it is settled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from uarm_rl.learn.actor_critic import METRICS, ActorCritic, Tensors, named
from uarm_rl.learn.learner import Learner
from uarm_rl.learn.network import Network
from uarm_rl.task.policy import ActorPolicy

Array = NDArray[np.float32]

#: So often is work carried out before it is recorded: libraries choose their kernels and memory at first.
_WARM_UPS: Final = 3


class Stack(ActorCritic):
    """The networks and replay buffers of learners whose networks have the same shapes; all batches are of one size.

    ``batched``, as on a GPU, all are computed in one go, and differ from learners on their own in their last bits; else they do
    not. As long as it is in use, the learners are advanced by it alone.
    """

    def __init__(self, learners: Sequence[Learner], batch_size: int, device: str, *, batched: bool) -> None:
        self.learners = list(learners)
        agents, buffers = [one.agent for one in learners], [one.replay for one in learners]
        kinds = [agent.observation for agent in agents]
        super().__init__(
            agents[0].sizes,
            [agent.rates for agent in agents],
            offset=torch.tensor(np.stack([kind.offset for kind in kinds])).unsqueeze(1),
            scale=torch.tensor(np.stack([kind.scale for kind in kinds])).unsqueeze(1),
            device=device,
            batched=batched,
        )
        for name, tensor in self.tensors().items():
            tensor.copy_(torch.stack([agent.tensors()[name] for agent in agents]))
        capacities = [buffer.capacity for buffer in buffers]
        self._fields = buffers[0].fields
        self._first = np.cumsum([0, *capacities[:-1]])  # each one's place in the ring of all
        self._followed = [0] * len(buffers)  # how many of each one's transitions are there
        self._ring = torch.zeros((sum(capacities), buffers[0].rows.shape[1]), device=device)
        size = (len(buffers), batch_size)
        self._drawn = torch.zeros(size, dtype=torch.int64, device=device)
        self._weight = torch.ones((*size, 1), device=device)
        self._observation = torch.zeros((len(buffers), 1, kinds[0].size), device=device)
        self._actor = Network(self.sizes[0], self.parameters[..., self._parts["actor"]])  # with memory of its own
        self._policies = [] if batched else [self._policy(number) for number in range(len(buffers))]
        self._metrics = torch.zeros((len(buffers), len(METRICS)), device=device)  # of each one's last update
        self._action = torch.zeros((len(buffers), 1, self.sizes[0][-1]), device=device)
        self._updated: set[int] = set()
        self.resting.fill_(1.0)  # so that what warms up changes nothing
        recorded = (self._update_all, self._act_for_all) if device.startswith("cuda") else ()
        self._graphs = {work.__name__: _graph(work) for work in recorded}

    def _policy(self, number: int) -> ActorPolicy:
        """A learner's policy on its row here."""
        own = self.learners[number].policy
        layers = [(weight[number].numpy(), bias[number].numpy()) for weight, bias in self.actor.layers]
        return ActorPolicy(layers, offset=own.offset, scale=own.scale, card=own.card)

    def act(self, observations: Mapping[int, Array]) -> dict[int, Array]:
        """The greedy action, shape (action_size,), for the observation of each of some."""
        if self._policies:
            return {number: self._policies[number].act(observation) for number, observation in observations.items()}
        given = torch.zeros(self._observation.shape)
        for number, observation in observations.items():
            given[number, 0] = torch.from_numpy(observation)
        self._observation.copy_(given)
        self._carry_out(self._act_for_all)
        actions = self._action.numpy(force=True)
        return {number: actions[number, 0] for number in observations}

    def update(self, progress: Mapping[int, float]) -> None:
        """One gradient step for some, whose ``progress`` runs from 0 to 1 over their training; the others rest."""
        drawn = torch.zeros(self._drawn.shape, dtype=torch.int64)
        weight, resting = torch.ones(self._weight.shape), torch.ones(self.resting.shape)
        by_priority = []
        for number, how_far in progress.items():
            places, weights = self.learners[number].replay.draw(drawn.shape[1], how_far)
            drawn[number] = torch.from_numpy(places + self._first[number])
            if weights is not None:
                by_priority.append(number)
                weight[number] = torch.from_numpy(weights)
            resting[number] = 0.0
            self.anneal(number, how_far)
        self._follow(progress)
        for there, here in ((self._drawn, drawn), (self._weight, weight), (self.resting, resting)):
            there.copy_(here)
        self.working[:] = progress
        self._carry_out(self._update_all)
        self._updated |= progress.keys()
        for number in progress:
            self.learners[number].counters.updates += 1
        if by_priority:  # their next draw needs the errors of this one; the others wait for nothing
            errors = self._errors.numpy(force=True)
            for number in by_priority:
                self.learners[number].replay.learned(errors[number])

    def settle(self, number: int) -> None:
        """Bring a learner's agent, and the metrics of its last update, up to date.

        Raises :class:`DivergenceError` when a number is no longer finite.
        """
        learner = self.learners[number]
        learner.agent.load_tensors({name: tensor[number].cpu() for name, tensor in self.tensors().items()})
        learner.agent.check(self._metrics[number])
        learner.agent.check(learner.agent.parameters)
        if number in self._updated:
            learner.metrics = named(self._metrics[number])

    def _carry_out(self, work: Callable[[], None]) -> None:
        graph = self._graphs.get(work.__name__)
        graph.replay() if graph else work()

    def _update_all(self) -> None:
        rows = self._ring[self._drawn]
        self._errors, metrics = self.learn(Tensors._make((*(rows[..., field] for field in self._fields), self._weight)))
        self._metrics.copy_(torch.where(self.resting.unsqueeze(-1) > 0.0, self._metrics, metrics))

    def _act_for_all(self) -> None:
        with torch.no_grad():
            self._action = self._actor.forward((self._observation - self._offset) / self._scale).tanh_()

    def _follow(self, numbers: Mapping[int, float]) -> None:
        """Copy into the ring what has been stored since."""
        places, rows = [], []
        for number in numbers:
            replay = self.learners[number].replay
            new = np.arange(max(self._followed[number], replay.added - replay.capacity), replay.added) % replay.capacity
            places.append(new + self._first[number])
            rows.append(replay.rows[new])
            self._followed[number] = replay.added
        where = torch.from_numpy(np.concatenate(places)).to(self._ring.device)
        self._ring.index_copy_(0, where, torch.from_numpy(np.concatenate(rows)).to(self._ring.device))


def _graph(work: Callable[[], None]) -> torch.cuda.CUDAGraph:
    """``work``, which reads and writes the same memory every time, as one graph that a GPU is given at once.

    It is carried out a few times before. https://docs.pytorch.org/docs/stable/notes/cuda.html#cuda-graphs
    """
    beside = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    beside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(beside):
        for _ in range(_WARM_UPS):
            work()
    torch.cuda.current_stream().wait_stream(beside)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        work()
    return graph
