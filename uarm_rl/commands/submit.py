"""Train many policies on a SLURM cluster, as train -m does here, and return at once.

Examples:
  uarm-rl submit experiment=A,B,C,D seed=0,1,2 cluster.partition=short   twelve jobs of one core each
  uarm-rl submit experiment=servo seed=0,1,2 cluster.minutes=30          a job that needs longer goes on in the next 30 minutes
  uarm-rl submit experiment=C seed=0,1,2,3 cluster.name=local            processes of this machine, one a core
  uarm-rl status                                                         how far they are, and what continues those that died
"""

from __future__ import annotations

import io
import os
import platform
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from uarm_rl import checks, locks, workers
from uarm_rl.checks import UsageError, command
from uarm_rl.commands import submitted
from uarm_rl.commands.errors import explain, printable
from uarm_rl.configuration import Settings
from uarm_rl.files import POLICY

#: How long a task waits for a folder that another still holds (s): a lock of a machine that has died ends after minutes.
_PATIENCE_S: Final = 300.0
#: How often a run may come to the end of its job's time and go on in another.
_SLICES: Final = 100
#: What a process of this machine has.
_EVER_MINUTES: Final = 60 * 24 * 365


class ClusterError(Exception):
    """A cluster that does not take the runs; the message is a sentence."""


class Task:
    """What one job does: its runs, one after the other, each from its last checkpoint. A stop saves, and queues it anew."""

    def __init__(self, runs: Sequence[Settings]) -> None:
        self.runs = list(runs)

    def __call__(self) -> None:
        from uarm_rl.commands import train

        failures = 0
        for settings in self.runs:
            until = time.monotonic() + _PATIENCE_S
            while locks.holder(train.output(settings)) and time.monotonic() < until:
                time.sleep(5.0)
            try:
                train.run(settings)
            except SystemExit as stop:
                if stop.code == 130:
                    _queue_anew()
                raise
            except Exception as error:
                if type(error).__module__.startswith("submitit"):  # its own, for what it does not queue anew
                    raise
                print(f"failed: {train.output(settings)}: {printable(explain(error)[0])}", file=sys.stderr, flush=True)
                failures += 1
        if failures:
            raise SystemExit(1)

    def checkpoint(self) -> Any:
        """What the job is when it is queued anew: the same, since all it needs is in the folders of its runs."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def _queue_anew() -> None:
    """Have submitit put this job back, unless somebody has cancelled it or the queue does so itself."""
    import submitit

    job = submitit.JobEnvironment()
    if job.cluster == "slurm" and submitted.state_of(job.job_id) not in ("RUNNING", ""):
        return
    signal.raise_signal(getattr(signal, f"SIG{job.USR_SIG}"))


def launch(jobs: Sequence[Settings], words: Sequence[str]) -> None:
    """Submit a training for each of the settings; ``words`` are those that were typed."""
    cluster = _checked(jobs[0]["cluster"])
    for key in ("cluster", "results_dir"):
        if any(job[key] != jobs[0][key] for job in jobs):
            raise UsageError(f"{key} says where all runs go; give it one value")
    if ours := [word for word in words if word.startswith("hydra")]:
        raise UsageError(f"submit takes no {ours[0]}; cluster.name=local or slurm says what launches the runs")
    if not find_spec("submitit"):
        raise UsageError(f"submit needs an extra; {checks.how_to_add('slurm')}")
    from uarm_rl.commands import train

    runs = [_as_run(job) for job in jobs]
    for one in {repr(job | {"seed": 0, "name": ""}): job for job in runs}.values():
        train.check(one)
    checks.shell_path("results_dir", runs[0]["results_dir"])
    results_dir = Path(jobs[0]["results_dir"])
    runs = _that_are_needed(runs, results_dir)
    if not runs:
        return
    listed = _new_list(results_dir)
    folders = [train.output(run).relative_to(run["results_dir"]) for run in runs]
    entries = [submitted.Entry(folder.as_posix(), "", shlex.join(words)) for folder in folders]
    submitted.write(listed, entries)
    try:
        names = _submit(runs, cluster, listed.with_suffix(""))
    except ClusterError as error:
        raise ClusterError(f"{error}; nothing is lost: {listed} has the runs, and the same command submits them") from None
    submitted.write(listed, [entry._replace(job=job) for entry, job in zip(entries, names, strict=True)])
    print(f"submitted: {len(runs)} runs, listed in {listed}; what they say is in {listed.with_suffix('')}")
    print(f"follow them with: {command(results_dir, 'status').strip('`')}")


def output(settings: Settings) -> Path:
    """The run's folder."""
    from uarm_rl.commands import train

    return train.output(settings)


