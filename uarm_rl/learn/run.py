"""One training run in its folder: begin or resume, log, validate, checkpoint, finish.

A run's folder holds ``config.yaml``, ``progress.csv``, checkpoints while it trains, and ``policy.safetensors`` once
it has finished: that file is what tells a finished run.
"""

from __future__ import annotations

import math
import multiprocessing
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from uarm_rl import checks, columns, files, locks
from uarm_rl.checks import UsageError
from uarm_rl.csvfile import Logbook
from uarm_rl.files import CONFIG, HOLDER, LOCK, POLICY, PROGRESS
from uarm_rl.learn import checkpoint
from uarm_rl.learn.learner import Counters, Learner
from uarm_rl.learn.loggers import Write, numbers
from uarm_rl.learn.train import Request, Schedule, Settle, Stop, Training, train
from uarm_rl.progress import Bar, progress, say
from uarm_rl.task.policy import Policy

#: An actor with more of its outputs saturated than this has hardly any gradient left to learn from.
SATURATION_LIMIT: Final = 0.9

Settings = Mapping[str, Any]


class RunFolderError(UsageError):
    """The folder cannot take this run; the message is a sentence with the remedy."""


def is_finished(run_dir: Path) -> bool:
    """Whether the folder holds a run that trained to its end."""
    return (run_dir / POLICY).exists()


