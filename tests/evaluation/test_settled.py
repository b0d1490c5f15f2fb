"""How near the cup comes to stay: one test that success does not end tells the success of every other."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import needs_pybullet
from uarm_rl import columns, configuration
from uarm_rl.checks import UsageError
from uarm_rl.commands import evaluate
from uarm_rl.evaluation.measures import settled_distance_m
from uarm_rl.task import positions

RUNS = Path(__file__).parents[2] / "results"


def evaluated(folder: Path, run: str, name: str, *words: str) -> list[dict[str, str]]:
    """The rows of a test of a published policy on some validation positions."""
    out = folder / name
    run_words = (f"run={RUNS / run}", f"positions={folder / 'where.csv'}", f"out={out}", "workers=1")
    evaluate.run(configuration.compose("evaluate", (*run_words, *words)))
    with open(out, newline="") as file:
        return list(csv.DictReader(file))


@needs_pybullet
@pytest.mark.parametrize("run", ["uniform-plain/seed1", "uniform-penalty/seed0", "rigid_arm/seed0"])
def test_success_at_any_tolerance_is_a_comparison_with_the_settled_distance(tmp_path, run):
    positions.save(tmp_path / "where.csv", positions.load_named("validation")[:7])
    rows = evaluated(tmp_path, run, "settled.csv", "until=time_limit", "traces=7")
    settled = [float(row["settled_distance_m"]) for row in rows]
    middle = sorted(settled)[3]
    for number, tolerance in enumerate([0.002, 0.005, 0.007, 0.012, middle * (1 + 1e-7), middle * (1 - 1e-7)]):
        ended = evaluated(tmp_path, run, f"{number}.csv", f"tolerance_m={tolerance!r}")
        assert [row["success"] == "1" for row in ended] == [distance <= tolerance for distance in settled], tolerance
    assert [row["success"] == "1" for row in rows] == [distance <= 0.005 for distance in settled]  # the trained tolerance
    assert {row["tolerance_m"] for row in rows} == {"0.005"}
    assert list(rows[0]) == [name for name in columns.EVALUATION if name not in columns.TOUCHING]
    assert sorted({row["time_s"] for row in rows})[0] == "10"  # but where the object was pushed out of reach
    with open(tmp_path / "settled-traces.csv", newline="") as file:
        trace = np.array(
            [[float(row[name]) for name in columns.STATE] for row in csv.DictReader(file) if row["position"] == "0"]
        )
    assert settled_distance_m(trace, 10) == pytest.approx(settled[0], abs=2e-6)


def test_windows_are_of_so_many_looks_and_the_start_is_none_of_them():
    trace = np.zeros((6, 9))
    trace[:, 3] = [0.0, 0.4, 0.1, 0.2, 0.3, 0.1]
    assert [settled_distance_m(trace, steps) for steps in (1, 2, 3, 5)] == pytest.approx([0.1, 0.2, 0.3, 0.4])
    assert math.isnan(settled_distance_m(trace, 6))  # it ended before anybody could have stayed so long


def test_it_is_a_test_of_its_own(tmp_path):
    for words, sentence in (
        ((), "until changes the test, so give out=FILE"),
        (("out=o.csv", "until=never"), "until must be success or"),
    ):
        settings = configuration.compose("evaluate", (f"run={RUNS / 'uniform-plain' / 'seed1'}", "until=time_limit", *words))
        with pytest.raises((UsageError, ValueError), match=sentence):
            evaluate.run(settings | ({"out": str(tmp_path / "o.csv")} if words else {}))
