"""Trials on an arm, real or emulated, beside the paper's: a section of the report, from the ``trials.csv`` of ``run-real``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import pandas as pd

from uarm_rl.report import statistics, tables
from uarm_rl.report.records import TRIALS, read
from uarm_rl.report.tables import Section

_PAPER: Final = (40, 50)  # section 4.3: 80 % of 50 trials
_HEADINGS: Final = ("Trials of", "Arm", "Trials", "Held after the lift (95 % interval, Wilson)", "Reached by the policy")


def arm_trials(results_dir: Path) -> Section:
    """arm_trials.csv and .md: a row for each series of trials below ``results_dir``, the paper's last, if any.

    An emulated arm is never called real: the files themselves say which it was.
    """
    rows = []
    for path in sorted(results_dir.glob("**/trials.csv")):
        trials = pd.DataFrame(read(path, TRIALS))
        for emulated, same in trials.groupby("emulated"):
            arm = "emulated" if emulated else "real"
            name = path.parent.relative_to(results_dir).as_posix()
            rows.append(_row(name, arm, int(same["success"].sum()), len(same), float(same["reached"].mean())))
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
    return Section(
        {"arm_trials.csv": tables.csv(pd.DataFrame(rows)), "arm_trials.md": tables.markdown(_HEADINGS, cells, left=2).encode()}
    )


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
