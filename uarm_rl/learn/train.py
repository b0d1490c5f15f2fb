"""The training loop, and nothing else."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any, Final, Protocol

import numpy as np

from uarm_rl.learn.admission import Admission
from uarm_rl.learn.ddpg import DDPG, DivergenceError
from uarm_rl.learn.noise import Noise
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.task.policy import Policy

COLUMNS: Final = (
    "episode",
    "experiences",
    "control_steps",
    "updates",
    "admission_rate",
    "episode_return",
    "critic_loss",
    "actor_loss",
    "validation_success_rate",
    "wall_s",
    "decisions",
    "successes",
    "object_losses",
    "explosions",
    "object_moved_m",
    "q_min",
    "q_max",
    "saturation",
    "warning",
)


class TrainingEnv(Protocol):
    """An environment whose step is in two halves, so that the learner can work while the arm moves."""

    def reset(self, *, home: bool) -> Any: ...
    def send(self, action: Any) -> None: ...
    def receive(self) -> tuple[Any, float, bool, bool, dict[str, Any]]: ...


@dataclass
class Counters:
    """How far a training is; all of it is in the checkpoint. ``experiences`` are counted by the replay buffer."""

    episode: int = 0
    decisions: int = 0
    control_steps: int = 0
    updates: int = 0
    wall_s: float = 0.0


class Stop:
    """Whether somebody asked the training to stop."""

    requested = False


@contextmanager
def stop_on_signals(announce: Callable[[str], None]) -> Iterator[Stop]:
    """Ctrl-C or SIGTERM asks for a stop after the decision in hand; a second Ctrl-C interrupts at once."""
    stop = Stop()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.requested:
            raise KeyboardInterrupt
        stop.requested = True
        announce("stopping and saving; press Ctrl-C again to leave at once")

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def train(
    env: TrainingEnv,
    agent: DDPG,
    policy: Policy,
    replay: ReplayBuffer,
    admission: Admission,
    noise: Noise,
    counters: Counters,
    *,
    episodes: int,
    experiences_per_episode: int,
    max_decisions_per_episode: int,
    warmup_experiences: int,
    batch_size: int,
    end_of_episode: Callable[[dict[str, object]], None],
    stop: Stop,
) -> None:
    """Train until ``counters.episode`` reaches ``episodes``, or a stop is requested: then in the middle of an episode.

    One gradient step per stored experience, taken while the arm carries out the next decision. An episode
    ends after ``experiences_per_episode`` stored experiences; a success or a lost object only places a new object.
    ``end_of_episode`` receives the episode's row of the log.
    """
    total = episodes * experiences_per_episode
    while counters.episode < episodes and not stop.requested:
        began = time.perf_counter()
        observation = env.reset(home=True)
        noise.reset()
        goal = replay.added + experiences_per_episode
        metrics: dict[str, float] = {}
        episode_return, object_moved_m, successes, object_losses, explosions = 0.0, 0.0, 0, 0, 0
        first_decision = counters.decisions
        first_experience = replay.added

        while replay.added < goal and counters.decisions < first_decision + max_decisions_per_episode:
            action = np.clip(policy.act(observation) + noise(replay.added / total), -1.0, 1.0, dtype=np.float32)
            env.send(action)
            while counters.updates < replay.added - warmup_experiences:
                metrics = agent.update(replay.sample(batch_size))
                counters.updates += 1
            next_observation, reward, terminated, truncated, info = env.receive()
            if stop.requested:
                return

            if not (math.isfinite(reward) and np.isfinite(next_observation).all()):
                raise DivergenceError(f"the environment returned reward {reward!r} and observation {next_observation!r}")
            if not info["exploded"] and admission.admits(info["clipped"], info["travel_rad"]):
                replay.add(observation, action, reward, next_observation, terminated)
            counters.decisions += 1
            counters.control_steps += info["control_steps"]
            episode_return += reward
            object_moved_m += info["object_moved_m"]
            successes += terminated
            object_losses += info["object_lost"]
            explosions += info["exploded"]
            observation = env.reset(home=info["exploded"]) if terminated or truncated else next_observation

        counters.episode += 1
        counters.wall_s += time.perf_counter() - began
        row: dict[str, object] = {
            "episode": counters.episode,
            "experiences": replay.added,
            "control_steps": counters.control_steps,
            "updates": counters.updates,
            "admission_rate": (replay.added - first_experience) / (counters.decisions - first_decision),
            "episode_return": episode_return,
            "wall_s": round(counters.wall_s, 3),
            "decisions": counters.decisions,
            "successes": successes,
            "object_losses": object_losses,
            "explosions": explosions,
            "object_moved_m": object_moved_m,
        }
        end_of_episode(row | metrics)