def _as_run(job: Settings) -> Settings:
    """The settings of ``uarm-rl train``, to be carried out by a job."""
    if job["overwrite"]:
        raise UsageError(
            "submit never deletes a run; take a name=NAME or results_dir=FOLDER of its own instead of overwrite=true"
        )
    kept = {key: value for key, value in job.items() if key != "cluster"}
    return kept | {"resume": True, "simulate_beside": False, "results_dir": str(Path(job["results_dir"]).absolute())}


def _checked(cluster: Mapping[str, Any]) -> Mapping[str, Any]:
    checks.one_of("cluster.name", cluster["name"], ("slurm", "local"))
    for key in ("partition", "account", "qos"):
        if cluster[key] is not None and not re.fullmatch(r"[\w.,-]+", checks.text(f"cluster.{key}", cluster[key])):
            raise ValueError(f"cluster.{key} must be a name, got {cluster[key]!r:.60}")
    for key, most in (("minutes", 60 * 24 * 365), ("cores", 1024), ("at_once", 100_000)):
        if cluster[key] is not None or key != "at_once":
            checks.integer(f"cluster.{key}", cluster[key], low=1, high=most)
    checks.number("cluster.gigabytes", cluster["gigabytes"], low=0.1, high=10_000.0)
    return cluster


def _that_are_needed(runs: Sequence[Settings], results_dir: Path) -> list[Settings]:
    """Those that are neither finished, nor being trained, nor on their way."""
    from uarm_rl.commands import train

    entries = [entry for of in submitted.lists(results_dir).values() for entry in of]
    known = submitted.words_of_jobs([entry.job for entry in entries])
    queued = {results_dir.absolute() / entry.folder for entry in entries if known.get(entry.job) in ("waiting", "running")}
    left: dict[str, int] = {}
    needed = []
    for run in runs:
        folder = train.output(run)
        if (folder / POLICY).exists():
            left["finished"] = left.get("finished", 0) + 1
        elif folder in queued or locks.holder(folder):
            left["running or waiting"] = left.get("running or waiting", 0) + 1
        else:
            needed.append(run)
    for why, number in left.items():
        print(f"left out: {number} of {len(runs)} runs, which are {why}")
    return needed


def _new_list(results_dir: Path) -> Path:
    """A place for a list that nobody else has; a folder of its name is made for what the jobs say."""
    results_dir.mkdir(parents=True, exist_ok=True)
    stamp = f"submitted-{datetime.now():%Y%m%d-%H%M%S}"
    number = 1
    while True:
        folder = results_dir / f"{stamp}{f'-{number}' if number > 1 else ''}"
        try:
            folder.mkdir()
            return folder.with_suffix(".csv")
        except FileExistsError:
            number += 1


def _submit(runs: Sequence[Settings], cluster: Mapping[str, Any], folder: Path) -> list[str]:
    """Hand the runs over; the name of each one's job. Raises :class:`ClusterError` with a sentence if they are not taken."""
    import submitit
    from submitit.core.utils import FailedJobError, FailedSubmissionError

    local = cluster["name"] == "local"
    at_once = min(cluster["at_once"] or (workers.cores() if local else len(runs)), len(runs))
    parts = [runs[first::at_once] for first in range(at_once)] if local else [[run] for run in runs]
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=cluster["name"], slurm_max_num_timeout=_SLICES)
        minutes = _EVER_MINUTES if local else cluster["minutes"]
        executor.update_parameters(name="uarm-rl", timeout_min=minutes, stderr_to_stdout=True)
        if not local:
            executor.update_parameters(
                mem_gb=cluster["gigabytes"],
                cpus_per_task=cluster["cores"],
                **{f"slurm_{key}": cluster[key] for key in ("partition", "account", "qos")},
                slurm_array_parallelism=at_once,
            )
        with redirect_stderr(io.StringIO()), _silent_children():
            tasks = executor.submit_array([Task(part) for part in parts])
    except (FailedJobError, FailedSubmissionError, RuntimeError, OSError, subprocess.SubprocessError) as error:
        said = [line for line in str(error).splitlines() if line.strip() and not line.startswith(("Command", "Traceback"))]
        raise ClusterError(f"the cluster did not take the runs: {printable(' '.join(said[-3:]))}") from None
    names = {number: task.job_id for number, task in enumerate(tasks)}
    if not local:
        return [names[number] for number in range(len(runs))]
    return [f"{platform.node()}:{names[number % at_once]}" for number in range(len(runs))]


@contextmanager
def _silent_children() -> Iterator[None]:
    """Processes that begin meanwhile do not hold this one's output open; whoever waits for its end would wait for theirs."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(number) for number in (1, 2)]
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for number in (1, 2):
            os.dup2(null, number)
        yield
    finally:
        for number, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, number)
        for descriptor in (null, *kept):
            os.close(descriptor)
