"""Trials on an arm, real or emulated, beside the paper's: a section of the report, from the ``trials.csv`` of ``run-real``."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pandas as pd

from uarm_rl import files
from uarm_rl.files import PICTURES
from uarm_rl.report import statistics, tables
from uarm_rl.report.records import TRIALS, read
from uarm_rl.report.tables import Content, Document, Photo, Section, Table

_PAPER: Final = (40, 50)  # section 4.3: 80 % of 50 trials
_HEADINGS: Final = ("Trials of", "Arm", "Trials", "Held after the lift (95 % interval, Wilson)", "Reached by the policy")
#: The columns of a trial on the page: heading, factor to its unit, decimals.
_TRIAL: Final = {
    "target_x_m": ("x (mm)", 1000.0, 0),
    "target_y_m": ("y (mm)", 1000.0, 0),
    "success": ("Held", 1.0, 0),
    "reached": ("Reached", 1.0, 0),
    "time_s": ("Time (s)", 1.0, 2),
    "final_distance_m": ("Distance at the end (mm)", 1000.0, 1),
    "decisions": ("Commands", 1.0, 0),
    "camera_misfit_px": ("Camera misfit (px)", 1.0, 2),
}
_KINDS: Final = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
#: So many pictures of a series, and none larger than so many bytes, because the page is one file.
_PHOTOS: Final = 6
_LARGEST: Final = 300_000


def arm_trials(results_dir: Path) -> Section:
    """arm_trials.csv and .md: a row for each series of trials below ``results_dir``, the paper's last, if any.

    An emulated arm is never called real: the files themselves say which it was.
    """
    rows, page = [], list[Table | Photo]()
    for path in sorted(results_dir.glob("**/trials.csv")):
        trials = pd.DataFrame(read(path, TRIALS))
        name = path.parent.relative_to(results_dir).as_posix()
        for emulated, same in trials.groupby("emulated"):
            arm = "emulated" if emulated else "real"
            rows.append(_row(name, arm, int(same["success"].sum()), len(same), float(same["reached"].mean())))
            page.append(_each(f"The {len(same)} trials of {name} on the {arm} arm", same))
        page += _photos(path.parent, name)
    if not rows:
        return Section()
    rows.append(_row("the paper's method C", "real", *_PAPER, math.nan))
    cells = [
        [
            row["trials_of"],
            row["arm"],
            str(row["trials"]),
            tables.success_text(row | {"seeds": 1}),
            tables.percent(row["reached_rate"]),
        ]
        for row in rows
    ]
    contents: dict[str, Content] = {
        "arm_trials.csv": tables.csv(pd.DataFrame(rows)),
        "arm_trials.md": Document(Table(_HEADINGS, cells, left=2)),
    }
    return Section(contents, page=Document(*page))


def _row(name: str, arm: str, held: int, trials: int, reached: float) -> dict[str, Any]:
    low, high = statistics.wilson_interval(held, trials)
    return {
        "trials_of": name,
        "arm": arm,
        "trials": trials,
        "success_rate": held / trials,
        "ci_low": low,
        "ci_high": high,
        "reached_rate": reached,
    }


def _each(title: str, trials: pd.DataFrame) -> Table:
    """A row for each trial of a series."""
    rows = [
        [
            tables.number(row["trial"], 0),
            *(tables.number(factor * row[name], digits) for name, (_, factor, digits) in _TRIAL.items()),
        ]
        + [str(row["reason"] or "-")]
        for row in tables.records(trials)
    ]
    return Table(("Trial", *(heading for heading, _, _ in _TRIAL.values()), "Why it failed"), rows, left=0, title=title)


def _photos(folder: Path, name: str) -> Iterator[Photo]:
    """The pictures of the trials and those beside them, the first in the order of their names."""
    found = [*sorted((folder / PICTURES).glob("*")), *sorted(folder.iterdir())]
    paths = [path for path in found if path.suffix.lower() in _KINDS and path.stat().st_size <= _LARGEST]
    for path in paths[:_PHOTOS]:
        yield Photo(f"{path.name} of {name}", _KINDS[path.suffix.lower()], files.read(path, at_most=_LARGEST))
