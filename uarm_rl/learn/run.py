"""One training run in its folder: begin or resume, log, validate, checkpoint, finish.

A run's folder holds ``config.yaml``, ``progress.csv``, checkpoints while it trains, and ``policy.safetensors`` once
it has finished: that file is what tells a finished run.
"""

from __future__ import annotations

import fcntl
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import torch

from uarm_rl import checks, files
from uarm_rl.csvfile import Logbook
from uarm_rl.learn import checkpoint
from uarm_rl.learn.admission import Admission
from uarm_rl.learn.async_env import InlineEnv, SubprocessEnv
from uarm_rl.learn.ddpg import DDPG
from uarm_rl.learn.noise import Noise
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.learn.train import COLUMNS, Counters, stop_on_signals, train
from uarm_rl.task import observation
from uarm_rl.task.env import ACTION_SIZE, UArmSuctionEnv
from uarm_rl.task.policy import FILE, ActorPolicy, Policy

CONFIG: Final = "config.yaml"
PROGRESS: Final = "progress.csv"

_LARGEST: Final = {"batch_size": 100_000}

#: An actor with more of its outputs saturated than this has hardly any gradient left to learn from.
SATURATION_LIMIT: Final = 0.9


class RunFolderError(Exception):
    """The folder cannot take this run; the message is a sentence with the remedy."""


def is_finished(run_dir: Path) -> bool:
    """Whether the folder holds a run that trained to its end."""
    return (run_dir / FILE).exists()


