"""The report: golden tables from small CSV files, missing methods, bad files, and what it must not import."""

import csv
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from uarm_rl.checks import UsageError
from uarm_rl.report.records import ReportError
from uarm_rl.report.report import report
from uarm_rl.report.statistics import wilson_interval

EVALUATION = (
    "position,success,return,common_return,time_s,final_distance_m,min_distance_m,object_displacement_m,"
    "reversals_per_s,rms_jerk,tip_travel_last_s_m,decisions"
)
PROGRESS = (
    "episode,experiences,control_steps,updates,admission_rate,episode_return,critic_loss,actor_loss,"
    "validation_success_rate,wall_s,decisions"
)
WRITTEN = {
    "comparisons.csv",
    "comparisons.md",
    "budgets.csv",
    "budgets.png",
    "steps_to_95.csv",
    "steps_to_95.md",
    "table1.csv",
    "table1.md",
    "reward_curve.csv",
    "reward_curve.png",
    "learning_curves.csv",
    "learning_curves.png",
    "report.html",
}


def add_run(results: Path, name: str, seed: int = 0, *, successes: str = "", validation: tuple[str, ...] = ()) -> Path:
    """A run with one position for each digit of ``successes`` and one episode for each entry of ``validation``."""
    run = results / name / f"seed{seed}"
    run.mkdir(parents=True)
    rows = [
        f"{position},{success},{-1.5 - seed},{-position - seed},{2 + seed},0.003,0.002,0.001,0.25,12.5,0.0125,40"
        for position, success in enumerate(successes)
    ]
    if rows:
        (run / "evaluation.csv").write_text("\n".join([EVALUATION, *rows, ""]))
    rows = [
        f"{episode},{200 * episode},{400 * episode},{200 * episode},0.5,{-10 * episode - seed},,,{rate},1.5,400"
        for episode, rate in enumerate(validation, start=1)
    ]
    if rows:
        (run / "progress.csv").write_text("\n".join([PROGRESS, *rows, ""]))
    return run


def add_example(results: Path) -> None:
    """A with two perfect seeds, B untested, C with one of two seeds tested, no D; the reference and one more run."""
    for seed in (0, 1):
        add_run(results, "adaptive-plain", seed, successes="1111", validation=("", "0.5", ""))
    add_run(results, "uniform-plain", validation=("0.1",))
    add_run(results, "adaptive-penalty", 0, successes="1101")
    add_run(results, "adaptive-penalty", 1, validation=("",))
    add_run(results, "ik", successes="1111")
    add_run(results, "fixed_hold-penalty", 0, successes="1100")
    add_run(results, "fixed_hold-penalty", 1, successes="0101")


def files(results: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in results.iterdir() if path.is_file()}


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    results = tmp_path_factory.mktemp("example")
    add_example(results)
    return results, report(results, {})


def test_table1_csv(example):
    results, _ = example
    lines = (results / "table1.csv").read_text().splitlines()
    shaking = "0.25,12.5,0.0125"
    assert lines[0] == (
        "method,buffer,reward,seeds,success_rate,ci_low,ci_high,paper_success_rate,"
        "reversals_per_s,rms_jerk,tip_travel_last_s_m,time_s,object_displacement_m,press_m,contact_n"
    )
    low, high = wilson_interval(4, 4)
    assert lines[1] == f"A,adaptive,plain,2,1,{low:.6g},{high:.6g},0.99,{shaking},2.5,0.001,,"
    assert lines[2] == "B,uniform,plain,0,,,,0.75,,,,,,,"
    low, high = wilson_interval(3, 4)
    assert lines[3] == f"C,adaptive,penalty,1,0.75,{low:.6g},{high:.6g},1,{shaking},2,0.001,,"
    assert lines[4] == "D,uniform,penalty,0,,,,0.8,,,,,,,"
    low, high = wilson_interval(4, 4)
    assert lines[5] == f"IK,,,1,1,{low:.6g},{high:.6g},,{shaking},2,0.001,,"
    name, buffer, reward, seeds, rate, ci_low, ci_high, paper, *_ = lines[6].split(",")
    assert (name, buffer, reward, seeds, rate, paper) == ("fixed_hold-penalty", "", "", "2", "0.5", "")
    assert 0.0 <= float(ci_low) < 0.5 < float(ci_high) <= 1.0
    assert len(lines) == 7


