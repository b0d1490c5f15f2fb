"""The sections beside Table 1: golden tables from small CSV files, what they say of missing data, bad files."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uarm_rl.report import statistics
from uarm_rl.report.comparisons import comparisons
from uarm_rl.report.records import METHODS, ReportError
from uarm_rl.report.report import report

CONDITIONS = {"tolerance_m": "0.005", "hold": "fixed(1)", "control_hz": "20", "servo_rise_s": "0.327", "sigma": "-5"}
NAMES = {"A": "adaptive-plain", "B": "uniform-plain", "C": "adaptive-penalty", "D": "uniform-penalty"}


def write(path: Path, rows: list[dict[str, object]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def add_evaluation(
    results: Path, name: str, seed: int, successes: str, file: str = "evaluation.csv", moved_m: float = 0.001, **conditions: str
) -> None:
    """An evaluation with one position for each digit of ``successes``; ``old=""`` leaves the conditions out."""
    known = {} if "old" in conditions else CONDITIONS | conditions
    measured = {"time_s": 2, "object_displacement_m": moved_m, "reversals_per_s": 0.25, "rms_jerk": 12.5}
    rows = [
        {"position": position, "success": success, "return": -1 - seed, "common_return": -2.5, **measured}
        | {"tip_travel_last_s_m": 0.0125, **known}
        for position, success in enumerate(successes)
    ]
    write(results / NAMES.get(name, name) / f"seed{seed}" / file, rows)


def add_progress(results: Path, name: str, seed: int, *rates: str, steps_per_decision: int = 1, missing: int = 0) -> None:
    """A log with one episode of 200 experiences, but for ``missing``, for each validation success rate, empty for none."""
    rows = [
        {"episode": episode, "experiences": 200 * episode - missing, "control_steps": 400 * steps_per_decision * episode}
        | {"updates": 200 * episode - 100, "decisions": 400 * episode, "episode_return": -episode}
        | {"validation_success_rate": rate, "successes": 1, "object_losses": 0, "object_moved_m": 0.003}
        for episode, rate in enumerate(rates, start=1)
    ]
    write(results / NAMES.get(name, name) / f"seed{seed}" / "progress.csv", rows)


def lines(results: Path, name: str) -> list[str]:
    return (results / name).read_text().splitlines()


def remarks(text: str, start: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith(start)]


# Comparisons


def test_two_methods_are_compared_seed_by_seed_and_over_seeds(tmp_path):
    for seed in (0, 1):
        add_evaluation(tmp_path, "A", seed, "11111111")
        add_evaluation(tmp_path, "B", seed, "00000000" if seed else "00000011")
    add_evaluation(tmp_path, "B", 2, "00000000")
    text = report(tmp_path)
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
    text = report(tmp_path)
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
    report(tmp_path)
    assert "With one seed the intervals cover the positions alone" in "\n".join(lines(tmp_path, "comparisons.md"))


outcomes = st.integers(1, 4).flatmap(
    lambda seeds: st.lists(st.lists(st.integers(0, 1), min_size=5, max_size=5), min_size=seeds, max_size=seeds)
)


@settings(max_examples=20, deadline=None)
@given(st.fixed_dictionaries(dict.fromkeys("ABCD", outcomes)))
def test_comparisons_agree_with_each_other(seeds_of):
    evaluations = {
        method.folder: pd.DataFrame(
            {"seed": seed, "position": position, "success": float(success)}
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
    text = report(tmp_path)

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
    text = report(tmp_path)
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


def test_train_hold_by_test_hold(tmp_path):
    for name, hold in (("A", "until_steady(2..40)"), ("B", "fixed(1)")):
        add_evaluation(tmp_path, name, 0, "1111", hold=hold)
        add_evaluation(tmp_path, name, 0, "1100", "hold-fixed.csv", hold="fixed(11)")
        add_evaluation(tmp_path, name, 0, "1110", "hold-one_step.csv", hold="fixed(1)")
    add_evaluation(tmp_path, "A", 0, "1111", "hold-until_steady.csv", hold="until_steady(2..40)")
    report(tmp_path)
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
        report(tmp_path)
    add_evaluation(tmp_path, "A", 0, "11", "hold-fixed.csv")
    add_evaluation(tmp_path, "B", 0, "11")
    add_evaluation(tmp_path, "B", 0, "111", "hold-fixed.csv")
    with pytest.raises(ReportError, match=r"hold-fixed|different positions; delete one"):
        report(tmp_path)
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
    assert remarks(report(tmp_path), "no shaking.png")[0].endswith(
        f"`uarm-rl evaluate traces=3 results_dir={tmp_path}` records it"
    )
    add_traces(tmp_path, "A", 2, 0, 1)
    add_traces(tmp_path, "A", 10, 0, 1)
    assert not (tmp_path / "shaking.png").exists()  # B is still missing
    add_traces(tmp_path, "B", 10, 1)
    report(tmp_path)
    first = (tmp_path / "shaking.png").read_bytes()
    add_traces(tmp_path, "A", 10, 1)  # another seed than the lowest: no matter
    report(tmp_path)
    assert (tmp_path / "shaking.png").read_bytes() == first
    add_traces(tmp_path, "B", 2, 1)
    report(tmp_path)
    assert (tmp_path / "shaking.png").read_bytes() != first


def test_shaking_is_shown_where_the_uniform_method_takes_longest(tmp_path):
    def drawn(*positions: int) -> bytes:
        for name in "AB":
            add_traces(tmp_path, name, 0, *positions)
        report(tmp_path)
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
    text = report(tmp_path)
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
    assert len(remarks(report(tmp_path), "budgets in control steps, not seconds")) == 1
    assert [line.split(",")[6:8] for line in lines(tmp_path, "budgets.csv")[1:]] == [["400", "20"], ["400", ""]]


# Ablations


def add_ablations(results: Path) -> None:
    steady = {"hold": "until_steady(2..40)"}
    runs = {
        "uniform-penalty": ("0001", {}),
        "unstuck_only-penalty": ("0011", {}),
        "steady_only-penalty": ("0111", steady),
        "adaptive-penalty": ("1111", steady),
        "fixed_hold-penalty": ("1101", {"hold": "fixed(11)"}),
        "servo-10-uniform-penalty": ("0111", {"servo_rise_s": "0.163"}),
        "servo-10-adaptive-penalty": ("1111", {"servo_rise_s": "0.163"}),
        "long-servo-10-uniform-penalty": ("1111", {"servo_rise_s": "0.163"}),
        "instant-uniform-penalty": ("1111", {"servo_rise_s": "0.039"}),
        "instant-adaptive-penalty": ("1111", {"servo_rise_s": "0.039"}),
        "adaptive-plain": ("1111", {"sigma": "0"}),
        "sigma-20-adaptive": ("1110", {"sigma": "-20", "moved_m": 0.0005}),
        "dwell0.25-uniform": ("0011", {}),
        "dwell0.25-adaptive": ("1111", {}),
        "gamma0.99-uniform": ("1011", {}),
    }
    for name, (successes, conditions) in runs.items():
        add_evaluation(results / "ablations", name, 0, successes, **conditions)
        steps = 11 if "uniform" not in name else 1
        add_progress(results / "ablations", name, 0, "0.5", "0.75", steps_per_decision=steps)


def test_ablations_answer_each_question(tmp_path):
    add_ablations(tmp_path)
    text = report(tmp_path)  # no run of the paper is needed
    folder = tmp_path / "ablations"
    with open(folder / "ablations.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        *("question", "run", "buffer", "seeds", "success_rate", "ci_low", "ci_high"),
        *("object_displacement_m", "object_displacement_low", "object_displacement_high"),
        *("training_displacement_m", "control_steps_per_decision", "servo_rise_s", "sigma", "setting"),
    ]

    def of(question: str, column: str) -> list[str]:
        return [row[column] for row in rows if row["question"] == question]

    assert of("halves", "buffer") == ["uniform", "unstuck_only", "steady_only", "adaptive"]
    assert of("halves", "success_rate") == ["0.25", "0.5", "0.75", "1"]
    assert of("fixed_hold", "buffer") == ["uniform", "fixed_hold", "adaptive"]
    assert of("fixed_hold", "control_steps_per_decision") == ["1", "11", "11"]
    assert of("servo", "servo_rise_s") == ["0.039", "0.039", "0.163", "0.163", "0.163", "0.327", "0.327"]
    both = ["adaptive", "uniform"]
    assert of("servo", "buffer") == [*both, *both, "uniform, 2 episodes", *both]
    assert of("sigma", "sigma") == ["0", "-5", "-20"]
    assert of("sigma", "training_displacement_m") == ["0.0015"] * 3  # 3 mm in each of two episodes, of four objects
    assert of("constants", "setting") == ["default", "default", "gamma 0.99", "dwell 0.25 s", "dwell 0.25 s"]
    assert set(of("servo", "setting") + of("sigma", "setting")) == {""}
    assert of("constants", "success_rate") == ["0.25", "1", "0.75", "1", "0.5"]
    assert of("sigma", "object_displacement_m") == ["0.001", "0.001", "0.0005"]
    markdown = (folder / "ablations.md").read_text()
    assert [line for line in markdown.splitlines() if line.startswith("| sigma-20")] == [
        "| sigma-20-adaptive | 1 | 75 % (30.1 to 95.4 %) | -20 | 11 | 0.5 | 1.5 |"
    ]
    assert "| dwell0.25-uniform | 1 | 50 % (15 to 85 %) | dwell 0.25 s | 1 | 1.0 | 1.5 |" in markdown.splitlines()
    pictures = ["halves", "fixed_hold", "servo", "sigma", "constants"]
    assert re.findall(r"!\[.*\]\((.*)\)", markdown) == [f"{picture}.png" for picture in pictures]
    for picture in pictures:
        assert (folder / f"{picture}.png").read_bytes().startswith(b"\x89PNG")
    assert ["tolerance*, damping*, beta*, threshold*" in remark for remark in remarks(text, "ablation ")] == [True]
    assert "not trained: A (adaptive-plain)" in text


def test_the_choice_of_constants_sees_validation_positions_of_both_methods_alone(tmp_path):
    ends = {"uniform-penalty": 0.1, "adaptive-penalty": 0.9, "beta1-uniform": 0.3, "beta1-adaptive": 0.8, "beta3-uniform": 0.6}
    for name, end in ends.items():
        for seed in (0, 1):
            shift = 0.0 if "adaptive" in name else 0.04 * seed
            rates = ["1", *(f"{end + shift + spread:g}" for spread in (-0.05, 0.05, 0.0))]
            add_evaluation(tmp_path / "ablations", name, seed, "0000")
            add_progress(tmp_path / "ablations", name, seed, *rates)
    report(tmp_path)
    assert lines(tmp_path, "ablations/choice.csv") == [
        "setting,seeds,adaptive,uniform,score,standard_error",
        "default,2,0.9,0.12,0.51,0.01",
        "beta 1,2,0.8,0.32,0.56,0.01",
    ]
    assert "| beta 1 | 2 | 80 % | 32 % | 56 % | 1 % |" in (tmp_path / "ablations" / "choice.md").read_text()


def test_the_curve_of_an_ablation_is_one_even_when_a_seed_has_stored_less(tmp_path):
    for seed, missing in ((0, 0), (1, 20)):
        add_evaluation(tmp_path / "ablations", "adaptive-penalty", seed, "11")
        add_progress(tmp_path / "ablations", "adaptive-penalty", seed, "0.2", "", f"0.{6 + 2 * seed}", missing=missing)
    report(tmp_path)
    assert lines(tmp_path, "ablations/learning_curves.csv")[1:] == [
        "adaptive-penalty,1,2,190,0.2,0.2,0.2",
        "adaptive-penalty,3,2,590,0.7,0.6,0.8",
    ]


def test_ablations_say_what_is_missing_and_the_command_for_it(tmp_path):
    add_evaluation(tmp_path, "A", 0, "11")
    assert "ablation " not in report(tmp_path)
    add_evaluation(tmp_path / "ablations", "adaptive-penalty", 0, "11")
    add_progress(tmp_path / "ablations", "fixed_hold-penalty", 0, "0.5")
    add_progress(tmp_path / "ablations", "uniform-penalty", 0, "0.5")
    said = {line.split(",")[0]: line for line in remarks(report(tmp_path), "ablation ")}
    absent = "uniform-penalty, unstuck_only-penalty, steady_only-penalty"
    assert f"missing: {absent}; train them into {tmp_path / 'ablations'} first" in said["ablation halves"]
    assert "missing: uniform-penalty, fixed_hold-penalty; `uarm-rl evaluate results_dir" in said["ablation fixed_hold"]
    assert "missing: adaptive-plain, sigma*; train them" in said["ablation sigma"]


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
    text = report(tmp_path)
    first = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert report(tmp_path) == text
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == first
    written = {str(path.relative_to(tmp_path)) for path in first if "seed" not in str(path.relative_to(tmp_path))}
    assert len(written) == 21 + 10
    assert {line for line in text.splitlines() if line.startswith("wrote ")} == {f"wrote {tmp_path / name}" for name in written}


def test_trials_on_an_arm_stand_beside_the_papers_and_an_emulated_arm_is_never_called_real(tmp_path):
    add_evaluation(tmp_path, "C", 0, "11")
    assert not (tmp_path / "arm_trials.csv").exists()
    real = tmp_path / "short" / "real_arm" / "seed0" / "real"
    write(real / "trials.csv", [{"success": int(n > 1), "reached": 1, "emulated": 1, "reason": ""} for n in range(20)])
    write(tmp_path / "real_arm" / "seed1" / "real-desk" / "trials.csv", [{"success": 1, "reached": 1, "emulated": 0}] * 4)
    report(tmp_path)
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
        report(tmp_path)
