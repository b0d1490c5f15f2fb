"""Actor, critic and their targets, and the one gradient step of both: the mathematics, of one agent or of several at once.

The networks are small, so the time of an update is its ten 128 x 400 x 300 matrix products plus overhead; ``network``
keeps that small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.optim.adam import adam

from uarm_rl.learn.network import Network

#: An output of the actor beyond this counts as saturated: the slope of its tanh is below 0.02.
_SATURATED: Final = 0.99
#: What is told of an update, in the order of its metrics.
METRICS: Final = ("critic_loss", "actor_loss", "q_min", "q_max", "saturation")


class DivergenceError(ArithmeticError):
    """A number of the training is not finite; the message names it."""


class Rates(NamedTuple):
    """How fast an agent learns: the share of each soft step of its targets, and the step sizes of Adam.

    Over the last part ``annealing`` of the training, a share of it, both step sizes fall linearly to nothing. The slope of the
    critic's loss at an error beyond ``huber`` is that at ``huber``. ``action_l2`` times the sum of an action's squares counts
    against it in the actor's loss.
    """

    tau: float
    actor_lr: float
    critic_lr: float
    annealing: float = 0.0
    huber: float | None = None
    action_l2: float = 0.0


class Tensors(NamedTuple):
    """A mini-batch, or several with their number before these shapes."""

    observation: Tensor  # (n, observation_size)
    action: Tensor  # (n, action_size)
    reward: Tensor  # (n, 1)
    next_observation: Tensor  # (n, observation_size)
    discount: Tensor  # (n, 1)
    weight: Tensor | None  # (n, 1), or all alike


def named(metrics: Tensor) -> dict[str, float]:
    """An update's metrics, shape (5,), by name."""
    return dict(zip(METRICS, metrics.tolist(), strict=True))