@contextmanager
def claim(
    run_dir: Path, settings: Settings, read_settings: Callable[[Path], Settings], *, resume: bool, overwrite: bool
) -> Iterator[None]:
    """Make the folder ours for as long as the context lasts, with ``settings`` in it.

    ``read_settings`` gives those of the run that is there. Raises :class:`RunFolderError` when the folder holds a run that
    nobody allowed to continue or overwrite, one with other settings, or one that another process is training.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            stack.enter_context(locks.held(run_dir))
        except locks.LockError as error:
            raise RunFolderError(str(error)) from None
        stack.callback(_unlock_for_good, run_dir)
        others = [path for path in run_dir.iterdir() if path.name not in (LOCK, HOLDER)]
        if others and overwrite:
            for path in others:
                files.remove(path)
        elif others and not resume:
            if is_finished(run_dir):
                raise RunFolderError(
                    f"{run_dir} already holds a finished run; results_dir=FOLDER or name=NAME puts another elsewhere, "
                    "overwrite=true replaces it, and with resume=true a multirun skips it"
                )
            raise RunFolderError(
                f"{run_dir} already holds an unfinished run; resume=true continues it, "
                "results_dir=FOLDER or name=NAME puts another elsewhere"
            )
        elif (run_dir / CONFIG).exists():
            check_same(run_dir, settings, read_settings(run_dir))
        files.replace(run_dir / CONFIG, yaml.safe_dump(dict(settings), sort_keys=False).encode())
        yield


def _unlock_for_good(run_dir: Path) -> None:
    """A run that has finished needs no lock any more; whoever waits for it notices that its file is another."""
    if is_finished(run_dir):
        with suppress(PermissionError):  # Windows keeps a file that is open; filelock itself removes it there
            (run_dir / LOCK).unlink(missing_ok=True)


def check_same(run_dir: Path, settings: Settings, before: Settings) -> None:
    """Raises :class:`RunFolderError` if the run that is there was begun with other settings than these."""
    if changed := checks.differences({key: before.get(key) for key in settings}, settings):
        longer = any(line.startswith("episodes=") for line in changed)
        reason = " (a longer run explores less quickly from its beginning on, so it is another run)" if longer else ""
        raise RunFolderError(
            f"{run_dir} was begun with {', '.join(changed)}; resume it as it was begun, or give this one another place with "
            f"name=NAME{reason}"
        )


def run(
    run_dir: Path,
    learner: Learner,
    schedule: Schedule,
    *,
    validate: Callable[[Policy], Iterator[bool]],
    value_range: tuple[float, float],
    log: AbstractContextManager[Write],
    stop: Stop,
) -> Training[bool]:
    """Train in ``run_dir``, from its last checkpoint if it has one. True when finished, false when told to stop by whoever has
    ``stop`` too.

    ``validate`` tells of one position after the other whether the policy reaches it; it may have begun when it returns, so
    others go on before it is asked. ``value_range`` are the lowest and highest return that the task allows: a critic outside it
    raises a warning. ``log`` is entered to take the rows too.
    """
    counters = learner.counters
    saved = checkpoint.read_latest(run_dir)
    if saved:
        learner.restore(saved)
        print(f"resuming after episode {counters.episode} of {schedule.episodes}")
    snapshot, episode = learner.snapshot(), counters.episode
    on_disk = episode if saved else -1
    with ExitStack() as stack:
        logbook = Logbook(run_dir / PROGRESS, columns.PROGRESS, keep_rows=counters.episode)
        stack.callback(logbook.close)
        write = stack.enter_context(log)
        bar = stack.enter_context(progress_bar(run_dir, schedule, counters))

        def end_of_episode(row: dict[str, object]) -> Iterator[Request]:
            nonlocal snapshot, episode, on_disk
            last = counters.episode == schedule.episodes
            if last or counters.episode % schedule.validate_every == 0:
                outcomes = validate(learner.policy)
                yield Settle(learner)
                reached = list(takewhile(lambda _: not stop.requested, outcomes))
                if stop.requested:
                    return
                row["validation_success_rate"] = float(np.mean(reached))
            row["warning"] = warning(row, value_range)
            logbook.add(row)
            write(numbers(row), counters.experiences)
            bar.show(row)
            snapshot, episode = learner.snapshot(), counters.episode
            if last or episode % schedule.checkpoint_every == 0:
                checkpoint.write(run_dir, snapshot())
                on_disk = episode

        yield from train(learner, schedule, bar.tick, end_of_episode, stop)
        if episode > on_disk:
            checkpoint.write(run_dir, snapshot())
    if episode < schedule.episodes:
        return False
    learner.policy.save(run_dir / POLICY)
    checkpoint.remove(run_dir)
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


class _Bar:
    """What the bar says of an episode: success rate, admission rate, decisions per second, a warning."""

    def __init__(self, bar: Bar, counters: Counters) -> None:
        self._bar = bar
        self._before = (counters.decisions, counters.wall_s)
        self._validation = "not validated yet"
        self._warning = ""
        self._counters = counters

    def tick(self) -> None:
        self._bar.tick()

    def show(self, row: dict[str, object]) -> None:
        if "validation_success_rate" in row:
            self._validation = f"success {row['validation_success_rate']:.0%}"
        if row["warning"] and not self._warning:
            say(f"warning: episode {row['episode']}: {row['warning']}")
        self._warning = str(row["warning"])
        decisions, wall_s = self._before
        rate = (self._counters.decisions - decisions) / max(1e-9, self._counters.wall_s - wall_s)
        alarm = ", WARNING" if self._warning else ""
        self._bar.set_postfix_str(
            f"{self._validation}, admitted {row['admission_rate']:.0%}, {rate:.0f} decisions/s{alarm}",
            refresh=False,
        )
        self._bar.update()


@contextmanager
def progress_bar(run_dir: Path, schedule: Schedule, counters: Counters) -> Iterator[_Bar]:
    """A bar for a run in its folder; ``show`` it each episode's row."""
    label = f"{run_dir.parent.name}/{run_dir.name}"  # several may run side by side
    with progress(schedule.episodes, "episode", label, done=counters.episode, line=_line()) as bar:
        yield _Bar(bar, counters)


def _line() -> int | None:
    """The line of the terminal that a bar takes: beside each other, the processes of a launcher have one each."""
    number = re.search(r"-(\d+)$", multiprocessing.current_process().name)
    return int(number[1]) - 1 if number and sys.stderr.isatty() else None