@contextmanager
def claim(run_dir: Path, config_text: str, *, resume: bool, overwrite: bool) -> Iterator[None]:
    """Make the folder ours for as long as the context lasts, with ``config_text`` in it.

    Raises :class:`RunFolderError` when it holds another run that nobody allowed to continue or overwrite, a run with another
    configuration, or one that another process is training.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    with _open_lock(run_dir / ".lock") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunFolderError(f"another process is training in {run_dir}; wait for it or choose another name") from None
        others = [path for path in run_dir.iterdir() if path.name != ".lock"]
        if others and overwrite:
            for path in others:
                files.remove(path)
        elif others and not resume:
            state = "a finished" if is_finished(run_dir) else "an unfinished"
            raise RunFolderError(
                f"{run_dir} already holds {state} run; resume=true continues or keeps it, overwrite=true deletes it, "
                "name=NAME or seed=N makes another"
            )
        elif others and (run_dir / CONFIG).exists() and files.read(run_dir / CONFIG) != config_text.encode():
            raise RunFolderError(
                f"{run_dir} was begun with another configuration (compare its {CONFIG}); resume it with the same one, "
                "or choose another name"
            )
        files.replace(run_dir / CONFIG, config_text.encode())
        yield


def _open_lock(path: Path) -> IO[bytes]:
    """The file that is locked; it stays empty, and a link or a pipe in its place is refused."""
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise RunFolderError(f"{path} is no plain file; remove it, or choose another name")
    return open(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666), "rb")


@dataclass(frozen=True)
class Schedule:
    """How long a run is and what happens when; the names are those of the configuration."""

    episodes: int
    experiences_per_episode: int
    max_decisions_per_episode: int
    batch_size: int
    warmup_experiences: int
    validate_every: int
    checkpoint_every: int

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            checks.integer(name, value, low=0 if name == "warmup_experiences" else 1, high=_LARGEST.get(name))
        checks.integer("max_decisions_per_episode", self.max_decisions_per_episode, low=self.experiences_per_episode)


def estimate_s(schedule: Schedule, agent: DDPG, env: UArmSuctionEnv, *, beside: bool) -> float:
    """How long the whole schedule will take (s), from a short trial of updates and decisions.

    ``agent`` and ``env`` are spare ones: the trial changes them. Validations are not counted.
    """
    rows = np.zeros((schedule.batch_size, 2 * observation.SIZE + ACTION_SIZE + 2), np.float32)
    replay = ReplayBuffer(
        len(rows), observation_size=observation.SIZE, action_size=ACTION_SIZE, generator=np.random.default_rng(0)
    )
    replay.rows[:], replay.added = rows, len(rows)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (20, ACTION_SIZE)).astype(np.float32)
    update_s = _median_time_s(lambda _: agent.update(replay.sample(schedule.batch_size)), range(20))
    decision_s = _median_time_s(env.step, actions)
    per_decision_s = max(update_s, decision_s) if beside else update_s + decision_s
    return schedule.episodes * schedule.experiences_per_episode * per_decision_s


def _median_time_s(work: Callable[[Any], object], arguments: Iterable[Any]) -> float:
    times = []
    for argument in arguments:
        begin = time.perf_counter()
        work(argument)
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def run(
    run_dir: Path,
    env: InlineEnv | SubprocessEnv,
    agent: DDPG,
    policy: ActorPolicy,
    replay: ReplayBuffer,
    admission: Admission,
    noise: Noise,
    schedule: Schedule,
    *,
    value_range: tuple[float, float],
    validate: Callable[[Policy], Iterator[bool]],
    tensorboard: bool,
    say: Callable[[str], None],
) -> bool:
    """Train in ``run_dir``, from its last checkpoint if it has one. True when finished, false when told to stop.

    ``validate`` tells of one position after the other whether the policy reaches it. ``value_range`` are the lowest and
    highest return that the task allows: a critic outside it raises a warning.
    """
    counters = Counters()
    saved = checkpoint.read_latest(run_dir)
    if saved:
        _restore(saved, env, agent, replay, noise, counters)
        say(f"resuming after episode {counters.episode} of {schedule.episodes}")
    take_snapshot = partial(
        Snapshot, env, agent, replay, noise, counters, experiences_per_episode=schedule.experiences_per_episode
    )
    snapshot = take_snapshot()
    on_disk = counters.episode if saved else -1
    with ExitStack() as stack:
        log = Logbook(run_dir / PROGRESS, COLUMNS, keep_rows=counters.episode)
        stack.callback(log.close)
        write_scalars = stack.enter_context(_tensorboard(run_dir)) if tensorboard else None
        bar = stack.enter_context(_progress_bar(schedule, counters))
        stop = stack.enter_context(stop_on_signals(bar.write))

        def end_of_episode(row: dict[str, object]) -> None:
            nonlocal snapshot, on_disk
            last = counters.episode == schedule.episodes
            if last or counters.episode % schedule.validate_every == 0:
                reached = list(takewhile(lambda _: not stop.requested, validate(policy)))
                if stop.requested:
                    return
                row["validation_success_rate"] = float(np.mean(reached))
            row["warning"] = warning(row, value_range)
            log.add(row)
            if write_scalars:
                write_scalars(row)
            bar.show(row)
            snapshot = take_snapshot()
            if last or counters.episode % schedule.checkpoint_every == 0:
                snapshot.write(run_dir)
                on_disk = snapshot.episode

        train(
            env,
            agent,
            policy,
            replay,
            admission,
            noise,
            counters,
            episodes=schedule.episodes,
            experiences_per_episode=schedule.experiences_per_episode,
            max_decisions_per_episode=schedule.max_decisions_per_episode,
            warmup_experiences=schedule.warmup_experiences,
            batch_size=schedule.batch_size,
            end_of_episode=end_of_episode,
            stop=stop,
        )
        if snapshot.episode > on_disk:
            snapshot.write(run_dir)
    if snapshot.episode < schedule.episodes:
        return False
    policy.save(run_dir / FILE)
    return True


def warning(row: Mapping[str, object], value_range: tuple[float, float]) -> str:
    """What an episode's row of the log says of a training that goes wrong without failing; empty if nothing."""
    lowest, highest = value_range
    metrics = {name: row.get(name) for name in ("q_min", "q_max", "saturation")}
    q_min, q_max, saturation = (value if isinstance(value, float) else math.nan for value in metrics.values())
    problems = []
    if q_min < lowest or q_max > highest:
        problems.append(f"critic in [{q_min:.4g}, {q_max:.4g}], possible is [{lowest:.4g}, {highest:.4g}]")
    if saturation > SATURATION_LIMIT:
        problems.append(f"actor saturated in {saturation:.0%} of its outputs")
    return "; ".join(problems)


class Snapshot:
    """The whole training as it stood between two episodes.

    A stop in the middle of an episode saves the snapshot taken before it: the world is built anew there, so a resumed run
    goes on with the same bytes. Small things are copied; of the replay buffer only the rows that the next episode may
    overwrite.
    """

    def __init__(
        self,
        env: InlineEnv | SubprocessEnv,
        agent: DDPG,
        replay: ReplayBuffer,
        noise: Noise,
        counters: Counters,
        *,
        experiences_per_episode: int,
    ) -> None:
        self.episode = counters.episode
        self._agent = {f"agent/{name}": tensor.numpy().copy() for name, tensor in agent.tensors().items()}
        self._replay = replay
        self._length = len(replay)
        self._next_rows = np.arange(replay.added, replay.added + experiences_per_episode) % replay.capacity
        self._overwritten = replay.rows[self._next_rows]
        self._state = {
            "counters": asdict(counters),
            "replay": {"added": replay.added, "generator": replay.generator.bit_generator.state},
            "noise": {"state": noise.state.tolist(), "generator": noise.generator.bit_generator.state},
            "env": {"generator": env.generator_state()},
        }

    def write(self, run_dir: Path) -> None:
        """Save it as a checkpoint. The training cannot go on behind it if it has begun the next episode."""
        self._replay.rows[self._next_rows] = self._overwritten
        checkpoint.write(run_dir, self.episode, self._agent | {"replay/rows": self._replay.rows[: self._length]}, self._state)


