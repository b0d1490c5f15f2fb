"""The paper's table with its tolerance fitted: on validation positions, for method B, and then the test."""

from __future__ import annotations

import csv

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from tests.report.runs import add_evaluation, add_settled, lines, remarks
from uarm_rl.report import figures, statistics
from uarm_rl.report.records import METHODS
from uarm_rl.report.report import report


def add_all(results) -> None:
    """B settles within 7 mm in three of four validation positions with both seeds together."""
    for label, distances in {"A": (1, 2, 3, 4), "B": (4, 5, 9, 8), "C": (1, 1, 1, 6.9), "D": (3, 7.1, 8, None)}.items():
        for seed in (0, 1):
            add_evaluation(results, label, seed, "1111" if label in "AC" else "1000")
            add_settled(results, label, seed, *distances)
    add_settled(results, "B", 0, 3, 4, 7, 20, validation=True)
    add_settled(results, "B", 1, 5, 6, 6.5, None, validation=True)
    add_settled(results, "A", 0, 100, 100, 100, 100, validation=True)  # of no interest


def test_the_tolerance_is_fitted_on_validation_positions_and_all_methods_are_tested_with_it(tmp_path):
    add_all(tmp_path)
    report(tmp_path, {})
    with open(tmp_path / "paper_fit.csv", newline="") as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["A", "B", "C", "D"]
    assert {row["tolerance_m"] for row in rows.values()} == {"0.007"}  # the sixth of eight
    low, high = (float(rows["A"][f"tolerance_{end}_m"]) for end in ("low", "high"))
    assert 0.003 <= low < 0.007 < high
    assert [row["success_rate"] for row in rows.values()] == ["1", "0.5", "1", "0.25"]
    assert [row["trained_success_rate"] for row in rows.values()] == ["1", "0.25", "1", "0.25"]
    assert [row["paper_success_rate"] for row in rows.values()] == ["0.99", "0.75", "1", "0.8"]
    assert {row["seeds"] for row in rows.values()} == {"2"}
    table = lines(tmp_path, "paper_fit.md")
    assert table[0] == (
        "| Method | Buffer | Reward | Seeds | Paper | Success at 7.0 mm (95 % interval) | Success at 5 mm (95 % interval) |"
    )
    assert table[3].startswith("| B | uniform | plain | 2 | 75 % | 50 % (")
    assert table[-1].startswith("7.0 mm (")
    assert "75 % on the 4 validation positions" in table[-1]
    assert (tmp_path / "paper_fit.png").read_bytes().startswith(b"\x89PNG")


def test_what_is_missing_is_told_and_nothing_is_fitted_to_nothing(tmp_path):
    add_evaluation(tmp_path, "B", 0, "1000")
    text = report(tmp_path, {})
    assert not list(tmp_path.glob("paper_fit*"))
    (remark,) = remarks(text, "the paper's table at a fitted tolerance, missing: settled-validation.csv (1 of 1 runs)")
    assert (
        f"`uarm-rl evaluate until=time_limit positions=validation out=settled-validation.csv results_dir={tmp_path}`" in remark
    )
    add_settled(tmp_path, "B", 0, 4, 5, None, None, validation=True)  # at no tolerance it has the paper's 75 %
    add_settled(tmp_path, "B", 0, 4, 5, 6, 7)
    report(tmp_path, {})
    assert not list(tmp_path.glob("paper_fit*"))


def test_the_interval_of_a_quantile_is_that_of_draws_one_by_one():
    generator = np.random.default_rng(3)
    values = generator.gamma(3.0, 2.0, (3, 20))
    values[0, :2] = np.inf
    low, high = statistics.quantile_interval(values, 0.75, np.random.default_rng(0), resamples=4000)
    drawn = [
        statistics.quantile(values[generator.integers(3, size=3)][:, generator.integers(20, size=20)], 0.75)
        for _ in range(4000)
    ]
    assert (low, high) == pytest.approx(tuple(statistics.quantile(drawn, share) for share in (0.025, 0.975)), rel=0.1)
    assert low < statistics.quantile(values, 0.75) < high
    assert statistics.quantile([4.0, 1.0, 2.0, 3.0], 0.75) == 3.0
    assert statistics.quantile([1.0, np.inf], 0.75) == np.inf


def test_the_picture_has_a_line_a_method_and_the_papers_values(tmp_path):
    add_all(tmp_path)
    report(tmp_path, {})
    points = pd.read_csv(tmp_path / "paper_fit.csv")
    curve = pd.DataFrame({"tolerance_mm": [1.0, 5.0, 9.0], "success_rate": [0.1, 0.5, 1.0]})
    figure = Figure()
    figures.draw_paper_fit(figure, METHODS, {method.label: curve for method in METHODS}, points)
    (axes,) = figure.axes
    steps = [line for line in axes.lines if len(line.get_xdata()) == 4]
    assert len({str(line.get_linestyle()) for line in steps}) == len({str(line.get_color()) for line in steps}) == 4
    hollow = [line for line in axes.lines if line.get_fillstyle() == "none"]
    assert [float(line.get_ydata()[0]) for line in hollow] == [0.99, 0.75, 1.0, 0.8]
    assert {label for label in axes.get_legend_handles_labels()[1]} == {method.words for method in METHODS}
    assert "hollow" in axes.get_xlabel()