class ActorCritic:
    """The networks of one agent; or of as many as there are ``rates``, a row of every tensor for each.

    ``sizes`` are the layers' widths of actor and critic; ``offset`` and ``scale`` those of the observations. Of several, each
    has its own rates and moments, and those with 1 in ``resting``, shape (agents,), stay as they are in an update. If they are
    not ``batched``, those whose number is not in ``working`` are not even computed, and the others have the bytes that they
    would have on their own.
    """

    def __init__(
        self,
        sizes: tuple[Sequence[int], Sequence[int]],
        rates: Rates | list[Rates],
        *,
        offset: Tensor,
        scale: Tensor,
        device: str = "cpu",
        batched: bool = False,
    ) -> None:
        actor, critic = self.sizes = sizes
        lead, each = ((len(rates),), rates) if isinstance(rates, list) else ((), [rates])
        split = Network.size(actor)
        self._offset, self._scale = offset.to(device), scale.to(device)
        self.parameters = torch.zeros((*lead, split + Network.size(critic)), device=device)
        self.target_parameters, self._gradient, self._exp_avg, self._exp_avg_sq = (
            torch.zeros_like(self.parameters) for _ in range(4)
        )
        self._parts = {"actor": slice(None, split), "critic": slice(split, None)}
        self._steps = {name: torch.zeros(lead, device=device) for name in self._parts}
        self.working = list(range(len(each)))
        one_by_one = self.working if lead and not batched else None
        self.actor, self.critic, self.target_actor, self.target_critic = (
            Network(of, parameters[..., part], None if gradient is None else gradient[..., part], one_by_one)
            for parameters, gradient in ((self.parameters, self._gradient), (self.target_parameters, None))
            for of, part in zip(sizes, self._parts.values(), strict=True)
        )
        self.resting = torch.zeros(lead, device=device)
        self._tau = torch.tensor([one.tau for one in each], device=device) if lead else each[0].tau
        # What nobody asks for takes no time.
        self._huber = self._action_l2 = None
        if any(one.huber for one in each):
            self._huber = torch.tensor([one.huber or math.inf for one in each], device=device).view(*lead, 1, 1)
        if any(one.action_l2 for one in each):
            self._action_l2 = torch.tensor([one.action_l2 for one in each], device=device).view(*lead, 1, 1)
        self._each = each
        held = partial(torch.tensor, device=device, dtype=torch.float64 if device == "cpu" else torch.float32)  # as Adam has it
        self._step_sizes = {  # those that change are held where a graph that was recorded finds them
            name: [held(size) if one.annealing else size for one, size in zip(each, usual, strict=True)]
            for name, usual in (("actor", [one.actor_lr for one in each]), ("critic", [one.critic_lr for one in each]))
        }
        self._descents = {
            name: [self._adam(name, row, size) for row, size in zip(np.ndindex(lead), step_sizes, strict=True)]
            for name, step_sizes in self._step_sizes.items()
        }

    def anneal(self, number: int, progress: float) -> None:
        """Give an agent the step sizes that it has after ``progress`` of its training, from 0 to 1."""
        rates = self._each[number]
        for name, usual in (("actor", rates.actor_lr), ("critic", rates.critic_lr)):
            step_size = self._step_sizes[name][number]
            if isinstance(step_size, Tensor):
                step_size.fill_(usual * min(1.0, (1.0 - progress) / rates.annealing))

    def _adam(self, name: str, row: tuple[int, ...], step_size: Tensor | float) -> partial[None]:
        """A step of Adam (Kingma and Ba 2015) for one network of one agent, to be called without arguments."""
        vectors = (self.parameters, self._gradient, self._exp_avg, self._exp_avg_sq)
        parameters, gradient, exp_avg, exp_avg_sq = ([vector[row][self._parts[name]]] for vector in vectors)
        return partial(
            adam,
            params=parameters,
            grads=gradient,
            exp_avgs=exp_avg,
            exp_avg_sqs=exp_avg_sq,
            max_exp_avg_sqs=[],
            state_steps=[self._steps[name][row]],
            fused=True,
            found_inf=self.resting[row] if row else None,  # where this is 1, fused Adam leaves all as it is
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=step_size,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )

    def learn(self, batch: Tensors) -> tuple[Tensor, Tensor]:
        """One gradient step of critic and actor, one soft step of the targets.

        Returns the temporal differences, shape (n, 1), and the metrics, shape (5,), see ``METRICS``: the two losses, the range
        of Q(s, mu(s)) over the batch, and the share of the actor's outputs so close to -1 or 1 that hardly any gradient comes
        back through the tanh.
        """
        # The moments of weights that no longer learn fade into denormal numbers, which are slow. Elsewhere in this
        # process (in the physics) they keep their meaning, so that it computes what it computes in a process of its own.
        torch.set_flush_denormal(True)
        try:
            with torch.no_grad():
                return self._learn(batch)
        finally:
            torch.set_flush_denormal(False)

    def _learn(self, batch: Tensors) -> tuple[Tensor, Tensor]:
        x, next_x = ((raw - self._offset) / self._scale for raw in (batch.observation, batch.next_observation))
        observed, size = x.shape[-1], x.shape[-2]

        # Critic: L = mean (y - Q(s, a))^2 with y = r + discount Q'(s', mu'(s')), or Huber's loss of it (Huber 1964).
        next_action = self.target_actor.forward(next_x).tanh_()
        next_q = self.target_critic.forward(torch.cat((next_x, next_action), -1))
        error = self.critic.forward(torch.cat((x, batch.action), -1)) - (batch.reward + batch.discount * next_q)
        slope = error if self._huber is None else error.clamp(-self._huber, self._huber)
        weighted = slope if batch.weight is None else slope * batch.weight
        self.critic.backward(weighted * (2.0 / size))
        self._descend("critic")

        # Actor: ascend Q(s, mu(s)), the deterministic policy gradient (eq. 3); or that less action_l2 mu(s)^2.
        action = self.actor.forward(x).tanh_()
        q = self.critic.forward(torch.cat((x, action), -1))
        into_action = self.critic.input_gradient(torch.full_like(q, -1.0 / size), observed)
        if self._action_l2 is not None:
            into_action = into_action + action * self._action_l2 * (2.0 / size)
        self.actor.backward(into_action * (1.0 - action * action))
        self._descend("actor")

        self.target_parameters.lerp_(self.parameters, self._pull())
        over = (-2, -1)
        metrics = (
            error.square().mean(over),
            -q.mean(over),
            q.amin(over),
            q.amax(over),
            action.abs().gt_(_SATURATED).mean(over),
        )
        return error, torch.stack(metrics, -1)

    def _descend(self, name: str) -> None:
        for step in self._descents[name]:
            step()

    def _pull(self) -> Tensor | float:
        """The share of the parameters in the targets' soft step, of each agent."""
        return self._tau if isinstance(self._tau, float) else (self._tau * (1.0 - self.resting)).unsqueeze(-1)

    def tensors(self) -> dict[str, Tensor]:
        """Everything an exact resume needs, by name: parameters, targets, both optimisers' moments and steps."""
        tensors = {"parameters": self.parameters, "target_parameters": self.target_parameters}
        for name, part in self._parts.items():
            tensors[f"{name}_step"] = self._steps[name]
            tensors[f"{name}_exp_avg"] = self._exp_avg[..., part]
            tensors[f"{name}_exp_avg_sq"] = self._exp_avg_sq[..., part]
        return tensors
