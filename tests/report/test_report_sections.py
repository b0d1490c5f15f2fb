"""The sections beside Table 1: golden tables from small CSV files, what they say of missing data, bad files."""

from __future__ import annotations

import csv
from base64 import b64encode
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.report.runs import NAMES, add_ablations, add_evaluation, add_progress, lines, remarks, write
from uarm_rl.configuration import compose
from uarm_rl.report import statistics
from uarm_rl.report.comparisons import comparisons
from uarm_rl.report.records import METHODS, ReportError
from uarm_rl.report.report import report

# Comparisons


def test_two_methods_are_compared_seed_by_seed_and_over_seeds(tmp_path):
    for seed in (0, 1):
        add_evaluation(tmp_path, "A", seed, "11111111")
        add_evaluation(tmp_path, "B", seed, "00000000" if seed else "00000011")
    add_evaluation(tmp_path, "B", 2, "00000000")
    text = report(tmp_path, {})
    low = statistics.bootstrap_interval([np.ones((2, 8)), [[0] * 6 + [1] * 2, [0] * 8, [0] * 8]], [1, -1], bootstrap())[0]
    assert lines(tmp_path, "comparisons.csv") == [
        "comparison,seed,seeds,difference,ci_low,ci_high,first_only,second_only,p_value",
        "A-B,0,1,0.75,,,6,0,0.03125",
        "A-B,1,1,1,,,8,0,0.0078125",
        f"A-B,all,2,0.916667,{low:.6g},1,,,",
    ]
    unknown = "C-D, A-C, B-D, adaptive-uniform, penalty-plain, interaction"
    assert remarks(text, "not compared") == [f"not compared, because a method of theirs is not evaluated: {unknown}"]


def bootstrap() -> np.random.Generator:
    """The report's fixed generator."""
    return np.random.default_rng(20190701)


def test_the_two_by_two_in_words(tmp_path):
    for seed in range(3):
        for name, successes in zip("ABCD", ("1111", "0111", "1111", "0000"), strict=True):
            add_evaluation(tmp_path, name, seed, successes)
    text = report(tmp_path, {})
    table = lines(tmp_path, "comparisons.md")
    assert table[:2] == [
        "| Comparison | Seeds | Difference (points of success) | 95 % interval |",
        "| --- | ---: | ---: | ---: |",
    ]
    assert [line.split(" | ")[:3] for line in table[2:9]] == [
        ["| A-B", "3", "+25"],
        ["| C-D", "3", "+100"],
        ["| A-C", "3", "+0"],
        ["| B-D", "3", "+75"],
        ["| adaptive-uniform (mean of A-B and C-D)", "3", "+62.5"],
        ["| penalty-plain (mean of C-A and D-B)", "3", "-37.5"],
        ["| interaction (C-D less A-B)", "3", "+75"],
    ]
    said = "\n".join(table)
    assert "3 seeds allow only 10 different draws" in said
    assert "by a factor of about 0.82" in said
    assert "a p-value below 0.1." in said
    assert "with 12 tests, 0.0042 each" in said
    assert "| B-D | 2 | +75 | 3 | 0 | 0.25 |" in table
    assert not remarks(text, "not compared")


def test_one_seed_says_nothing_about_training_again(tmp_path):
    for name in "AB":
        add_evaluation(tmp_path, name, 0, "10")
    report(tmp_path, {})
    assert "With one seed the intervals cover the positions alone" in "\n".join(lines(tmp_path, "comparisons.md"))


outcomes = st.integers(1, 4).flatmap(
    lambda seeds: st.lists(st.lists(st.integers(0, 1), min_size=5, max_size=5), min_size=seeds, max_size=seeds)
)


