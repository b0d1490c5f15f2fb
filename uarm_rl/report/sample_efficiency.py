"""Success against what it cost: stored experiences, gradient steps, decisions, and the time that the arm has moved."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import pandas as pd

from uarm_rl.report import figures, tables
from uarm_rl.report.records import BUDGETS, Method
from uarm_rl.report.tables import Document, Section, Table

_RATE: Final = "validation_success_rate"
_ENOUGH: Final = 0.95
_AXES: Final = {
    "experiences": "Stored experiences",
    "updates": "Gradient steps",
    "decisions": "Decisions",
    "control_steps": "Control steps",
    "simulated_s": "Simulated time (s)",
}


def budgets(
    methods: Sequence[Method], progress: Mapping[str, pd.DataFrame], evaluations: Mapping[str, pd.DataFrame]
) -> Section:
    """budgets.csv and .png, steps_to_95.csv and .md: validation success on four axes, and when it first was 95 %.

    Control steps become seconds by the rate in the run's own evaluation; where none tells it they stay control steps.
    """
    validated = {method.folder: _validated(progress[method.folder], evaluations[method.folder]) for method in methods}
    values = {axis: (axis, "mean") for axis in (*BUDGETS, "simulated_s")}
    curves = {folder: tables.over_seeds(rows, "episode", [_RATE], **values) for folder, rows in validated.items()}
    table = tables.stacked(methods, curves)
    section = Section()
    if not len(table):
        section.remarks.append("no budgets: no run has been validated yet")
        return section
    drawn = [method for method in methods if len(curves[method.folder])]
    timed = all(curves[method.folder]["simulated_s"].notna().all() for method in drawn)
    axes = {axis: _AXES[axis] for axis in ("experiences", "updates", "decisions", "simulated_s" if timed else "control_steps")}
    if not timed:
        section.remarks.append("budgets in control steps, not seconds: not every run has an evaluation with control_hz")
    reached = pd.DataFrame(
        row | {"method": method.label} for method in methods for row in _first_enough(validated[method.folder])
    )
    section.contents = {
        "budgets.csv": tables.csv(table),
        "budgets.png": figures.picture(
            lambda figure: figures.draw_budgets(figure, drawn, curves, _RATE, axes), "Validation success against four costs"
        ),
        "steps_to_95.csv": tables.csv(reached[["method", "seed", "episode", *values]]),
        "steps_to_95.md": _document(reached),
    }
    return section


def _validated(progress: pd.DataFrame, evaluation: pd.DataFrame) -> pd.DataFrame:
    """The rows of a method's log that hold a validation, with the simulated time until then (NaN if unknown)."""
    rate_hz = evaluation.groupby("seed")["control_hz"].first()
    rows: pd.DataFrame = progress.dropna(subset=[_RATE]).copy()
    rows["simulated_s"] = rows["control_steps"] / rows["seed"].map(rate_hz).astype(float)
    return rows


def _first_enough(validated: pd.DataFrame) -> list[dict[str, Any]]:
    """For each seed the first validation with enough success; NaN if there was none."""
    first = validated[validated[_RATE] >= _ENOUGH].groupby("seed").first()
    return [
        {
            "seed": seed,
            **dict.fromkeys(("episode", *_AXES), math.nan),
            **(first.loc[seed].to_dict() if seed in first.index else {}),
        }
        for seed in sorted(validated["seed"].unique())
    ]


def _document(reached: pd.DataFrame) -> Document:
    lines = [
        [str(label), f"{rows['episode'].notna().sum()} of {len(rows)}", *(_span(rows[axis].dropna()) for axis in _AXES)]
        for label, rows in reached.groupby("method", sort=False)
    ]
    return Document(
        Table(("Method", "Seeds that reached it", *_AXES.values()), lines),
        f"Until {100 * _ENOUGH:g} % of the validation positions were first reached: mean over the seeds that did, and "
        "their range. A first time can be luck; the curve in budgets.png shows whether it stayed.",
    )


def _span(values: pd.Series[float]) -> str:
    if not len(values):
        return "-"
    return f"{values.mean():,.0f}" + (f" ({values.min():,.0f} to {values.max():,.0f})" if values.nunique() > 1 else "")