def test_table1_markdown(example):
    results, _ = example
    lines = (results / "table1.md").read_text().splitlines()
    assert lines[:2] == [
        "| Method | Buffer | Reward | Seeds | Success (95 % interval) | Paper | Reversals (1/s) | RMS jerk (m/s³) "
        "| Tip travel (mm, last second) | Time (s) | Object moved (mm) | Pressed (mm) | Contact (N) |",
        "| --- | --- | --- |" + " ---: |" * 10,
    ]
    assert lines[2:7] == [
        "| A | adaptive | plain | 2 | 100 % (51 to 100 %) | 99 % | 0.25 | 12.5 | 12.5 | 2.50 | 1.0 | - | - |",
        "| B | uniform | plain | 0 of 1 | - | 75 % | - | - | - | - | - | - | - |",
        "| C | adaptive | penalty | 1 of 2 | 75 % (30.1 to 95.4 %) | 100 % | 0.25 | 12.5 | 12.5 | 2.00 | 1.0 | - | - |",
        "| D | uniform | penalty | - | - | 80 % | - | - | - | - | - | - | - |",
        "| IK | - | - | 1 | 100 % (51 to 100 %) | - | 0.25 | 12.5 | 12.5 | 2.00 | 1.0 | - | - |",
    ]
    assert lines[7].startswith("| fixed_hold-penalty | - | - | 2 | 50 % (")


def test_reward_curve_csv(example):
    results, _ = example
    lines = (results / "reward_curve.csv").read_text().splitlines()
    assert lines[:3] == [
        "method,position,seeds,common_return_mean,common_return_min,common_return_max,return_mean,return_min,return_max",
        "A,0,2,-0.5,-1,0,-2,-2.5,-1.5",
        "A,1,2,-1.5,-2,-1,-2,-2.5,-1.5",
    ]
    assert [line.split(",")[0] for line in lines[1:]] == ["A"] * 4 + ["C"] * 4 + ["IK"] * 4 + ["fixed_hold-penalty"] * 4


def test_learning_curves_csv(example):
    results, _ = example
    assert (results / "learning_curves.csv").read_text().splitlines() == [
        "method,episode,seeds,experiences,validation_success_rate_mean,validation_success_rate_min,"
        "validation_success_rate_max,smoothed_return_mean,smoothed_return_min,smoothed_return_max",
        "A,1,2,200,,,,-10.5,-11,-10",
        "A,2,2,400,0.5,0.5,0.5,-15.5,-16,-15",
        "A,3,2,600,,,,-20.5,-21,-20",
        "B,1,1,200,0.1,0.1,0.1,-10,-10,-10",
        "C,1,1,200,,,,-11,-11,-11",
    ]


def test_smoothed_return_is_the_mean_of_the_last_twenty_episodes(tmp_path):
    add_run(tmp_path, "adaptive-plain", validation=("",) * 30)  # returns -10, -20, ..., -300
    report(tmp_path, {})
    with open(tmp_path / "learning_curves.csv", newline="") as file:
        last = list(csv.DictReader(file))[-1]
    assert float(last["smoothed_return_mean"]) == pytest.approx(-10 * (11 + 30) / 2)


@pytest.mark.parametrize(("name", "height"), [("reward_curve.png", 1320), ("learning_curves.png", 1440)])
def test_pictures_are_as_wide_as_a_column_at_300_dpi(example, name, height):
    results, _ = example
    content = (results / name).read_bytes()
    assert content.startswith(b"\x89PNG\r\n\x1a\n")
    assert struct.unpack(">II", content[16:24]) == (1050, height)