@settings(max_examples=20)
@given(st.fixed_dictionaries(dict.fromkeys("ABCD", outcomes)))
def test_comparisons_agree_with_each_other(seeds_of):
    evaluations = {
        method.folder: pd.DataFrame(
            {"seed": seed, "position": position, "success": float(success), "engine": "pybullet"}
            for seed, of_seed in enumerate(seeds_of[method.label])
            for position, success in enumerate(of_seed)
        )
        for method in METHODS
    }
    section = comparisons(evaluations)
    assert section.remarks == []
    rows = list(csv.DictReader(section.contents["comparisons.csv"].decode().splitlines()))
    for row in rows:
        if row["seed"] == "all":
            assert float(row["ci_low"]) <= float(row["ci_high"])
        else:
            balance = int(row["first_only"]) - int(row["second_only"])
            assert float(row["difference"]) == pytest.approx(balance / 5)
            assert 0 < float(row["p_value"]) <= 1
    whole = {row["comparison"]: float(row["difference"]) for row in rows if row["seed"] == "all"}
    rate = {label: np.mean(of_method) for label, of_method in seeds_of.items()}
    assert whole["A-B"] == pytest.approx(rate["A"] - rate["B"], abs=1e-5)
    assert whole["adaptive-uniform"] == pytest.approx((whole["A-B"] + whole["C-D"]) / 2, abs=1e-5)
    assert whole["penalty-plain"] == pytest.approx(-(whole["A-C"] + whole["B-D"]) / 2, abs=1e-5)
    assert whole["interaction"] == pytest.approx(whole["C-D"] - whole["A-B"], abs=1e-5)


# Other conditions


def test_tolerance_curve(tmp_path):
    add_evaluation(tmp_path, "A", 0, "1110")
    add_evaluation(tmp_path, "A", 0, "1111", "tolerance-10mm.csv", tolerance_m="0.01")
    add_evaluation(tmp_path, "A", 0, "0000", "tolerance-1mm.csv", tolerance_m="0.001")
    add_evaluation(tmp_path, "B", 0, "1000", old="")
    add_evaluation(tmp_path, "B", 0, "1100", "tolerance-10mm.csv", tolerance_m="0.01")
    text = report(tmp_path, {})

    def interval(successes: int) -> str:
        return "{:.6g},{:.6g}".format(*statistics.wilson_interval(successes, 4))

    assert lines(tmp_path, "tolerance.csv") == [
        "method,tolerance_m,seeds,success_rate,ci_low,ci_high",
        f"A,0.001,1,0,{interval(0)}",
        f"A,0.005,1,0.75,{interval(3)}",
        f"A,0.01,1,1,{interval(4)}",
        f"B,0.01,1,0.5,{interval(2)}",  # nobody knows at which tolerance B's older evaluation.csv was made
    ]
    assert remarks(text, "tolerance curve, missing") == [
        "tolerance curve, missing: tolerance-1mm.csv (1 of 2 runs), tolerance-2mm.csv (2 of 2 runs); "
        f"`uarm-rl evaluate tolerance_m=1e-3 out=tolerance-1mm.csv results_dir={tmp_path}` makes it"
    ]


def test_held_out_positions_beside_the_test_positions(tmp_path):
    add_evaluation(tmp_path, "A", 0, "11")
    add_evaluation(tmp_path, "A", 1, "11")
    add_evaluation(tmp_path, "A", 1, "1110", "heldout.csv")
    add_evaluation(tmp_path, "B", 0, "10")
    add_evaluation(tmp_path, "IK", 0, "11")
    add_evaluation(tmp_path, "IK", 0, "1110", "heldout.csv")
    text = report(tmp_path, {})
    test, held_out = statistics.wilson_interval(2, 2), statistics.wilson_interval(3, 4)
    assert lines(tmp_path, "heldout.csv") == [
        "method,positions,count,seeds,success_rate,ci_low,ci_high,return,common_return",
        f"A,test,2,2,1,{test[0]:.6g},{test[1]:.6g},-1.5,-2.5",
        f"A,held-out,4,1,0.75,{held_out[0]:.6g},{held_out[1]:.6g},-2,-2.5",
        f"IK,test,2,1,1,{test[0]:.6g},{test[1]:.6g},,-2.5",
        f"IK,held-out,4,1,0.75,{held_out[0]:.6g},{held_out[1]:.6g},,-2.5",
    ]
    assert lines(tmp_path, "heldout.md") == [
        "| Method | Positions | Seeds | Success (95 % interval) | Return (own reward) | Return (same reward) |",
        "| --- | --- | ---: | ---: | ---: | ---: |",
        "| A | 2 test | 2 | 100 % (34.2 to 100 %) | -1.50 | -2.50 |",
        "| A | 4 held-out | 1 | 75 % (30.1 to 95.4 %) | -2.00 | -2.50 |",
        "| IK | 2 test | 1 | 100 % (34.2 to 100 %) | - | -2.50 |",
        "| IK | 4 held-out | 1 | 75 % (30.1 to 95.4 %) | - | -2.50 |",
    ]
    assert "heldout.csv (2 of 4 runs)" in remarks(text, "held-out positions, missing")[0]


