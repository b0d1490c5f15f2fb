"""Past obstacles, and told torques: their tables and pictures, from files as evaluate and train write them."""

from __future__ import annotations

import csv
from pathlib import Path

from tests.report.runs import add_evaluation, add_progress, lines, remarks, write, write_config
from uarm_rl import columns
from uarm_rl.configuration import compose
from uarm_rl.report.report import report

USUAL = compose("train", ("sim=pybullet",))


def add_run(results: Path, *words: str, successes: str, touched: str = "", tested: bool = True, **conditions: str) -> Path:
    """A run below ``results/beyond``; a digit of ``touched`` for each position of a task with obstacles."""
    settings = compose("train", words)
    run = results / "beyond" / settings["name"] / f"seed{settings['seed']}"
    write_config(run, settings)
    add_progress(run.parent.parent, settings["name"], settings["seed"], "0.25", "0.5")
    if tested:
        add_test(run, successes, touched, "evaluation.csv", **conditions)
    return run


def add_test(run: Path, successes: str, touched: str, file: str, **conditions: str) -> None:
    add_evaluation(run.parent.parent, run.parent.name, int(run.name[4:]), successes, file, **conditions)
    with open(run / file, newline="") as opened:
        rows = list(csv.DictReader(opened))
    told = [{"touched": one, "obstacle_contact_n": 4.0 + number if one == "1" else 0.0} for number, one in enumerate(touched)]
    further = told or [{}] * len(rows)
    write(run / file, [row | more | {"final_distance_m": 0.004} for row, more in zip(rows, further, strict=True)])


def table(results: Path, name: str) -> list[dict[str, str]]:
    with open(results / name, newline="") as file:
        return list(csv.DictReader(file))


def test_how_attempts_past_obstacles_ended(tmp_path):
    run = add_run(tmp_path, "experiment=obstacles", "buffer=adaptive", successes="1110", touched="0000")
    add_run(tmp_path, "experiment=obstacles", "buffer=adaptive", "seed=1", successes="1100", touched="0001")
    add_run(tmp_path, "experiment=obstacles", "buffer=uniform", successes="1000", touched="0110")
    add_test(run, "0011", "1100", "ik.csv")
    add_test(run, "1111", "0000", "planner.csv")
    report(tmp_path, USUAL)
    rows = table(tmp_path, "obstacles.csv")
    assert [(row["method"], row["seeds"], row["success_rate"], row["touched"], row["neither"]) for row in rows] == [
        ("adaptive", "2", "0.625", "0.125", "0.25"),
        ("uniform", "1", "0.25", "0.5", "0.25"),
        ("inverse kinematics", "1", "0.5", "0.5", "0"),
        ("planner", "1", "1", "0", "0"),
    ]
    assert (rows[1]["force_median_n"], rows[1]["force_most_n"], rows[3]["force_most_n"]) == ("5.5", "6", "")
    assert "| uniform | 1 | 25 % (4.6 to 69.9 %) | 50 % | 5.5, 6 | 2.0 |" in lines(tmp_path, "obstacles.md")
    for picture in ("obstacles.png", "obstacles_learning.png"):
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "report.html").read_text()
    assert "How policies learn to come past obstacles" in page
    assert "How attempts ended past one to three obstacles" in page


def test_what_each_way_to_wait_comes_to_with_torques(tmp_path):
    told = add_run(tmp_path, "experiment=torque", successes="1110")
    write(
        told / "evaluation-traces.csv",
        [{"position": 0, "time_s": k / 20, **dict.fromkeys(columns.STATE, 0.1)} for k in range(4)],
    )
    add_run(tmp_path, "experiment=torque", "buffer=adaptive", "episodes=200", successes="0000")
    add_run(tmp_path, "experiment=torque", "buffer=steady_speed", successes="", tested=False)
    text = report(tmp_path, USUAL)
    rows = table(tmp_path, "torque.csv")
    assert [(row["method"], row["episodes"], row["success_rate"], row["control_steps_per_decision"]) for row in rows] == [
        ("adaptive", "200", "0", "1"),
        ("uniform", "1000", "0.75", "1"),
    ]
    assert "| uniform | 1000 | 1 | 75 % (30.1 to 95.4 %) | 4.0 | 1.0 | 2.0 |" in lines(tmp_path, "torque.md")
    assert not (tmp_path / "obstacles.csv").exists()
    assert (tmp_path / "torque_traces.png").read_bytes().startswith(b"\x89PNG")
    assert remarks(text, "beyond the paper") == [
        f"beyond the paper, not tested: 1 runs; `uarm-rl evaluate results_dir={tmp_path / 'beyond'}` does it"
    ]