def test_the_text_holds_the_table_what_is_missing_and_the_files(example):
    results, text = example
    lines = text.splitlines()
    assert " ".join(lines[0].split()) == (
        "Method Buffer Reward Seeds Success Paper Reversals RMS jerk Tip travel Time Object moved Pressed Contact"
    )
    assert " ".join(lines[3].split()) == "A adaptive plain 2 100 % (51 to 100 %) 99 % 0.25 12.5 12.5 2.50 1.0 - -"
    assert len({len(line) for line in lines[2:9]}) == 1  # aligned
    assert "not trained: D (uniform-penalty)" in lines
    waiting = ", ".join(str(results / run) for run in ("uniform-plain/seed0", "adaptive-penalty/seed1"))
    assert f"not evaluated (`uarm-rl evaluate results_dir={results}` does it): {waiting}" in lines
    assert {line for line in lines if line.startswith("wrote ")} == {f"wrote {results / name}" for name in WRITTEN}


def test_paths_below_the_current_folder_are_printed_relative_to_it(tmp_path, monkeypatch):
    add_run(tmp_path / "results", "adaptive-plain", successes="11")
    monkeypatch.chdir(tmp_path)
    assert "wrote results/table1.md" in report(tmp_path / "results", {}).splitlines()


def test_a_second_report_is_the_same_to_the_last_byte_and_leaves_nothing_else_behind(example):
    results, text = example
    first = files(results)
    assert set(first) == WRITTEN
    assert report(results, {}) == text
    assert files(results) == first
    assert not [path for path in results.iterdir() if path.name.startswith(".")]


def test_the_order_in_which_runs_were_made_does_not_matter(example, tmp_path):
    results, _ = example
    for name, seed, successes in [("fixed_hold-penalty", 1, "0101"), ("fixed_hold-penalty", 0, "1100")]:
        add_run(tmp_path, name, seed, successes=successes)
    report(tmp_path, {})
    assert (tmp_path / "table1.csv").read_text().splitlines()[-1] == (results / "table1.csv").read_text().splitlines()[-1]


def test_a_results_folder_may_bring_its_own_paper_csv(tmp_path):
    add_run(tmp_path, "adaptive-plain", successes="10")
    (tmp_path / "paper.csv").write_text("method,success_rate\nA,0.5\n")
    report(tmp_path, {})
    rows = list(csv.DictReader((tmp_path / "table1.csv").read_text().splitlines()))
    assert [row["paper_success_rate"] for row in rows] == ["0.5", "", "", ""]


def test_a_training_without_a_finished_episode_is_no_error(tmp_path):
    add_run(tmp_path, "adaptive-plain", successes="10")
    run = add_run(tmp_path, "uniform-plain")
    (run / "progress.csv").write_text(PROGRESS + "\n")
    assert "uniform-plain/seed0" in report(tmp_path, {})


def test_folders_that_are_no_runs_are_left_alone(tmp_path):
    add_run(tmp_path, "adaptive-plain", successes="10")
    add_run(tmp_path, ".hydra", successes="nonsense")
    (tmp_path / "adaptive-plain" / "seed0-copy").mkdir()
    (tmp_path / "adaptive-plain" / "seed0-copy" / "evaluation.csv").write_text("nonsense")
    (tmp_path / "adaptive-plain" / "seed7").mkdir()
    report(tmp_path, {})
    assert (tmp_path / "table1.csv").read_text().splitlines()[1].startswith("A,adaptive,plain,1,0.5,")


def edit(file: str, old: str, new: str):
    """A change of the first C run's file."""

    def apply(results: Path) -> None:
        path = results / "adaptive-penalty" / "seed0" / file
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return apply


def overwrite(file: str, content: bytes):
    return lambda results: (results / file).write_bytes(content)