def test_who_leans_on_the_object(tmp_path):
    def add(seed, successes, file, press_m, **conditions):
        further = {"reference_press_m": str(2 * press_m), "contact_n": "0.5", "object": "solid", "cup": "rigid"} | conditions
        add_evaluation(tmp_path, "A", seed, successes, file, press_m=str(press_m), **further)

    add(0, "11", "evaluation.csv", 0.001)
    add(1, "11", "evaluation.csv", 0.003)
    add(0, "10", "ghost.csv", 0.012, object="ghost", contact_n="0")
    add(0, "11", "bellows.csv", 0.004, cup="bellows", contact_n="7.25")
    add_evaluation(tmp_path, "B", 0, "11", old="")  # older than the columns
    text = report(tmp_path, {})
    half = statistics.wilson_interval(1, 2)
    table = lines(tmp_path, "leaning.csv")
    assert table[0].startswith(
        "method,trained_with,episodes,object,cup,seeds,success_rate,ci_low,ci_high,press_median_m,press_99_m,press_most_m,"
    )
    assert table[1].startswith("A,,,solid,rigid,2,1,")
    assert table[2] == f"A,,,ghost,rigid,1,0.5,{half[0]:.6g},{half[1]:.6g},0.012,0.012,0.012,0.024,0.024,0.024,0,0,0"
    assert [row.split(",")[3:5] for row in table[1:]] == [["solid", "rigid"], ["ghost", "rigid"], ["solid", "bellows"]]
    cells = lines(tmp_path, "leaning.md")
    assert cells[2].endswith("| 2.0, 3.0, 3.0 | 4.0, 6.0 | 0.5, 0.5, 0.5 |")
    assert cells[3].endswith("| 12.0, 12.0, 12.0 | 24.0, 24.0 | - |")
    assert cells[4].endswith("| 7.2, 7.2, 7.2 |")
    assert "ghost.csv (2 of 3 runs)" in remarks(text, "leaning on what is not solid or gives, missing")[0]
    assert lines(tmp_path, "table1.csv")[0].endswith(",press_m,contact_n")
    assert lines(tmp_path, "table1.csv")[1].endswith(",0.002,0.5")
    assert lines(tmp_path, "table1.csv")[2].endswith(",,")


def test_train_hold_by_test_hold(tmp_path):
    for name, hold in (("A", "until_steady(2..40)"), ("B", "fixed(1)")):
        add_evaluation(tmp_path, name, 0, "1111", hold=hold)
        add_evaluation(tmp_path, name, 0, "1100", "hold-fixed.csv", hold="fixed(11)")
        add_evaluation(tmp_path, name, 0, "1110", "hold-one_step.csv", hold="fixed(1)")
    add_evaluation(tmp_path, "A", 0, "1111", "hold-until_steady.csv", hold="until_steady(2..40)")
    report(tmp_path, {})
    half, three, four = "50 % (15 to 85 %)", "75 % (30.1 to 95.4 %)", "100 % (51 to 100 %)"
    assert lines(tmp_path, "holds.md")[0] == (
        "| Method | Trained with | Tested with one step | Tested with 11 steps | Tested with until steady |"
    )
    assert lines(tmp_path, "holds.md")[2:] == [
        f"| A | until steady | {three} | {half} | **{four}** |",
        f"| B | one step | **{three}** | {half} | - |",
    ]
    assert [line.split(",")[:5] for line in lines(tmp_path, "holds.csv")[1:]] == [
        ["A", "until_steady(2..40)", "fixed(1)", "1", "0.75"],
        ["B", "fixed(1)", "fixed(1)", "1", "0.75"],
        ["A", "until_steady(2..40)", "fixed(11)", "1", "0.5"],
        ["B", "fixed(1)", "fixed(11)", "1", "0.5"],
        ["A", "until_steady(2..40)", "until_steady(2..40)", "1", "1"],
    ]


