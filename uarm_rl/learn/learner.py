"""What learns in one run, as one thing that can be saved between two episodes and restored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import torch

from uarm_rl import checks
from uarm_rl.learn.admission import Admission
from uarm_rl.learn.async_env import AsyncEnv
from uarm_rl.learn.checkpoint import Checkpoint, CheckpointError
from uarm_rl.learn.ddpg import DDPG
from uarm_rl.learn.noise import OrnsteinUhlenbeck
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.task.policy import ActorPolicy


@dataclass
class Counters:
    """How far a training is; all of it is in the checkpoint. ``experiences`` are counted by the replay buffer."""

    episode: int = 0
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

    ``policy`` is ``agent``'s own actor and follows it.
    """

    env: AsyncEnv
    agent: DDPG
    policy: ActorPolicy
    replay: ReplayBuffer
    admission: Admission
    noise: OrnsteinUhlenbeck
    counters: Counters = field(default_factory=Counters)

    def snapshot(self, next_experiences: int) -> Callable[[], Checkpoint]:
        """A function that gives the checkpoint of now, when at most ``next_experiences`` more have been stored.

        Between two episodes the world is built anew, so a run that is resumed there goes on with the same bytes, and a stop
        in the middle of an episode saves what was before it. Small things are copied; of the replay buffer only the rows that
        may be overwritten. The function puts those back, so the training cannot go on after it if it has stored more meanwhile.
        """
        agent = {f"agent/{name}": tensor.numpy().copy() for name, tensor in self.agent.tensors().items()}
        rows = self.replay.rows_before(next_experiences)
        state = {
            "counters": asdict(self.counters),
            "replay": self.replay.state(),
            "noise": self.noise.state(),
            "env": self.env.state(),
        }
        return lambda: Checkpoint(state["counters"]["episode"], agent | {"replay/rows": rows()}, state)

    def restore(self, saved: Checkpoint) -> None:
        """Go on from a checkpoint. Raises :class:`CheckpointError` if it is not one of such a learner."""
        agent = {name.removeprefix("agent/"): array for name, array in saved.arrays.items() if name.startswith("agent/")}
        try:
            self.counters.restore(saved.state["counters"])
            if self.counters.episode != saved.episode:
                raise ValueError(f"it holds episode {self.counters.episode}")
            self.agent.load_tensors({name: torch.from_numpy(array) for name, array in agent.items()})
            self.replay.restore(saved.arrays["replay/rows"], saved.state["replay"])
            self.noise.restore(saved.state["noise"])
            self.env.restore(saved.state["env"])
        except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise CheckpointError(f"the checkpoint does not fit this configuration ({error!r:.200})") from error
