"""The training loop, and nothing else.

It is a generator that yields what it needs others for: an action, gradient steps. Who drives it may have it done for one
training, or for many side by side (``driver.py``).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import asdict, dataclass
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks
from uarm_rl.learn.actor_critic import DivergenceError
from uarm_rl.learn.learner import Learner

_LARGEST: Final = {"batch_size": 10_000}


@dataclass(frozen=True)
class Schedule:
    """How long a run is and what happens when; the names are those of the configuration."""

    episodes: int
    experiences_per_episode: int
    max_decisions_per_episode: int
    batch_size: int
    warmup_experiences: int
    updates_per_experience: int
    validate_every: int
    checkpoint_every: int

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            checks.integer(name, value, low=0 if name == "warmup_experiences" else 1, high=_LARGEST.get(name))
        checks.integer("max_decisions_per_episode", self.max_decisions_per_episode, low=self.experiences_per_episode)


class Stop:
    """Whether somebody asked the training to stop, and with which signal, if it was one."""

    def __init__(self) -> None:
        self.requested = False
        self.signal = 0


class Act(NamedTuple):
    """Asks for the greedy action, shape (action_size,)."""

    learner: Learner
    observation: NDArray[np.float32]


class Learn(NamedTuple):
    """Asks for as many gradient steps as there are ``updates``, none perhaps; ``progress`` runs from 0 to 1."""

    learner: Learner
    updates: int
    batch_size: int
    progress: float


class Settle(NamedTuple):
    """Asks that the learner's agent and metrics be up to date, and lets others go on."""

    learner: Learner


Request = Act | Learn | Settle
T = TypeVar("T")
Training = Generator[Request, Any, T]


def train(
    learner: Learner,
    schedule: Schedule,
    end_of_decision: Callable[[], None],
    end_of_episode: Callable[[dict[str, object]], Iterable[Request]],
    stop: Stop,
) -> Training[None]:
    """Train until the schedule's last episode, or until a stop is requested: then in the middle of an episode.

    ``updates_per_experience`` gradient steps per stored experience, taken while the arm carries out the next decision. An
    episode ends when its experiences are there; a success, a touched obstacle or a lost object only places a new object.
    ``end_of_episode`` receives the episode's row of the log, and what it asks for is asked for. Raises
    :class:`DivergenceError` when a number is no longer finite.
    """
    env, counters = learner.env, learner.counters
    total = schedule.episodes * schedule.experiences_per_episode
    while counters.episode < schedule.episodes and not stop.requested:
        began = time.perf_counter()
        observation = env.reset(home=True)
        learner.noise.reset()
        episode_return, object_moved_m, successes, object_losses, explosions = 0.0, 0.0, 0, 0, 0
        first_decision, first_experience, first_update = counters.decisions, counters.experiences, counters.updates
        last_decision = first_decision + schedule.max_decisions_per_episode

        while counters.experiences < first_experience + schedule.experiences_per_episode and counters.decisions < last_decision:
            progress = counters.experiences / total
            noise = learner.noise(progress)
            action = np.clip((yield Act(learner, observation)) + noise, -1.0, 1.0, dtype=np.float32)
            env.step_async(action)
            due = schedule.updates_per_experience * (learner.stored - schedule.warmup_experiences)
            yield Learn(learner, max(0, due - counters.updates), schedule.batch_size, progress)
            step = next_observation, reward, terminated, truncated, info = env.step_wait()
            if stop.requested:
                return

            if not (math.isfinite(reward) and np.isfinite(next_observation).all()):
                raise DivergenceError(f"the environment returned reward {reward!r} and observation {next_observation!r}")
            learner.take(observation, action, step)
            counters.decisions += 1
            counters.control_steps += info["control_steps"]
            episode_return += reward
            object_moved_m += info["object_moved_m"]
            successes += info["is_success"]
            object_losses += info["object_lost"]
            explosions += info["exploded"]
            observation = env.reset(home=info["exploded"]) if terminated or truncated else next_observation
            end_of_decision()

        learner.end_chain()
        yield Settle(learner)
        counters.episode += 1
        counters.wall_s += time.perf_counter() - began
        row: dict[str, object] = {
            "episode": counters.episode,
            "experiences": counters.experiences,
            "control_steps": counters.control_steps,
            "updates": counters.updates,
            "admission_rate": (counters.experiences - first_experience) / (counters.decisions - first_decision),
            "episode_return": episode_return,
            "wall_s": round(counters.wall_s, 3),
            "decisions": counters.decisions,
            "successes": successes,
            "object_losses": object_losses,
            "explosions": explosions,
            "object_moved_m": object_moved_m,
        }
        yield from end_of_episode(row | learner.metrics if counters.updates > first_update else row)
