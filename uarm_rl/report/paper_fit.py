"""The paper's table with the one constant fitted that it does not give: how near the cup has to come."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from uarm_rl.report import figures, statistics, tables
from uarm_rl.report.records import METHODS, Method, Runs, check_engines, missing, read_evaluations, read_paper
from uarm_rl.report.tables import Document, Section, Table

#: The files that `make paper` makes for this, and the options of `uarm-rl evaluate` for each.
_TESTS: Final = {
    "settled-validation.csv": "until=time_limit positions=validation",
    "settled.csv": "until=time_limit",
}
_FITTED: Final = METHODS[1]  # B: its success is neither at the floor nor at the ceiling, so it says most of the tolerance
_SETTLED: Final = "settled_distance_m"


class Fit(NamedTuple):
    """A tolerance (m) and its 95 % interval."""

    tolerance_m: float
    low_m: float
    high_m: float

    @property
    def words(self) -> str:
        """The tolerance alone, as in ``7.3 mm``."""
        return f"{1000.0 * self.tolerance_m:.1f} mm"


def paper_fit(results_dir: Path, methods: Sequence[Method], runs: Runs, standard: Mapping[str, pd.DataFrame]) -> Section:
    """paper_fit.csv, .md and .png: success at the tolerance that gives method B the paper's success on validation positions.

    Reads the evaluations that success does not end; ``standard`` are those at the trained tolerance.
    """
    validation, test = (read_evaluations(runs, file) for file in _TESTS)
    check_engines(standard, validation, test)
    section = Section(remarks=missing(results_dir, "the paper's table at a fitted tolerance", runs, _TESTS))
    paper = read_paper(results_dir)
    fit = _fit(validation.get(_FITTED.folder, pd.DataFrame()), paper.get(_FITTED.label, math.nan))
    if fit is None:
        return section
    folders = {method.folder: paper.get(method.label, math.nan) for method in METHODS}
    shown = [method for method in methods if len(test[method.folder])]
    rows = [
        _row(method, test[method.folder], standard[method.folder], fit)
        | {"paper_success_rate": folders.get(method.folder, math.nan)}
        for method in shown
    ]
    if rows:
        section.contents["paper_fit.csv"] = tables.csv(pd.DataFrame(rows))
        section.contents["paper_fit.md"] = _document(rows, fit, paper[_FITTED.label], validation[_FITTED.folder])
        drawn = [(method, row) for method, row in zip(shown, rows, strict=True) if method.folder in folders]
        curves = {method.label: _curve(test[method.folder]) for method, _ in drawn}
        points = pd.DataFrame(row for _, row in drawn)
        section.contents["paper_fit.png"] = figures.picture(
            lambda figure: figures.draw_paper_fit(figure, [method for method, _ in drawn], curves, points),
            "Success at every tolerance, and at the fitted one beside the paper's",
            3.0,
        )
    return section


def _settled(rows: pd.DataFrame) -> NDArray[np.float64]:
    """How near the cup came to stay (m), shape (seeds, positions); infinity where the object was lost before."""
    return np.nan_to_num(tables.outcomes(rows, _SETTLED), nan=math.inf)


def _fit(rows: pd.DataFrame, rate: float) -> Fit | None:
    """The least tolerance at which the share ``rate`` of these tests succeeds; ``None`` if there is none."""
    if not len(rows) or math.isnan(rate):
        return None
    distances = _settled(rows)
    tolerance_m = statistics.quantile(distances, rate)
    if not math.isfinite(tolerance_m):
        return None
    return Fit(tolerance_m, *statistics.quantile_interval(distances, rate, tables.generator()))


def _at(rows: pd.DataFrame, tolerance_m: float) -> pd.DataFrame:
    """The test as it would have come out at another tolerance."""
    ended: pd.DataFrame = rows.assign(success=(rows[_SETTLED] <= tolerance_m).astype(float))
    return ended


def _row(method: Method, test: pd.DataFrame, standard: pd.DataFrame, fit: Fit) -> dict[str, Any]:
    trained = {f"trained_{name}": value for name, value in tables.success(standard).items()}
    return {
        "method": method.label,
        "buffer": method.buffer,
        "reward": method.reward,
        "tolerance_m": fit.tolerance_m,
        "tolerance_low_m": fit.low_m,
        "tolerance_high_m": fit.high_m,
        **tables.success(_at(test, fit.tolerance_m)),
        "trained_tolerance_m": standard["tolerance_m"].median() if len(standard) else math.nan,
        **trained,
    }


def _curve(rows: pd.DataFrame) -> pd.DataFrame:
    """Success at every tolerance at which it changes: ``tolerance_mm`` and ``success_rate``."""
    distances = np.sort(_settled(rows), axis=None)
    rates = np.arange(1, distances.size + 1) / distances.size
    finite = np.isfinite(distances)
    curve: pd.DataFrame = pd.DataFrame({"tolerance_mm": 1000.0 * distances[finite], "success_rate": rates[finite]})
    return curve


def _document(rows: Sequence[Mapping[str, Any]], fit: Fit, rate: float, validation: pd.DataFrame) -> Document:
    trained_m = next((row["trained_tolerance_m"] for row in rows if not math.isnan(row["trained_tolerance_m"])), math.nan)
    trained = "the trained tolerance" if math.isnan(trained_m) else f"{1000.0 * trained_m:g} mm"
    headings = (
        "Method",
        "Buffer",
        "Reward",
        "Seeds",
        "Paper",
        *(f"Success at {at} (95 % interval)" for at in (fit.words, trained)),
    )
    cells = [
        [
            row["method"],
            row["buffer"] or "-",
            row["reward"] or "-",
            str(row["seeds"]),
            tables.percent(row["paper_success_rate"]),
            tables.success_text(row),
            tables.success_text({name.removeprefix("trained_"): value for name, value in row.items() if "trained_" in name}),
        ]
        for row in rows
    ]
    interval = f"{1000.0 * fit.low_m:.1f} to {1000.0 * fit.high_m:.1f} mm"
    interval = f"{1000.0 * fit.low_m:.1f} to {1000.0 * fit.high_m:.1f} mm"
    words = (
        f"{fit.words} ({interval}, bootstrap over seeds and positions) is the least tolerance at which {_FITTED.label} has the "
        f"paper's {tables.percent(rate)} on the {validation['position'].nunique()} validation positions. Its success on the "
        f"test positions says whether the two sets agree; the others' are predictions. All were trained with {trained}."
    )
    return Document(Table(headings, cells, left=3), words)
