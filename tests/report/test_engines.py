"""Two engines in a report: side by side where that is asked for, never mixed in one number."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import pytest

from tests.report.runs import add_ablations, add_evaluation, add_progress, add_study_run, lines, remarks, write_config
from uarm_rl import columns, csvfile
from uarm_rl.configuration import compose
from uarm_rl.report.records import ReportError
from uarm_rl.report.report import report

USUAL = compose("train", ("sim=pybullet",))
RESULTS = Path(__file__).parents[2] / "results"


def add_run(results: Path, name: str, trained_in: str, seed: int = 0, **evaluations: str) -> None:
    """A run with an evaluation for each engine that is named: the standard one where it was trained."""
    for engine, successes in evaluations.items():
        file = "evaluation.csv" if engine == trained_in else f"{engine}.csv"
        add_evaluation(results, name, seed, successes, file, engine=engine)
    folder = {"C": "adaptive-penalty", "D": "uniform-penalty"}[name]
    write_config(
        results / folder / f"seed{seed}", compose("train", (f"experiment={name}", f"sim={trained_in}", "episodes=300"))
    )


def test_each_method_in_both_engines(tmp_path):
    add_run(tmp_path, "C", "pybullet", pybullet="1111", mujoco="1110")
    add_run(tmp_path, "D", "pybullet", pybullet="1000")  # was not tested in the other
    add_run(tmp_path / "mujoco", "D", "mujoco", pybullet="0100", mujoco="0011")
    text = report(tmp_path, USUAL)
    cells = [line.split(",") for line in lines(tmp_path, "engines.csv")]
    rows = [dict(zip(cells[0], row, strict=True)) for row in cells[1:]]
    shown = ("method", "trained_in", "episodes", "seeds", "pybullet_success_rate", "mujoco_success_rate", "same_outcome")
    assert [[row[name] for name in shown] for row in rows] == [
        ["C", "pybullet", "300", "1", "1", "0.75", "0.75"],
        ["D", "mujoco", "300", "1", "0.25", "0.5", "0.25"],
    ]
    assert {row["mujoco_median_time_s"] for row in rows} == {"2"}
    assert "| D | MuJoCo | 300 | 1 | 25 % (4.6 to 69.9 %) | 50 % (15 to 85 %) | 25 % | 2.00 | 2.00 |" in lines(
        tmp_path, "engines.md"
    )
    assert remarks(text, "two engines") == [
        f"two engines, missing: mujoco.csv (1 of 2 runs); `uarm-rl evaluate sim=mujoco out=mujoco.csv results_dir={tmp_path}` "
        "makes it"
    ]
    assert lines(tmp_path, "table1.csv")[4].startswith("D,uniform,penalty,1,0.25,")  # not of MuJoCo's run


@pytest.mark.parametrize(("tested", "other"), [("pybullet", "mujoco"), ("mujoco", "pybullet")])
def test_only_an_engine_that_is_installed_is_missed(tmp_path, monkeypatch, tested, other):
    add_run(tmp_path, "C", tested, **{tested: "11"})
    monkeypatch.setitem(sys.modules, other, ModuleType(other))
    sys.modules[other].__spec__ = ModuleSpec(other, None)
    assert len(remarks(report(tmp_path, USUAL), f"two engines, missing: {other}.csv")) == 1
    monkeypatch.setitem(sys.modules, other, None)
    assert remarks(report(tmp_path, USUAL), "two engines") == []


def test_how_far_apart_under_the_same_commands(tmp_path):
    add_run(tmp_path, "C", "pybullet", pybullet="11", mujoco="11")
    apart = [("free", 0, 1e-6, ""), ("free", 1, 3e-6, ""), ("contact", 0, 1e-3, 2e-3), ("contact", 1, 2e-3, 6e-3)]
    rows = [dict(zip(columns.TRAJECTORIES, row, strict=True)) for row in apart]
    (tmp_path / "mujoco").mkdir()
    csvfile.write_rows(tmp_path / "mujoco" / "trajectories.csv", columns.TRAJECTORIES, rows)
    report(tmp_path, USUAL)
    assert {"| free | 2 | 0.002 | 0.003 | - | - |", "| contact | 2 | 1.5 | 2 | 4 | 6 |"} <= set(lines(tmp_path, "engines.md"))


def test_the_published_engines_move_alike_in_the_air():
    apart = csvfile.read(RESULTS / "mujoco" / "trajectories.csv", columns.TRAJECTORIES).values
    free_m = [cup_m for motion, cup_m in zip(apart["motion"], apart["cup_apart_m"], strict=True) if motion == "free"]
    assert len(free_m) == 100
    assert max(free_m) < 1e-4


def test_what_is_not_pybullets_is_named(tmp_path):
    add_run(tmp_path, "C", "mujoco", mujoco="1111")
    add_run(tmp_path, "D", "mujoco", mujoco="1000")
    add_evaluation(tmp_path, "D", 0, "1100", engine="pybullet")  # in another engine than it was trained in
    add_evaluation(tmp_path, "ik", 0, "1111", engine="mujoco")
    add_evaluation(tmp_path, "A", 0, "1110", old="")  # says no engine, which is PyBullet's
    text = report(tmp_path, USUAL)
    labels = [line.split(",adaptive")[0].split(",uniform")[0] for line in lines(tmp_path, "table1.csv")[1:]]
    assert [label.strip('"').split(",,")[0] for label in labels] == [
        "A",
        "B",
        "C (mujoco)",
        "D (mujoco, tested in pybullet)",
        "IK (mujoco)",
    ]
    assert '"D (mujoco, tested in pybullet)",uniform,penalty,1,0.5,' in (tmp_path / "table1.csv").read_text()
    assert "| C (mujoco) | adaptive | penalty | 1 | 100 % (51 to 100 %) | 100 % |" in (tmp_path / "table1.md").read_text()
    assert remarks(text, "not compared") == ["not compared, because A to D were tested in different engines: mujoco, pybullet"]
    assert not (tmp_path / "comparisons.csv").exists()


@pytest.mark.parametrize("file", ["evaluation.csv", "tolerance-1mm.csv", "heldout.csv", "hold-fixed.csv"])
def test_one_number_of_two_engines_is_refused(tmp_path, file):
    add_run(tmp_path, "C", "pybullet", pybullet="11")
    add_evaluation(tmp_path, "C", int(file == "evaluation.csv"), "11", file, engine="mujoco")
    with pytest.raises(ReportError, match=r"of adaptive-penalty were made in mujoco and pybullet; no number of a report may"):
        report(tmp_path, USUAL)


def test_seeds_trained_in_two_engines_are_refused(tmp_path):
    for seed, engine in enumerate(("pybullet", "mujoco")):
        add_run(tmp_path, "C", engine, seed)
        add_progress(tmp_path, "C", seed, "0.5")
    with pytest.raises(ReportError, match="adaptive-penalty were trained in mujoco and pybullet; no number of a report may"):
        report(tmp_path, USUAL)


def test_ablations_in_two_engines_are_refused(tmp_path):
    add_ablations(tmp_path)
    add_study_run(tmp_path, "experiment=dwell", "dwell_s=1", "sim=mujoco", successes="1111", engine="mujoco")
    with pytest.raises(ReportError, match="ablations were made in mujoco and pybullet"):
        report(tmp_path, USUAL)