def _restore(
    saved: tuple[int, checkpoint.Arrays, dict[str, Any]],
    env: InlineEnv | SubprocessEnv,
    agent: DDPG,
    replay: ReplayBuffer,
    noise: Noise,
    counters: Counters,
) -> None:
    episode, arrays, state = saved
    try:
        values = checks.mapping("counters", state["counters"])
        if values.keys() != asdict(counters).keys():
            raise ValueError(f"it counts {', '.join(values)}")
        for name, value in values.items():
            checks.number(name, value, low=0.0) if name == "wall_s" else checks.integer(name, value, low=0, high=2**62)
        added, rows = checks.integer("replay.added", state["replay"]["added"], low=0, high=2**62), arrays["replay/rows"]
        expected = (min(added, replay.capacity), replay.rows.shape[1])
        if values["episode"] != episode or rows.shape != expected or rows.dtype != np.float32:
            raise ValueError(f"it holds episode {values['episode']} and rows of shape {rows.shape}, not {expected}")
        noise_state = np.array(state["noise"]["state"], np.float64)
        if noise_state.shape != noise.state.shape or not np.isfinite(noise_state).all():
            raise ValueError("the state of its noise is none")
        agent.load_tensors(
            {
                name.removeprefix("agent/"): torch.from_numpy(array)
                for name, array in arrays.items()
                if name.startswith("agent/")
            }
        )
        if any(state[part]["generator"]["has_uint32"] not in (0, 1) for part in ("replay", "noise", "env")):
            raise ValueError("the state of a generator is none")  # numpy would take it
        replay.generator.bit_generator.state = state["replay"]["generator"]
        noise.generator.bit_generator.state = state["noise"]["generator"]
        env.set_generator_state(state["env"]["generator"])
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise checkpoint.CheckpointError(f"the checkpoint does not fit this configuration ({error!r:.200})") from error
    replay.rows[: len(rows)] = rows
    replay.added = added
    noise.state = noise_state
    for name, value in values.items():
        setattr(counters, name, value)


class _Bar:
    """The progress bar: episode, success rate, admission rate, decisions per second, time left."""

    def __init__(self, bar: Any, counters: Counters) -> None:
        self._bar = bar
        self._before = (counters.decisions, counters.wall_s)
        self._validation = "-"
        self._warning = ""
        self._counters = counters

    def write(self, text: str) -> None:
        self._bar.write(text, file=sys.stderr)

    def show(self, row: dict[str, object]) -> None:
        if "validation_success_rate" in row:
            self._validation = f"{row['validation_success_rate']:.0%}"
        if row["warning"] and not self._warning:
            self.write(f"warning: episode {row['episode']}: {row['warning']}")
        self._warning = str(row["warning"])
        decisions, wall_s = self._before
        rate = (self._counters.decisions - decisions) / max(1e-9, self._counters.wall_s - wall_s)
        alarm = ", WARNING" if self._warning else ""
        self._bar.set_postfix_str(
            f"success {self._validation}, admitted {row['admission_rate']:.0%}, {rate:.0f} decisions/s{alarm}",
            refresh=False,
        )
        self._bar.update()


@contextmanager
def _progress_bar(schedule: Schedule, counters: Counters) -> Iterator[_Bar]:
    from tqdm import tqdm

    with tqdm(
        total=schedule.episodes, initial=counters.episode, unit="episode", dynamic_ncols=True, mininterval=0.5, smoothing=0.1
    ) as bar:
        yield _Bar(bar, counters)


@contextmanager
def _tensorboard(run_dir: Path) -> Iterator[Callable[[dict[str, object]], None]]:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise RunFolderError("tensorboard=true needs the extra: pip install 'uarm-rl[tensorboard]'") from None
    if (run_dir / "tensorboard").is_symlink():
        raise RunFolderError(f"{run_dir / 'tensorboard'} is a link; remove it, or leave tensorboard=true out")
    with SummaryWriter(run_dir / "tensorboard") as writer:

        def write(row: dict[str, object]) -> None:
            for name, value in row.items():
                if isinstance(value, (int, float)):
                    writer.add_scalar(name, value, row["experiences"])

        yield write
