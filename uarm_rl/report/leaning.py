"""Whether a policy places itself or leans on the object: the same positions with nothing solid there, and with bellows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd

from uarm_rl.checks import command
from uarm_rl.report import tables
from uarm_rl.report.records import Method, Runs, find_runs, lacking, methods, read_config, read_evaluations
from uarm_rl.report.tables import Document, Section, Table

#: The files beside the standard test, and the options of `uarm-rl evaluate` for each.
_TESTS: Final = {
    "ghost.csv": "object=ghost",
    "bellows.csv": "cup=bellows",
    "bellows-ghost.csv": "cup=bellows object=ghost",
}
_SOFT: Final = "bellows"  # below the results folder: methods that were trained with such a cup
_HEADINGS: Final = (
    "Method",
    "Trained with",
    "Episodes",
    "Object",
    "Cup",
    "Seeds",
    "Success (95 % interval)",
    "Pressed (mm: median, 99 %, most)",
    "Told to press (mm: median, 99 %)",
    "Contact (N: median, 99 %, most)",
)
_CAPTION: Final = (
    "The same policies and positions, interval as in Table 1. Ghost: the policy is told the target and nothing solid is there. "
    "Pressed: the deepest that the cup, by forward kinematics, was below the object's upper surface while over it, in each "
    "episode; told to press: the same of the references. Contact: the largest normal force between cup and object."
)


def leaning(results_dir: Path, shown: Sequence[Method], runs: Runs, standard: Mapping[str, pd.DataFrame]) -> Section:
    """leaning.csv and .md: success, depth and force with a solid object and with a ghost, with the own cup and with bellows.

    Of the runs, and of those in ``results_dir/bellows``, which were trained with such a cup.
    """
    folder = results_dir / _SOFT
    found = find_runs(folder) if folder.is_dir() else {}
    trained_so = [method for method in methods(found) if method.folder in found]
    section = Section(remarks=_missing(results_dir, runs))
    rows = [*_rows(shown, runs, standard), *_rows(trained_so, found, read_evaluations(found))]
    if rows:
        section.contents["leaning.csv"] = tables.csv(pd.DataFrame(rows))
        section.contents["leaning.md"] = Document(Table(_HEADINGS, [*map(_cells, rows)], left=5), _CAPTION)
    return section


def _rows(shown: Sequence[Method], runs: Runs, standard: Mapping[str, pd.DataFrame]) -> Iterator[dict[str, Any]]:
    """A row for each object and cup with which a method's leaning was measured."""
    tests = [standard, *(read_evaluations(runs, file) for file in _TESTS)]
    for method in shown:
        settings = read_config(runs[method.folder][0]) if runs[method.folder] else {}
        trained = {
            "trained_with": settings.get("cup", {}).get("name", "rigid") if settings else "",
            "episodes": settings.get("episodes", ""),
        }
        done = set()
        for test in tests:
            evaluation = test[method.folder].dropna(subset="press_m")
            conditions = {name: next(iter(evaluation[name]), "") for name in ("object", "cup")}
            if len(evaluation) and (*conditions.values(),) not in done:  # whose own cup gives is tested with it but once
                done.add((*conditions.values(),))
                yield {"method": method.label} | trained | conditions | tables.success(evaluation) | _spread(evaluation)


def _spread(rows: pd.DataFrame) -> dict[str, float]:
    """Median, 99th percentile and largest of what each episode measured."""
    return {
        f"{name.removesuffix(unit)}{which}{unit}": float(rows[name].quantile(share))
        for name, unit in (("press_m", "_m"), ("reference_press_m", "_m"), ("contact_n", "_n"))
        for which, share in (("_median", 0.5), ("_99", 0.99), ("_most", 1.0))
    }


def _cells(row: Mapping[str, Any]) -> list[str]:
    def spread(name: str, factor: float, *which: str) -> str:
        return ", ".join(tables.number(factor * row[name.format(one)], 1) for one in which)

    solid = row["object"] == "solid"
    return [
        row["method"],
        row["trained_with"] or "-",
        str(row["episodes"] or "-"),
        row["object"],
        row["cup"],
        str(row["seeds"]),
        tables.success_text(row),
        spread("press_{}_m", 1000.0, "median", "99", "most"),
        spread("reference_press_{}_m", 1000.0, "median", "99"),
        spread("contact_{}_n", 1.0, "median", "99", "most") if solid else "-",
    ]


def _missing(results_dir: Path, runs: Runs) -> list[str]:
    """A remark that names the first test which evaluated runs lack."""
    for file, options in _TESTS.items():
        if which := lacking(runs, file):
            made = command(results_dir, f"evaluate {options} out={file}")
            return [f"leaning on what is not solid or gives, missing: {file} ({which}); {made} makes it"]
    return []
