"""What learns in one run, as one thing that can be saved between two episodes and restored."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from uarm_rl import checks
from uarm_rl.learn.admission import Admission
from uarm_rl.learn.async_env import AsyncEnv, Step
from uarm_rl.learn.checkpoint import Checkpoint, CheckpointError
from uarm_rl.learn.ddpg import DDPG
from uarm_rl.learn.hindsight import Hindsight, met_object
from uarm_rl.learn.noise import OrnsteinUhlenbeck
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.learn.returns import Transition
from uarm_rl.task.policy import ActorPolicy
from uarm_rl.task.within import Within

Array = NDArray[np.float32]


@dataclass
class Counters:
    """How far a training is; all of it is in the checkpoint. ``experiences`` are the decisions that were admitted."""

    episode: int = 0
    experiences: int = 0
    decisions: int = 0
    control_steps: int = 0
    updates: int = 0
    wall_s: float = 0.0

    def restore(self, values: dict[str, Any]) -> None:
        """Take over counters as they lie in a checkpoint; :class:`ValueError` if they are none."""
        if checks.mapping("counters", values).keys() != asdict(self).keys():
            raise ValueError(f"it counts {', '.join(values)}")
        for name, value in values.items():
            checks.number(name, value, low=0.0) if name == "wall_s" else checks.integer(name, value, low=0, high=2**62)
            setattr(self, name, value)


@dataclass
class Learner:
    """An environment, the agent that learns in it with the policy that acts for it, and what it learns from.

    ``policy`` is ``agent``'s own actor and follows it. ``metrics`` are those of the last update.
    """

    env: AsyncEnv
    agent: DDPG
    policy: ActorPolicy
    replay: ReplayBuffer
    admission: Admission
    noise: OrnsteinUhlenbeck
    hindsight: Hindsight | None = None
    counters: Counters = field(default_factory=Counters)
    metrics: dict[str, float] = field(default_factory=dict)

    def take(self, observation: Array, action: Array, step: Step) -> None:
        """Take in what came of a decision: it counts as an experience if it may enter, and then its control steps enter too.

        So does what it says of other targets, if the object was not touched in it.
        """
        next_observation, reward, terminated, truncated, info = step
        returns = self.agent.returns
        if not info["exploded"] and self.admission.admits(info["clipped"], info["travel_rad"]):
            whole = Within(observation, action, reward, info["control_steps"])
            self._store(
                returns.add(
                    *(
                        Transition(
                            one.observation,
                            one.action,
                            one.reward,
                            next_observation,
                            0.0 if terminated else returns.discount(one.control_steps),
                        )
                        for one in (whole, *info.get("within", ()))
                    )
                )
            )
            if self.hindsight and not info["is_success"] and not met_object(info):
                discount = 0.0 if terminated else returns.discount(info["control_steps"])
                free = Transition(observation, action, reward, next_observation, discount)
                self._store(self.hindsight.of(free, touched=info["touched"], seen=self.replay.observations))
            self.counters.experiences += 1
        else:
            self.end_chain()
        if truncated:
            self.end_chain()

    def end_chain(self) -> None:
        """What comes next does not follow from what was."""
        self._store(self.agent.returns.cut())

    def _store(self, transitions: Iterable[Transition]) -> None:
        for transition in transitions:
            self.replay.add(transition)

    def update(self, batch_size: int, progress: float) -> None:
        """One gradient step. ``progress`` runs from 0 to 1 over the training."""
        self.metrics = self.agent.update(self.replay.sample(batch_size, progress), progress)
        self.replay.learned(self.agent.errors)
        self.counters.updates += 1

    @property
    def stored(self) -> int:
        """How many experiences can be learned from: those that wait for later rewards not yet."""
        return self.counters.experiences - self.agent.returns.held_back

    def snapshot(self) -> Callable[[], Checkpoint]:
        """A function that gives the checkpoint of now, however much has been stored when it is called.

        Between two episodes the world is built anew, so a run that is resumed there goes on with the same bytes, and a stop
        in the middle of an episode saves what was before it. Small things are copied; of the replay buffer only the rows that
        are overwritten. The function puts those back, so the training cannot go on after it if it has stored more meanwhile.
        """
        agent = {f"agent/{name}": tensor.numpy().copy() for name, tensor in self.agent.tensors().items()}
        replay = self.replay.snapshot()
        state = {
            "counters": asdict(self.counters),
            "replay": self.replay.state(),
            "noise": self.noise.state(),
            "env": self.env.state(),
        }
        return lambda: Checkpoint(
            state["counters"]["episode"], agent | {f"replay/{name}": array for name, array in replay().items()}, state
        )

    def restore(self, saved: Checkpoint) -> None:
        """Go on from a checkpoint. Raises :class:`CheckpointError` if it is not one of such a learner."""
        try:
            saved = self._of_today(saved)
            agent, replay = (
                {name.removeprefix(part): array for name, array in saved.arrays.items() if name.startswith(part)}
                for part in ("agent/", "replay/")
            )
            self.counters.restore(saved.state["counters"])
            if self.counters.episode != saved.episode:
                raise ValueError(f"it holds episode {self.counters.episode}")
            self.agent.load_tensors({name: torch.from_numpy(array) for name, array in agent.items()})
            self.replay.restore(replay, saved.state["replay"])
            self.noise.restore(saved.state["noise"])
            self.env.restore(saved.state["env"])
        except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise CheckpointError(f"the checkpoint does not fit this configuration ({error!r:.200})") from error

    def _of_today(self, saved: Checkpoint) -> Checkpoint:
        """A checkpoint as it is written now. Older ones held terminations, 0 or 1, where the discounts are."""
        if "replay/rows" not in saved.arrays:
            return saved
        rows = saved.arrays["replay/rows"].copy()
        rows[:, -1] = self.agent.returns.gamma * (1.0 - rows[:, -1])
        counters = {**saved.state["counters"], "experiences": saved.state["replay"]["added"]}
        arrays = {name: array for name, array in saved.arrays.items() if name != "replay/rows"}
        return Checkpoint(saved.episode, arrays | {"replay/transitions": rows}, saved.state | {"counters": counters})
