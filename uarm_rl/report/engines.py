"""Two engines: the same policies tested in both, and how far both are apart under the same commands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import pandas as pd

from uarm_rl import columns
from uarm_rl.checks import command
from uarm_rl.report import tables
from uarm_rl.report.records import (
    Method,
    Runs,
    find_runs,
    lacking,
    methods,
    read,
    read_config,
    read_evaluations,
    trained_in,
)
from uarm_rl.report.tables import Document, Section, Table

_ENGINES: Final = {"pybullet": "PyBullet", "mujoco": "MuJoCo"}
_MUJOCO: Final = "mujoco"  # below the results folder: what was trained there, and trajectories.csv

_CAPTION: Final = (
    "The same policies and positions in both engines, interval as in Table 1. Same outcome: share of seeds and positions where "
    "both engines say success, or both failure. Median time: until success, or the time limit."
)
_APART: Final = (
    "Both engines got the same joint references, whatever came of them: `free` are random steps in the air, in `contact` the "
    "cup presses on the object and drags it. An episode's distance is the largest of all its control steps; PyBullet's cup "
    "rests 1 mm above the object, MuJoCo's on it."
)


def engines(results_dir: Path, shown: Sequence[Method], runs: Runs, standard: Mapping[str, pd.DataFrame]) -> Section:
    """engines.csv and .md: success and time in each engine, of the runs and of those in ``results_dir/mujoco``."""
    folder = results_dir / _MUJOCO
    found = find_runs(folder) if folder.is_dir() else {}
    trained_there = [method for method in methods(found) if method.folder in found]
    rows = [*_rows(shown, runs, standard), *_rows(trained_there, found, read_evaluations(found))]
    section = Section(remarks=_missing(results_dir, runs, standard))
    if rows:
        section.contents["engines.csv"] = tables.csv(pd.DataFrame(rows))
        section.contents["engines.md"] = Document(*_compared(rows), *_apart(folder / "trajectories.csv"))
    return section


def _rows(shown: Sequence[Method], runs: Runs, standard: Mapping[str, pd.DataFrame]) -> Iterator[dict[str, Any]]:
    """The methods that were tested in both engines: ``evaluation.csv`` is of one, ``ENGINE.csv`` of the other."""
    further = {engine: read_evaluations(runs, f"{engine}.csv") for engine in _ENGINES}
    for method in shown:
        tests = [standard[method.folder], *(test[method.folder] for test in further.values())]
        by_engine = {rows["engine"].iloc[0]: rows for rows in reversed(tests) if len(rows)}  # evaluation.csv counts
        if all(engine in by_engine for engine in _ENGINES):
            yield _row(method, runs[method.folder], {engine: by_engine[engine] for engine in _ENGINES})


def _row(method: Method, folders: Sequence[Path], tests: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
    one, other = (rows[["seed", "position", "success"]] for rows in tests.values())
    both = one.merge(other, on=["seed", "position"])
    success = {engine: tables.success(rows) for engine, rows in tests.items()}
    return {
        "method": method.label,
        "trained_in": trained_in(folders),
        "episodes": read_config(folders[0]).get("episodes", ""),
        "seeds": both["seed"].nunique(),
        **{f"{engine}_{key}": value for engine, found in success.items() for key, value in found.items() if key != "seeds"},
        "same_outcome": (both["success_x"] == both["success_y"]).mean(),
        **{f"{engine}_median_time_s": rows["time_s"].median() for engine, rows in tests.items()},
    }


def _compared(rows: Sequence[Mapping[str, Any]]) -> tuple[Table, str]:
    headings = (
        "Method",
        "Trained in",
        "Episodes",
        "Seeds",
        *(f"Success in {name} (95 % interval)" for name in _ENGINES.values()),
        "Same outcome",
        *(f"Median time in {name} (s)" for name in _ENGINES.values()),
    )
    cells = [
        [
            row["method"],
            _ENGINES.get(row["trained_in"], "-"),
            str(row["episodes"] or "-"),
            str(row["seeds"]),
            *(tables.success_text(_of(engine, row)) for engine in _ENGINES),
            tables.percent(row["same_outcome"]),
            *(f"{row[f'{engine}_median_time_s']:.2f}" for engine in _ENGINES),
        ]
        for row in rows
    ]
    return Table(headings, cells, left=2), _CAPTION


def _of(engine: str, row: Mapping[str, Any]) -> dict[str, Any]:
    """One engine's part of a row, as ``tables.success`` gives it."""
    return {key.removeprefix(f"{engine}_"): value for key, value in row.items()}


def _apart(path: Path) -> tuple[Table | str, ...]:
    """The table of how far the engines are apart; empty if nobody measured it."""
    if not path.exists():
        return ()
    rows = pd.DataFrame(read(path, columns.TRAJECTORIES))
    cells = []
    for motion, episodes in rows.groupby("motion", sort=False):
        apart = [
            1000.0 * value
            for name in ("cup_apart_m", "object_apart_m")
            for value in episodes[name].dropna().agg(["median", "max"])
        ]
        cells.append([str(motion), str(len(episodes)), *("-" if value != value else f"{value:.2g}" for value in apart)])
    headings = (
        "Motion",
        "Episodes",
        *(f"{what} apart, {how} (mm)" for what in ("Cup", "Object") for how in ("median", "most")),
    )
    return Table(headings, cells), _APART


def _missing(results_dir: Path, runs: Runs, standard: Mapping[str, pd.DataFrame]) -> list[str]:
    """A remark on the runs that were tested in one engine alone, and the command for the other where it can be run."""
    tested = {engine for rows in standard.values() for engine in rows["engine"]}
    other = next((engine for engine in reversed(_ENGINES) if engine not in tested), "")
    which = lacking(runs, f"{other}.csv") if other and find_spec(other) else ""
    test = command(results_dir, f"evaluate sim={other} out={other}.csv")
    return [f"two engines, missing: {other}.csv ({which}); {test} makes it"] if which else []
