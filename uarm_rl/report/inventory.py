"""What a results folder holds, run by run: how far each is, how good, in which engine, how large, and what of it is stale."""

from __future__ import annotations

import math
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from uarm_rl import columns, csvfile, files, locks
from uarm_rl.checks import command
from uarm_rl.columns import RATE, TEXT, WHOLE, Column, pick
from uarm_rl.report.records import (
    INVERSE_KINEMATICS,
    METHODS,
    OLDEST_ENGINE,
    REAL_ARM,
    find_runs,
    read_config,
    seed_number,
)

STATES: Final = ("training", "interrupted", "trained", "evaluated")

_LABELS: Final = {method.folder: method.label for method in (*METHODS, INVERSE_KINEMATICS, REAL_ARM)}
_EVALUATION: Final = {**pick(columns.MEASURED, "success"), **pick(columns.CONDITIONS, "tolerance_m", "control_hz", "engine")}
_PROGRESS: Final = pick(columns.PROGRESS, "episode", "validation_success_rate")
_TABLE: Final = {
    "method": Column("method", TEXT, "", "its label"),
    "seeds": Column("seeds", WHOLE, "", "how many runs"),
    "success_rate": Column("success_rate", RATE, "", "mean over seeds", empty=True),
}
#: A checkout writes the files of a run in any order, but one soon after the other.
_SLACK_S: Final = 60.0


class Run(NamedTuple):
    """One run. ``name`` is its folder's place below the results folder, without the seed.

    ``success`` is the share of test positions, or of the last validation where it is not ``evaluated``; NaN if neither is
    there. ``holder`` is who trains it, empty for nobody. ``changed_s`` is when one of its files was last written (s, Unix
    time), ``size`` in bytes.
    """

    name: str
    seed: int
    folder: Path
    method: str
    state: str
    holder: str
    episode: int
    episodes: int
    success: float
    engine: str
    changed_s: float
    size: int
    stale: tuple[str, ...]


def inventory(results_dir: Path) -> list[Run]:
    """All runs in ``results_dir`` and in its folders of further runs, as ``ablations``; by name and seed.

    Raises :class:`uarm_rl.checks.UsageError` if there is no such folder. A file that is damaged makes its run stale.
    """
    found = find_runs(results_dir)
    runs = dict(found)
    for inner in sorted(path for path in results_dir.iterdir() if path.is_dir() and path.name not in found):
        runs |= {f"{inner.name}/{name}": folders for name, folders in find_runs(inner).items()}
    return [_run(name, folder) for name, folders in runs.items() for folder in folders]


def _files(folder: Path) -> Iterator[os.stat_result]:
    """What is known of every file in a run's folder; one that is being saved may be renamed while it is looked at."""
    for parent, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):
                found = os.lstat(os.path.join(parent, name))
                if stat.S_ISREG(found.st_mode):
                    yield found


def _run(name: str, folder: Path) -> Run:
    settings = read_config(folder)
    status = list(_files(folder))
    stale: list[str] = []
    tested = _values(folder / "evaluation.csv", _EVALUATION, stale)
    holder = locks.holder(folder)  # asked first: it may finish meanwhile
    trained = (folder / files.POLICY).exists()
    episode, success = 0, math.nan
    if tested.get("success"):
        success = sum(tested["success"]) / len(tested["success"])
        stale += _outdated(folder, settings, tested)
    else:
        progress = _values(folder / files.PROGRESS, _PROGRESS, stale)
        episode = len(progress.get("episode", ()))
        success = next(
            (rate for rate in reversed(progress.get("validation_success_rate", ())) if not math.isnan(rate)), success
        )
    if (folder / "evaluation.csv").exists():
        state = "evaluated"
    else:
        state = "trained" if trained else "training" if holder else "interrupted"
    return Run(
        name=name,
        seed=seed_number(folder),
        folder=folder,
        method=_LABELS.get(folder.parent.name)
        or ", ".join(filter(None, (_name_of(settings, key) for key in ("buffer", "reward")))),
        state=state,
        holder=holder,
        episode=episode,
        episodes=settings["episodes"] if isinstance(settings.get("episodes"), int) else 0,
        success=success,
        engine=_engine(settings, tested),
        changed_s=max((one.st_mtime for one in status), default=0.0),
        size=sum(one.st_size for one in status),
        stale=tuple(stale),
    )


def _values(path: Path, wanted: columns.Columns, problems: list[str]) -> dict[str, list[Any]]:
    """Columns of a file, empty if it is not there or cannot be read, which is then a problem."""
    if not path.exists():
        return {}
    try:
        return csvfile.read(path, wanted).values
    except (csvfile.CsvError, OSError) as error:
        problems.append(str(error))
        return {}


def _outdated(folder: Path, settings: Mapping[str, Any], tested: Mapping[str, list[Any]]) -> list[str]:
    """Why the evaluation is not that of this policy under these settings."""
    reasons = []
    policy, evaluation = folder / files.POLICY, folder / "evaluation.csv"
    if policy.exists() and policy.stat().st_mtime > evaluation.stat().st_mtime + _SLACK_S:
        reasons.append(f"{evaluation} is older than the policy")
    for key in ("tolerance_m", "control_hz"):
        value, now = tested[key][0], settings.get(key)
        if isinstance(now, (int, float)) and not math.isnan(value) and not math.isclose(value, now, rel_tol=1e-6):
            reasons.append(f"{evaluation} was made with {key}={value:g}, and the run's is {now:g}")
    return reasons


def _engine(settings: Mapping[str, Any], tested: Mapping[str, list[Any]]) -> str:
    """The engine of the training, and that of the test where it is another."""
    trained = (_name_of(settings, "sim") or OLDEST_ENGINE) if settings else ""
    test = (tested["engine"][0] or OLDEST_ENGINE) if tested.get("engine") else trained
    return trained if test == trained else ", tested in ".join(filter(None, (trained, test)))


def _name_of(settings: Mapping[str, Any], group: str) -> str:
    chosen = settings.get(group)
    name = chosen.get("name") if isinstance(chosen, Mapping) else None
    return name if isinstance(name, str) else ""


def stale_table(results_dir: Path, runs: Iterable[Run]) -> str:
    """Why Table 1 in the folder is not that of the runs in it, in a sentence; empty if it is, or if there is none."""
    path, problems = results_dir / "table1.csv", list[str]()
    table = _values(path, _TABLE, problems)
    if problems or not table:
        return "".join(problems)
    there: dict[str, list[float]] = {}
    for run in runs:
        if run.state == "evaluated" and "/" not in run.name:
            there.setdefault(_LABELS.get(run.name, run.name), []).append(run.success)
    shown = {
        method.partition(" (")[0]: (seeds, rate)
        for method, seeds, rate in zip(*(table[name] for name in _TABLE), strict=True)
        if seeds
    }
    changed = [
        method
        for method in sorted({*there, *shown})
        if len(found := there.get(method, [])) != shown.get(method, (0, 0.0))[0]
        or not math.isclose(sum(found) / len(found), shown[method][1], abs_tol=1e-5)
    ]
    if not changed:
        return ""
    return f"{path} shows other runs of {', '.join(changed)} than there are; {command(results_dir, 'report')} makes it anew"
