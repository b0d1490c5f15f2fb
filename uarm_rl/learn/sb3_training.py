"""Training Stable-Baselines3's learners on the same task, in a run's folder as ours.

``uarm-rl train agent=sb3_td3`` is a training like any other, with the same folder, budget, progress and validation, so that
``evaluate`` and ``report`` take its runs for what they are. But the library is in charge of the loop, with its own buffer,
exploration and order of steps: a learner taken apart to fit into our loop would be a third one, which nobody has tested.

What differs therefore: every transition is stored (the admission must be ``all``; the rare one of a world that exploded enters
too), the first ``warmup_experiences`` actions are drawn at random, ``noise`` and ``simulate_beside`` are not used, and an
interrupted run begins anew: with the same seed it comes to the same end.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback

from uarm_rl import checks, columns
from uarm_rl.csvfile import Logbook
from uarm_rl.files import POLICY, PROGRESS
from uarm_rl.learn.actor_critic import DivergenceError
from uarm_rl.learn.learner import Counters
from uarm_rl.learn.loggers import Write, numbers
from uarm_rl.learn.run import progress_bar
from uarm_rl.learn.sb3 import Hindsight, SoftActorCritic, TwinDelayed, from_sb3
from uarm_rl.learn.train import Schedule, Stop
from uarm_rl.task import observation
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.policy import ActorPolicy, PolicyCard

Array = NDArray[np.float32]

#: What an episode's row adds up: name in the environment's ``info``, column.
_SUMS: Final = {
    "control_steps": "control_steps",
    "object_moved_m": "object_moved_m",
    "object_lost": "object_losses",
    "exploded": "explosions",
}


def _scaled(raw: Array) -> Array:
    scaled: Array = (raw - observation.OFFSET) / observation.SCALE
    return scaled


class TrainingEpisodes(gymnasium.Wrapper[Any, Any, Any, Any]):
    """The environment as our own loop uses it: observations scaled; an episode of so many decisions begins at home, and after a
    success or a lost object goes on from where the arm is. ``sums`` adds up what the log tells of an episode.
    """

    def __init__(self, env: UArmSuctionEnv, decisions: int) -> None:
        super().__init__(env)
        self._decisions = decisions
        self._left = decisions
        self._home = True
        self.sums: dict[str, float] = {}
        self.begin_row()

    def begin_row(self) -> None:
        """Add up from nothing."""
        self.sums = dict.fromkeys(("episode_return", "successes", *_SUMS.values()), 0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        raw, info = self.env.reset(seed=seed, options={"home": self._home})
        self._home = False
        return _scaled(raw), info

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        raw, reward, terminated, truncated, info = self.env.step(action)
        if not (math.isfinite(float(reward)) and np.isfinite(raw).all()):
            raise DivergenceError(f"the environment returned reward {reward!r} and observation {raw!r}")
        self.sums["episode_return"] += float(reward)
        self.sums["successes"] += info["is_success"]
        for name, column in _SUMS.items():
            self.sums[column] += info[name]
        self._left -= 1
        if not self._left or info["exploded"]:
            self._home = True
        if not self._left:
            self._left, truncated = self._decisions, not terminated
        return _scaled(raw), float(reward), terminated, truncated, info


class _Log(BaseCallback):
    """Hears of every decision, and makes the row of every episode."""

    def __init__(self, env: TrainingEpisodes, schedule: Schedule, counters: Counters, stop: Stop) -> None:
        super().__init__()
        self._episodes, self._schedule, self._count, self._stop = env, schedule, counters, stop
        self.end_of_episode: Callable[[dict[str, object]], None] = lambda row: None
        self.end_of_decision: Callable[[], None] = lambda: None
        self._began = time.perf_counter()

    def _on_step(self) -> bool:
        counters = self._count
        if self._stop.requested:
            return False
        self.end_of_decision()
        if self.num_timesteps % self._schedule.experiences_per_episode:
            return True
        sums = self._episodes.sums
        counters.episode += 1
        counters.experiences = counters.decisions = self.num_timesteps
        counters.control_steps += int(sums.pop("control_steps"))
        counters.updates = self.model._n_updates
        counters.wall_s += time.perf_counter() - self._began
        losses = {name: self.logger.name_to_value.get(f"train/{name}") for name in ("critic_loss", "actor_loss")}
        row: dict[str, object] = {
            "episode": counters.episode,
            "experiences": counters.experiences,
            "decisions": counters.decisions,
            "control_steps": counters.control_steps,
            "updates": counters.updates,
            "admission_rate": 1.0,
            "wall_s": round(counters.wall_s, 3),
            "warning": "",
            **sums,
            **{name: float(loss) for name, loss in losses.items() if loss is not None},
        }
        if not all(math.isfinite(value) for value in row.values() if isinstance(value, float)):
            raise DivergenceError(f"training diverged: episode {counters.episode} has {row}")
        self.end_of_episode(row)
        self._episodes.begin_row()
        self._began = time.perf_counter()
        return not self._stop.requested


def run(
    run_dir: Path,
    agent: TwinDelayed | SoftActorCritic | Hindsight,
    env: UArmSuctionEnv,
    schedule: Schedule,
    *,
    seed: int,
    capacity: int,
    card: PolicyCard,
    validate: Callable[[ActorPolicy], Iterator[bool]],
    log: AbstractContextManager[Write],
    stop: Stop,
) -> bool:
    """Train in ``run_dir``, from the beginning. True when finished, false when told to stop.

    ``validate`` tells of one position after the other whether the policy reaches it; ``log`` is entered to take the rows too.
    Raises :class:`DivergenceError` when a number is no longer finite.
    """
    episodes = TrainingEpisodes(env, schedule.experiences_per_episode)
    model = agent.model(episodes, schedule, seed=seed, capacity=capacity, tolerance_m=card.tolerance_m)
    counters = Counters()
    with ExitStack() as stack:
        logbook = Logbook(run_dir / PROGRESS, columns.PROGRESS)
        stack.callback(logbook.close)
        write = stack.enter_context(log)
        bar = stack.enter_context(progress_bar(run_dir, schedule, counters))

        def end_of_episode(row: dict[str, object]) -> None:
            if counters.episode == schedule.episodes or counters.episode % schedule.validate_every == 0:
                reached = [one for one in validate(from_sb3(model, card)) if not stop.requested]
                row["validation_success_rate"] = float(np.mean(reached)) if reached else 0.0
            logbook.add(row)
            write(numbers(row), counters.experiences)
            bar.show(row)

        hears = _Log(episodes, schedule, counters, stop)
        hears.end_of_episode, hears.end_of_decision = end_of_episode, bar.tick
        model.learn(schedule.episodes * schedule.experiences_per_episode, hears, log_interval=None)  # type: ignore[arg-type]
    if stop.requested:
        return False
    from_sb3(model, card).save(run_dir / POLICY)
    return True


def check_settings(buffer: Mapping[str, Any], agent: str) -> None:
    """Raises :class:`ValueError` with a sentence for a buffer that the library's own cannot be."""
    for group, only in (("admission", "all"), ("sampling", "uniform")):
        name = checks.mapping(f"buffer.{group}", buffer[group]).get("name")
        if name != only:
            raise ValueError(
                f"agent={agent} has a buffer of its own, with {group} {only}, not {name}; take buffer=uniform, fixed_hold or "
                "steady_only"
            )
