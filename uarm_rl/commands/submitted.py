"""What was submitted to a cluster: a list in the results folder, a row a run, and what the queue says of its jobs.

The list is written before the queue is asked to take it, so that nothing is lost if it does not. It is data: whoever reads it
runs nothing of it.
"""

from __future__ import annotations

import csv
import io
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from uarm_rl import columns, csvfile, files

_ASK_S: Final = 30.0  # for the queue's answer
#: What SLURM calls a job that stands in the queue, by how the words begin; others of its jobs work.
_STANDING: Final = ("PENDING", "CONFIGURING", "SUSPENDED", "REQUEUE", "SPECIAL_EXIT", "RESV_DEL", "STOPPED")


class Entry(NamedTuple):
    """A run of a list. ``job`` is the queue's name for it, or ``MACHINE:PROCESS``; empty if it was not taken.

    ``words`` are those that were typed behind ``uarm-rl submit``, for the shell.
    """

    folder: str
    job: str
    words: str


def write(path: Path, entries: Iterable[Entry]) -> None:
    """Write a list, whole or not at all."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([columns.SUBMITTED, *entries])
    files.replace(path, text.getvalue().encode())


def lists(results_dir: Path) -> dict[Path, list[Entry]]:
    """The lists in a folder, the oldest first. Raises :class:`uarm_rl.csvfile.CsvError` for one that cannot be read."""
    found = {}
    for path in sorted(results_dir.glob("submitted-*.csv")):
        values = csvfile.read(path, columns.SUBMITTED).values
        found[path] = [Entry(*cells) for cells in zip(*(values[name] for name in columns.SUBMITTED), strict=True)]
        for entry in found[path]:
            if not re.fullmatch(r"\w[\w.,+ -]*/seed[0-9]{1,10}", entry.folder):
                raise csvfile.CsvError(f"{path} names {entry.folder!r:.60}, which is no run's folder; delete the list")
    return found


def words_of_jobs(jobs: Iterable[str]) -> dict[str, str]:
    """What is known of each job: ``waiting``, ``running``, ``gone``, or ``unknown`` where nobody here can say."""
    known = {job: _of_process(job) for job in jobs if ":" in job}
    queued = sorted({job for job in jobs if job and ":" not in job})
    answer = _squeue(queued) if queued else {}
    return known | {job: "unknown" if answer is None else _word(answer.get(job, "")) for job in queued}


def _word(state: str) -> str:
    return "gone" if not state else "waiting" if state.startswith(_STANDING) else "running"


def _of_process(job: str) -> str:
    host, _, process = job.rpartition(":")
    if host != platform.node() or not process.isdecimal():
        return "unknown"
    try:
        os.kill(int(process), 0)
    except (ProcessLookupError, OverflowError):
        return "gone"
    except PermissionError:
        pass  # it is there, and another's
    return "waiting"


def state_of(job: str) -> str:
    """SLURM's own word for the state of one job; empty if it has none to say."""
    return (_squeue([job]) or {}).get(job, "")


def _squeue(jobs: Sequence[str]) -> dict[str, str] | None:
    """SLURM's words for the states of the jobs that it has; ``None`` if it says nothing here."""
    arrays = ",".join(sorted({job.partition("_")[0] for job in jobs}))
    command = ["squeue", "--noheader", "--array", "--format=%i %T", f"--jobs={arrays}"]
    with suppress(OSError, subprocess.SubprocessError):
        done = subprocess.run(command, capture_output=True, text=True, timeout=_ASK_S, check=False)
        if done.returncode == 0 or "Invalid job id" in done.stderr:  # what it says when it has forgotten all of them
            rows = [line.split(maxsplit=1) for line in done.stdout.splitlines()]
            return {row[0]: row[1].strip() for row in rows if len(row) == 2}
    return None
