"""`make paper` and `make ablations`: every line composes, the runs do not collide, and small ones go through to the report."""

from __future__ import annotations

import csv
import shlex
import subprocess
from functools import cache
from itertools import product
from pathlib import Path

import pytest

from tests.conftest import FAST
from uarm_rl import cli, configuration
from uarm_rl.studies import studies

ROOT = Path(__file__).parents[2]
TINY = (*FAST, "episodes=2", "experiences_per_episode=20", "time_limit_s=0.1", "simulate_beside=false")


def lines(goal: str, **variables: str) -> list[list[str]]:
    """The words behind ``uarm-rl`` in each line that ``make goal`` would run."""
    words = [f"{name}={value}" for name, value in variables.items()]
    dry = subprocess.run(["make", "-n", "-B", goal, *words], cwd=ROOT, capture_output=True, text=True, check=True)
    return [shlex.split(line)[1:] for line in dry.stdout.splitlines() if "/uarm-rl " in line]


def jobs(words: list[str]) -> list[list[str]]:
    """The overrides of every run that a line stands for."""
    return configuration.combinations(words)[1]


@cache
def composed(command: str, job: tuple[str, ...]) -> configuration.Settings:
    """A job's configuration; composing takes a while, and there are many."""
    return configuration.compose(command, job)


@pytest.mark.parametrize("goal", ["paper", "ablations"])
def test_every_line_composes_and_skips_what_is_finished(goal):
    for command, *words in lines(goal, SEEDS="0"):
        assert command in ("train", "evaluate", "report")
        if command == "train":  # whose jobs the next test composes, all of them
            assert {"-m", "resume=true"} <= set(words)
            continue
        for overrides in jobs(words):
            assert composed(command, tuple(overrides))


def test_no_two_runs_share_a_folder():
    """Studies share some runs, and these are the same in all of them."""
    trained = [
        composed("train", tuple(job))
        for goal in ("paper", "ablations")
        for command, _, *words in lines(goal, SEEDS="0")
        if command == "train"
        for job in jobs(words)
    ]
    runs = {f"{run['results_dir']}/{run['name']}/seed{run['seed']}": run for run in trained}
    assert len(runs) == 6 + (2 + 2 + 1) + (8 + 1 + 2) + 3 + (2 + 2 + 4 + 4 + 10 + 1) + (
        12 + 1 + 4 + 2 + 4 + 1 + 2 + 4 + 1 + 1 + 1
    )
    assert all(run == runs[f"{run['results_dir']}/{run['name']}/seed{run['seed']}"] for run in trained)
    lengths = {run["name"]: run["episodes"] for run in trained if run["results_dir"] == "results/ablations"}
    long = {"long-servo-14-uniform-penalty", "long-velocity-uniform"}
    assert {name for name, episodes in lengths.items() if episodes != 300} == long


def test_the_target_runs_every_study():
    (command, *words), *_ = lines("ablations")
    (chosen,) = (word.removeprefix("experiment=") for word in words if word.startswith("experiment="))
    with_seeds = sorted(set(studies()) - {"tuning"})  # whose trials have one seed, and whose winners are trained again
    assert (command, sorted(chosen.split(","))) == ("train", with_seeds)


def test_the_papers_runs_are_the_papers():
    (command, _, *words), *_ = lines("paper")
    assert (command, "seed=0,1,2" in words) == ("train", True)
    for run in (configuration.compose("train", job) for job in jobs(words) if "seed=0" in job):
        assert (run["episodes"], run["experiences_per_episode"], run["tolerance_m"]) == (1500, 200, 0.005)


def test_small_ones_go_through_to_the_report(tmp_path, monkeypatch, capsys):
    """In this process, so that Python and torch start once."""
    monkeypatch.chdir(tmp_path)
    Path("two.csv").write_text("x_m,y_m,z_m\n0.2,0.1,0.03\n0.25,-0.1,0.03\n")
    variables = {
        "SEEDS": "0",
        "METHODS": "A,B",
        "STUDIES": "fixed_hold",
        "SIDE_BY_SIDE": "",
        "OVERRIDES": " ".join(TINY),
    }
    for words in lines("paper", **variables)[:-1] + lines("ablations", **variables):
        if any(word.startswith("out=") for word in words):
            words = [*words, "positions=two.csv"]
        if words[0] == "evaluate":
            words = [*words, "workers=1"]
        if "policy=ik" not in words:
            cli.main(words)
    results = tmp_path / "results"
    made = {str(path.relative_to(results)) for path in results.rglob("*") if path.is_file() and "seed0" not in str(path)}
    assert {"table1.csv", "tolerance.csv", "heldout.csv", "holds.csv", "shaking.png", "comparisons.csv", "budgets.csv"} <= made
    assert {"ablations/ablations.csv", "ablations/ablations.md", "ablations/fixed_hold.png"} <= made
    with open(results / "tolerance.csv", newline="") as file:
        tolerances = [(row["method"].partition(" (")[0], row["tolerance_m"]) for row in csv.DictReader(file)]
    assert tolerances == list(product("AB", ("0.001", "0.002", "0.005", "0.01")))
    with open(results / "budgets.csv", newline="") as file:
        assert all(float(row["simulated_s"]) == float(row["control_steps"]) / 20 for row in csv.DictReader(file))
    text = capsys.readouterr().out
    (missing,) = [line for line in text.splitlines() if line.startswith("ablations, missing runs: ")]
    assert "2 of halves" in missing
    assert "fixed_hold" not in missing
    told = [line for line in text.splitlines() if "missing" in line and "ablation" not in line]
    assert [line for line in told if "engines" not in line] == []
