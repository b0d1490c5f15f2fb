"""The trained policies under other conditions than the standard test: tolerances, held-out positions, other holds."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd

from uarm_rl.report import figures, tables
from uarm_rl.report.records import Method, Runs, check_engines, missing, read_evaluations
from uarm_rl.report.tables import Document, Section, Table

Evaluations = Mapping[str, pd.DataFrame]

#: The files that `make paper` makes beside the standard test, and the option of `uarm-rl evaluate` for each.
_TOLERANCES: Final = {f"tolerance-{mm}mm.csv": f"tolerance_m={mm}e-3" for mm in (1, 2, 10)}
_HELD_OUT: Final = {"heldout.csv": "positions=heldout"}
_HOLDS: Final = {f"hold-{name}.csv": f"hold={name}" for name in ("one_step", "fixed", "until_steady")}


_MARGIN: Final = (
    "The point at 1 mm measures the engine as well: PyBullet's cup rests 0.97 mm above the object, on the margin of its hull "
    "(`sim.exact_cup=true` takes it away), so there a policy has 0.03 mm left."
)


def tolerance(results_dir: Path, methods: Sequence[Method], runs: Runs, standard: Evaluations) -> Section:
    """tolerance.csv and .png: how near the cup has to come, and how often each method then succeeds.

    ``standard`` are the evaluations at the trained tolerance; others are read from ``tolerance-<mm>mm.csv``.
    """
    section = Section(remarks=missing(results_dir, "tolerance curve", runs, _TOLERANCES))
    tests = [standard, *_tests(runs, "tolerance-*mm.csv")]
    check_engines(*tests)
    table = pd.DataFrame(
        {"method": method.label, "tolerance_m": tolerance_m, **tables.success(rows)}
        for method in methods
        for tolerance_m, rows in _by_condition(tests, method.folder, "tolerance_m")
    )
    drawn = [method for method in methods if len(standard[method.folder])]
    if len(tests) > 1 and drawn:
        section.contents["tolerance.csv"] = tables.csv(table)
        section.contents["tolerance.png"] = figures.picture(
            lambda figure: figures.draw_tolerance(figure, drawn, table), "Success at a few tolerances", 3.0
        )
        section.contents["tolerance.md"] = Document(_MARGIN)
    return section


def held_out(results_dir: Path, methods: Sequence[Method], runs: Runs, standard: Evaluations) -> Section:
    """heldout.csv and .md: success and return on many other positions, beside those on the test positions."""
    section = Section(remarks=missing(results_dir, "held-out positions", runs, _HELD_OUT))
    (file,) = _HELD_OUT
    held_out = read_evaluations(runs, file)
    check_engines(standard, held_out)
    rows: list[dict[str, Any]] = [
        {"method": method.label, "positions": name, "count": evaluation["position"].nunique()}
        | tables.success(evaluation)
        | {
            "return": evaluation["return"].mean() if method.reward else math.nan,  # IK has none of its own
            "common_return": evaluation["common_return"].mean(),
        }
        for method in methods
        if len(held_out[method.folder])
        for name, evaluation in (("test", standard[method.folder]), ("held-out", held_out[method.folder]))
        if len(evaluation)
    ]
    if rows:
        headings = ("Method", "Positions", "Seeds", "Success (95 % interval)", "Return (own reward)", "Return (same reward)")
        cells = [
            [
                row["method"],
                f"{row['count']} {row['positions']}",
                str(row["seeds"]),
                tables.success_text(row),
                "-" if math.isnan(row["return"]) else f"{row['return']:.2f}",
                f"{row['common_return']:.2f}",
            ]
            for row in rows
        ]
        section.contents["heldout.csv"] = tables.csv(pd.DataFrame(rows))
        section.contents["heldout.md"] = Document(Table(headings, cells, left=2))
    return section


def holds(results_dir: Path, methods: Sequence[Method], runs: Runs, standard: Evaluations) -> Section:
    """holds.csv, .md and .png: every policy with the holds it was not trained with, from ``hold-<name>.csv``."""
    section = Section(remarks=missing(results_dir, "train hold x test hold", runs, _HOLDS))
    tests = _tests(runs, "hold-*.csv")
    check_engines(standard, *tests)
    table = pd.DataFrame(
        {"method": method.label, "trained_hold": _hold(standard[method.folder]), "tested_hold": tested, **tables.success(rows)}
        for method in methods
        for tested, rows in _by_condition(tests, method.folder, "hold")
    )
    if len(table):
        table = table.sort_values("tested_hold", key=lambda holds: holds.str.len(), kind="stable")  # fixed(1), fixed(13)
        section.contents["holds.csv"] = tables.csv(table)
        section.contents["holds.md"] = _holds_document(table)
        worded = table.assign(**{column: table[column].map(hold_words) for column in ("trained_hold", "tested_hold")})
        section.contents["holds.png"] = figures.picture(
            lambda figure: figures.draw_holds(figure, worded), "Success of each method with each hold", 2.6
        )
    return section


def _hold(rows: pd.DataFrame) -> str:
    """The hold of a standard test, which is that of the training; empty if nobody knows."""
    return str(rows["hold"].iloc[0]) if len(rows) else ""


def hold_words(label: str) -> str:
    """A hold's label in words: ``fixed(13)`` is ``13 steps``, ``until_steady(2..40, 0.001 rad)`` is ``until steady``."""
    if match := re.fullmatch(r"fixed\((\d+)\)", label):
        return "one step" if match[1] == "1" else f"{match[1]} steps"
    if match := re.fullmatch(r"until_steady\((.*?)\)", label):
        return "until steady" if match[1] in ("2..40", "2..40, 0.001 rad") else f"until steady ({match[1]})"
    return label or "-"


def _holds_document(table: pd.DataFrame) -> Document:
    """A row for each method and a column for each tested hold; that of the training is bold."""
    tested = list(dict.fromkeys(table["tested_hold"]))
    lines = []
    for label, rows in table.groupby("method", sort=False):
        trained = rows["trained_hold"].iloc[0]
        cells = {row["tested_hold"]: tables.success_text(row) for row in tables.records(rows)}
        marked = {hold: f"**{cell}**" if hold == trained else cell for hold, cell in cells.items()}
        lines.append([str(label), hold_words(trained), *(marked.get(hold, "-") for hold in tested)])
    return Document(Table(("Method", "Trained with", *(f"Tested with {hold_words(hold)}" for hold in tested)), lines, left=2))


def _tests(runs: Runs, pattern: str) -> list[dict[str, pd.DataFrame]]:
    """The evaluations in the files of the run folders whose names match."""
    names = {path.name for folders in runs.values() for folder in folders for path in folder.glob(pattern)}
    return [read_evaluations(runs, name) for name in sorted(names) if not name.endswith("-traces.csv")]


def _by_condition(tests: Sequence[Evaluations], folder: str, column: str) -> Iterator[tuple[Any, pd.DataFrame]]:
    """One method's rows of all tests, parted by what ``column`` says they were made under; older files do not say it."""
    rows = pd.concat([test[folder] for test in tests]) if tests else pd.DataFrame(columns=[column])
    known = rows[rows[column].notna() & (rows[column] != "")].drop_duplicates([column, "seed", "position"])
    yield from known.groupby(column)