SEED0 = "adaptive-penalty/seed0/"


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (
            edit("evaluation.csv", "common_return", "comon_return"),
            "evaluation.csv lacks the column common_return; .* separated by commas; .*; delete it",
        ),
        (edit("evaluation.csv", "1,1,-1.5", "1,2,-1.5"), "evaluation.csv, line 3: success is '2' and must be 0 or 1"),
        (edit("evaluation.csv", "1,1,-1.5", "1,1,nan"), "evaluation.csv, line 3: return is 'nan' and must be a finite number"),
        (edit("evaluation.csv", "1,1,-1.5", "1,1,"), "evaluation.csv, line 3: return is '' and must be a finite number"),
        (edit("evaluation.csv", "1,1,-1.5", "1,1,-inf"), "evaluation.csv, line 3: return is '-inf'"),
        (edit("evaluation.csv", "1,1,-1.5", "x,1,-1.5"), "evaluation.csv, line 3: position is 'x' and must be a whole number"),
        (edit("evaluation.csv", "1,1,-1.5", "0,1,-1.5"), "evaluation.csv holds a position twice"),
        (
            edit("evaluation.csv", "1,1,-1.5", "9,1,-1.5"),
            r"seed0 \(3 positions, 0 to 2\) and .* different positions; delete one",
        ),
        (edit("evaluation.csv", "1,1,-1.5", "1,1,0,-1.5"), "evaluation.csv, line 3: 13 values for 12 columns"),
        (edit("evaluation.csv", "2,1,-1.5,-2,2,0.003,0.002,0.001,0.25,12.5,0.0125,40\n", ""), r"\(2 positions, 0 to 1\)"),
        (overwrite(SEED0 + "evaluation.csv", b""), "evaluation.csv is empty and lacks the column position"),
        (overwrite(SEED0 + "evaluation.csv", EVALUATION.encode()), "evaluation.csv holds no row below its header"),
        (overwrite(SEED0 + "evaluation.csv", b"\xff\xfe\x00"), "evaluation.csv cannot be read"),
        (edit("progress.csv", "episode_return", "reward"), "progress.csv lacks the column episode_return; .*; restore it"),
        (
            edit("progress.csv", ",0.5,1.5", ",1.5,1.5"),
            "progress.csv, line 2: validation_success_rate is '1.5' and must be empty",
        ),
        (edit("progress.csv", ",0.5,1.5", ",bad,1.5"), "progress.csv, line 2: validation_success_rate is 'bad'"),
        (edit("progress.csv", "-10,", ","), "progress.csv, line 2: episode_return is '' and must be a finite number"),
        (overwrite(SEED0 + "progress.csv", b""), "progress.csv is empty and lacks the column episode"),
        (overwrite("paper.csv", b"method,success_rate\nA,99\n"), "paper.csv, line 2: success_rate is '99' and must be"),
    ],
)
def test_a_bad_file_is_named_in_a_sentence_and_nothing_is_written(tmp_path, damage, sentence):
    add_run(tmp_path, "adaptive-plain", successes="111")
    add_run(tmp_path, "adaptive-penalty", successes="111", validation=("0.5",))
    damage(tmp_path)
    before = files(tmp_path)
    with pytest.raises(ReportError, match=sentence):
        report(tmp_path, {})
    assert files(tmp_path) == before


def test_progress_ends_before_an_error_is_told(tmp_path, capsys):
    add_run(tmp_path, "adaptive-plain", successes="111")
    (tmp_path / "paper.csv").write_text("=1+1")
    try:
        report(tmp_path, {})
    except ReportError:
        assert capsys.readouterr().err.startswith("report: 0 of ")
    else:
        pytest.fail("no error")


def test_a_folder_without_runs_says_what_to_do(tmp_path):
    with pytest.raises(UsageError, match="holds no run; make one with `uarm-rl train results_dir="):
        report(tmp_path, {})
    with pytest.raises(UsageError, match="nowhere is not a folder; name one with results_dir=PATH"):
        report(tmp_path / "nowhere", {})
    assert list(tmp_path.iterdir()) == []


def test_a_report_that_cannot_be_written_is_a_sentence_and_leaves_no_temporary_files(tmp_path):
    add_run(tmp_path, "adaptive-plain", successes="10")
    (tmp_path / "table1.csv").mkdir()
    with pytest.raises(ReportError, match="cannot take the report"):
        report(tmp_path, {})
    assert {path.name for path in tmp_path.iterdir()} == {"adaptive-plain", "table1.csv"}


def test_the_report_needs_neither_simulator_nor_learner_nor_hydra(tmp_path):
    add_run(tmp_path, "adaptive-plain", successes="10")
    program = (
        "import sys, pathlib, uarm_rl.report.report\n"
        "assert 'matplotlib' not in sys.modules\n"
        f"uarm_rl.report.report.report(pathlib.Path({str(tmp_path)!r}), {{}})\n"
        "print(sorted({'torch', 'pybullet', 'gymnasium', 'hydra', 'omegaconf', 'matplotlib.pyplot'} & set(sys.modules)))\n"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"