def test_a_bad_further_evaluation_is_named(tmp_path):
    add_evaluation(tmp_path, "A", 0, "11")
    add_evaluation(tmp_path, "A", 0, "12", "hold-fixed.csv")
    with pytest.raises(
        ReportError, match=r"hold-fixed\.csv, line 3: success is '2' .* evaluate again, with out=hold-fixed\.csv"
    ):
        report(tmp_path, {})
    add_evaluation(tmp_path, "A", 0, "11", "hold-fixed.csv")
    add_evaluation(tmp_path, "B", 0, "11")
    add_evaluation(tmp_path, "B", 0, "111", "hold-fixed.csv")
    with pytest.raises(ReportError, match=r"hold-fixed|different positions; delete one"):
        report(tmp_path, {})
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == []


# Shaking


def add_traces(results: Path, name: str, seed: int, *positions: int) -> None:
    """Each position takes four control steps, and position 1 five."""
    rows = [
        {"position": position, "step": step, "time_s": step / 20, "joint1_rad": 0.1, "joint2_rad": 0.2, "joint3_rad": 0.3}
        | {f"{what}_{axis}_m": 0.2 + 0.01 * seed * step for what in ("cup", "object") for axis in "xyz"}
        for position in positions
        for step in range(4 + (position == 1))
    ]
    write(results / NAMES[name] / f"seed{seed}" / "evaluation-traces.csv", rows)


def test_shaking_is_drawn_from_the_lowest_seeds_that_recorded_it(tmp_path):
    for name in "AB":
        for seed in (2, 10):
            add_evaluation(tmp_path, name, seed, "11")
    assert remarks(report(tmp_path, {}), "no shaking.png")[0].endswith(
        f"`uarm-rl evaluate traces=3 results_dir={tmp_path}` records it"
    )
    add_traces(tmp_path, "A", 2, 0, 1)
    add_traces(tmp_path, "A", 10, 0, 1)
    assert not (tmp_path / "shaking.png").exists()  # B is still missing
    add_traces(tmp_path, "B", 10, 1)
    report(tmp_path, {})
    first = (tmp_path / "shaking.png").read_bytes()
    add_traces(tmp_path, "A", 10, 1)  # another seed than the lowest: no matter
    report(tmp_path, {})
    assert (tmp_path / "shaking.png").read_bytes() == first
    add_traces(tmp_path, "B", 2, 1)
    report(tmp_path, {})
    assert (tmp_path / "shaking.png").read_bytes() != first


def test_shaking_is_shown_where_the_uniform_method_takes_longest(tmp_path):
    def drawn(*positions: int) -> bytes:
        for name in "AB":
            add_traces(tmp_path, name, 0, *positions)
        report(tmp_path, {})
        return (tmp_path / "shaking.png").read_bytes()

    for name in "AB":
        add_evaluation(tmp_path, name, 0, "111")
    assert drawn(0, 1, 2) == drawn(1) != drawn(0)
    assert drawn(0, 2) == drawn(0) != drawn(2)  # the lower of two that take as long


# Budgets


def test_budgets_and_steps_to_95(tmp_path):
    add_progress(tmp_path, "A", 0, "", "0.94", "0.96", "0.9", steps_per_decision=10)
    add_progress(tmp_path, "A", 1, "", "0.95", "0.2", "", steps_per_decision=10)
    add_progress(tmp_path, "B", 0, "", "0.5")
    for name, seed in (("A", 0), ("A", 1), ("B", 0)):
        add_evaluation(tmp_path, name, seed, "11")
    text = report(tmp_path, {})
    assert lines(tmp_path, "budgets.csv") == [
        "method,episode,seeds,experiences,updates,decisions,control_steps,simulated_s,"
        "validation_success_rate_mean,validation_success_rate_min,validation_success_rate_max",
        "A,2,2,400,300,800,8000,400,0.945,0.94,0.95",
        "A,3,2,600,500,1200,12000,600,0.58,0.2,0.96",
        "A,4,1,800,700,1600,16000,800,0.9,0.9,0.9",
        "B,2,1,400,300,800,800,40,0.5,0.5,0.5",
    ]
    assert lines(tmp_path, "steps_to_95.csv") == [
        "method,seed,episode,experiences,updates,decisions,control_steps,simulated_s",
        "A,0,3,600,500,1200,12000,600",
        "A,1,2,400,300,800,8000,400",
        "B,0,,,,,,",
    ]
    steps = "500 (400 to 600) | 400 (300 to 500) | 1,000 (800 to 1,200) | 10,000 (8,000 to 12,000) | 500 (400 to 600)"
    assert lines(tmp_path, "steps_to_95.md")[2:4] == [f"| A | 2 of 2 | {steps} |", "| B | 0 of 1 | - | - | - | - | - |"]
    assert not remarks(text, "budgets in control steps")


