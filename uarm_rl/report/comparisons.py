"""Which differences between the four methods the test positions and the seeds can show, and which they cannot."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final

import pandas as pd

from uarm_rl.report import statistics, tables
from uarm_rl.report.records import METHODS
from uarm_rl.report.tables import Document, Section, Table

_PAIRS: Final = (("A", "B"), ("C", "D"), ("A", "C"), ("B", "D"))

#: Weighted sums of the methods' success rates.
_CONTRASTS: Final = {
    **{f"{one}-{other}": {one: 1.0, other: -1.0} for one, other in _PAIRS},
    "adaptive-uniform": {"A": 0.5, "B": -0.5, "C": 0.5, "D": -0.5},
    "penalty-plain": {"A": -0.5, "B": -0.5, "C": 0.5, "D": 0.5},
    "interaction": {"A": -1.0, "B": 1.0, "C": 1.0, "D": -1.0},
}
_MEANINGS: Final = {
    "adaptive-uniform": "mean of A-B and C-D",
    "penalty-plain": "mean of C-A and D-B",
    "interaction": "C-D less A-B",
}


def comparisons(evaluations: Mapping[str, pd.DataFrame]) -> Section:
    """comparisons.csv and .md: exact McNemar tests seed by seed, bootstrap intervals over seeds and positions.

    ``evaluations`` has the rows of each run name, at least of the four methods'.
    """
    rows = {method.label: evaluations[method.folder] for method in METHODS}
    section = Section()
    if len(engines := sorted({engine for one in rows.values() for engine in one["engine"]})) > 1:
        return Section(remarks=[f"not compared, because A to D were tested in different engines: {', '.join(engines)}"])
    if unknown := [name for name, weights in _CONTRASTS.items() if not _evaluated(weights, rows)]:
        section.remarks.append(f"not compared, because a method of theirs is not evaluated: {', '.join(unknown)}")
    paired, summed = list(_per_seed(rows)), list(_over_seeds(rows))
    if summed:
        section.contents["comparisons.csv"] = tables.csv(pd.DataFrame([*paired, *summed]))
        section.contents["comparisons.md"] = Document(*_parts(paired, summed))
    return section


def _evaluated(weights: Mapping[str, float], rows: Mapping[str, pd.DataFrame]) -> bool:
    return all(len(rows[label]) for label in weights)


def _per_seed(rows: Mapping[str, pd.DataFrame]) -> Iterator[dict[str, Any]]:
    """An exact McNemar test for each pair of methods and each seed that both have."""
    by_seed = {label: {int(str(seed)): one for seed, one in all_seeds.groupby("seed")} for label, all_seeds in rows.items()}
    for one, other in _PAIRS:
        for seed in sorted(set(by_seed[one]) & set(by_seed[other])):
            first, second = (tables.outcomes(by_seed[label][seed])[0] for label in (one, other))
            difference = first.mean() - second.mean()
            test = statistics.mcnemar_exact(first, second)
            yield _row(f"{one}-{other}", seed, 1, difference) | test._asdict()


def _over_seeds(rows: Mapping[str, pd.DataFrame]) -> Iterator[dict[str, Any]]:
    """The interval of each contrast whose methods were all evaluated."""
    for name, weights in _CONTRASTS.items():
        if _evaluated(weights, rows):
            methods = [tables.outcomes(rows[label]) for label in weights]
            difference = sum(weight * rows[label]["success"].mean() for label, weight in weights.items())
            low, high = statistics.bootstrap_interval(methods, [*weights.values()], tables.generator())
            yield _row(name, "all", min(map(len, methods)), difference) | {"ci_low": low, "ci_high": high}


def _row(comparison: str, seed: object, seeds: int, difference: float) -> dict[str, Any]:
    unknown = dict.fromkeys(("ci_low", "ci_high", "first_only", "second_only", "p_value"), math.nan)
    return {"comparison": comparison, "seed": seed, "seeds": seeds, "difference": difference, **unknown}


def _parts(paired: list[dict[str, Any]], summed: list[dict[str, Any]]) -> Iterator[Table | str]:
    cells = [
        [
            f"{row['comparison']} ({_MEANINGS[row['comparison']]})" if row["comparison"] in _MEANINGS else row["comparison"],
            str(row["seeds"]),
            _points(row["difference"]),
            f"{_points(row['ci_low'])} to {_points(row['ci_high'])}",
        ]
        for row in summed
    ]
    yield Table(("Comparison", "Seeds", "Difference (points of success)", "95 % interval"), cells)
    yield _limits(min(row["seeds"] for row in summed))
    if paired:
        cells = [
            [
                row["comparison"],
                str(row["seed"]),
                _points(row["difference"]),
                str(row["first_only"]),
                str(row["second_only"]),
                f"{row['p_value']:.2g}",
            ]
            for row in paired
        ]
        headings = (
            "Comparison",
            "Seed",
            "Difference (points)",
            "Only first reaches",
            "Only second reaches",
            "p (exact McNemar)",
        )
        tests = f"{len(paired)} test{'' if len(paired) == 1 else 's'}"
        yield Table(headings, cells)
        yield (
            "Each test compares two trained policies on the same positions; it says nothing about other seeds. "
            f"The p-values are not corrected: with {tests}, {0.05 / len(paired):.2g} each keeps the chance of one false "
            "alarm at 5 %."
        )


def _limits(seeds: int) -> str:
    """What so few seeds can and cannot show, in sentences."""
    flat = "An interval of no width means that every draw gave the same, not that nothing else could happen."
    if seeds == 1:
        return f"With one seed the intervals cover the positions alone: they say nothing about training again. {flat}"
    draws, factor = math.comb(2 * seeds - 1, seeds), math.sqrt((seeds - 1) / seeds)
    least = 2 / math.comb(2 * seeds, seeds)
    return (
        f"The intervals draw seeds, then positions. {seeds} seeds allow only {draws} different draws and understate the "
        f"spread between trainings (by a factor of about {factor:.2g}), and no test that exchanges {seeds} seeds against "
        f"{seeds} can give a p-value below {least:.2g}. So {seeds} seeds can show a difference that is much larger than the "
        f"spread between them; they cannot show that a difference of a few points is there, nor that it is not. {flat}"
    )


def _points(difference: float) -> str:
    return f"{round(100.0 * difference, 1):+g}"