def test_budgets_stay_control_steps_where_nobody_tells_their_rate(tmp_path):
    add_progress(tmp_path, "A", 0, "0.5")
    add_progress(tmp_path, "B", 0, "0.5")
    add_evaluation(tmp_path, "A", 0, "11")
    add_evaluation(tmp_path, "B", 0, "11", old="")
    assert len(remarks(report(tmp_path, {}), "budgets in control steps, not seconds")) == 1
    assert [line.split(",")[6:8] for line in lines(tmp_path, "budgets.csv")[1:]] == [["400", "20"], ["400", ""]]


def test_everything_again_is_the_same_to_the_last_byte(tmp_path):
    for seed in (0, 1):
        for name in "ABCD":
            add_evaluation(tmp_path, name, seed, "110")
            add_evaluation(tmp_path, name, seed, "11011", "heldout.csv")
            add_evaluation(tmp_path, name, seed, "100", "tolerance-1mm.csv", tolerance_m="0.001")
            add_evaluation(tmp_path, name, seed, "110", "hold-fixed.csv", hold="fixed(11)")
            add_progress(tmp_path, name, seed, "0.5", "0.96")
            add_traces(tmp_path, name, seed, 0)
    add_ablations(tmp_path)
    text = report(tmp_path, compose("train"))
    first = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert report(tmp_path, compose("train")) == text
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == first
    written = {str(path.relative_to(tmp_path)) for path in first if "seed" not in str(path.relative_to(tmp_path))}
    assert len(written) == 22 + 10
    assert {line for line in text.splitlines() if line.startswith("wrote ")} == {f"wrote {tmp_path / name}" for name in written}


def test_trials_on_an_arm_stand_beside_the_papers_and_an_emulated_arm_is_never_called_real(tmp_path):
    add_evaluation(tmp_path, "C", 0, "11")
    assert not (tmp_path / "arm_trials.csv").exists()
    real = tmp_path / "short" / "real_arm" / "seed0" / "real"
    write(real / "trials.csv", [{"success": int(n > 1), "reached": 1, "emulated": 1, "reason": ""} for n in range(20)])
    write(tmp_path / "real_arm" / "seed1" / "real-desk" / "trials.csv", [{"success": 1, "reached": 1, "emulated": 0}] * 4)
    (real / "pictures").mkdir()  # where run-real puts them
    for name, data in (("trial-002.png", b"\x89PNG two"), ("trial-001.png", b"\x89PNG one"), ("notes.txt", b"no picture")):
        (real / "pictures" / name).write_bytes(data)
    report(tmp_path, {})
    page = (tmp_path / "report.html").read_text()
    photos = [page.index(b64encode(data).decode()) for data in (b"\x89PNG one", b"\x89PNG two")]
    assert photos == sorted(photos)
    assert b64encode(b"no picture").decode() not in page
    low, high = statistics.wilson_interval(18, 20)
    assert lines(tmp_path, "arm_trials.csv") == [
        "trials_of,arm,trials,success_rate,ci_low,ci_high,reached_rate",
        "real_arm/seed1/real-desk,real,4,1,0.510109,1,1",
        f"short/real_arm/seed0/real,emulated,20,0.9,{low:.6g},{high:.6g},1",
        "the paper's method C,real,50,0.8,0.669629,0.887562,",
    ]
    assert "| short/real_arm/seed0/real | emulated | 20 | 90 % (69.9 to 97.2 %) | 100 % |" in lines(tmp_path, "arm_trials.md")
    write(real / "trials.csv", [{"success": 2, "reached": 1, "emulated": 1}])
    sentence = "line 2: success is '2' and must be 0 or 1; delete it, or restore it"
    with pytest.raises(ReportError, match=sentence):
        report(tmp_path, {})
