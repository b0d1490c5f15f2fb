"""`make paper` and `make ablations`: every line composes, the runs do not collide, and small ones go through to the report."""

from __future__ import annotations

import csv
import shlex
import subprocess
from itertools import product
from pathlib import Path

import pytest

from tests.conftest import FAST
from uarm_rl import cli, configuration

ROOT = Path(__file__).parents[2]
TINY = (*FAST, "episodes=2", "experiences_per_episode=20", "time_limit_s=0.1", "simulate_beside=false")


def lines(goal: str, **variables: str) -> list[list[str]]:
    """The words behind ``uarm-rl`` in each line that ``make goal`` would run."""
    words = [f"{name}={value}" for name, value in variables.items()]
    dry = subprocess.run(["make", "-n", "-B", goal, *words], cwd=ROOT, capture_output=True, text=True, check=True)
    return [shlex.split(line)[1:] for line in dry.stdout.splitlines() if "/uarm-rl " in line]


def jobs(words: list[str]) -> list[tuple[str, ...]]:
    """The overrides of every run that a line with commas stands for."""
    pairs = [word.partition("=") for word in words if "=" in word and not word.startswith("hydra")]
    return [
        tuple(f"{name}={value}" for (name, _, _), value in zip(pairs, values, strict=True))
        for values in product(*(text.split(",") for _, _, text in pairs))
    ]


@pytest.mark.parametrize("goal", ["paper", "ablations"])
def test_every_line_composes_and_skips_what_is_finished(goal):
    for command, *words in lines(goal, SEEDS="7"):
        assert command in ("train", "evaluate", "report")
        for overrides in jobs(words):
            assert configuration.compose(command, overrides)
        if command == "train":
            assert {"-m", "resume=true"} <= set(words)


def test_no_two_runs_share_a_folder():
    trained = [
        job for goal in ("paper", "ablations") for command, *words in lines(goal) if command == "train" for job in jobs(words)
    ]
    folders = [
        f"{run['results_dir']}/{run['name']}/seed{run['seed']}"
        for run in (configuration.compose("train", job) for job in trained)
    ]
    assert len(set(folders)) == len(folders) == 3 * (5 + 6 + 8 + 1 + 2 + 2 + 2 + 2 + 4 + 4 + 10 + 1)


def test_the_papers_runs_are_the_papers():
    (command, *words), *_ = lines("paper")
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
        "ABLATION_EPISODES": "2",
        "SIDE_BY_SIDE": "",
        "OVERRIDES": " ".join(TINY),
    }
    few = {
        "experiment=A,C,D,steady_only,unstuck_only,fixed_hold": "experiment=C,fixed_hold",
    }
    for words in lines("paper", **variables)[:-1] + lines("ablations", **variables):
        words = [few.get(word, word) for word in words]
        if any(word.startswith("out=") for word in words):
            words = [*words, "positions=two.csv"]
        if not {"policy=ik", "experiment=servo", "experiment=instant", "experiment=sigma", "buffer=adaptive,uniform"} & set(
            words
        ):
            cli.main(words)
    results = tmp_path / "results"
    made = {str(path.relative_to(results)) for path in results.rglob("*") if path.is_file() and "seed0" not in str(path)}
    assert {"table1.csv", "tolerance.csv", "heldout.csv", "holds.csv", "shaking.png", "comparisons.csv", "budgets.csv"} <= made
    assert {"ablations/ablations.csv", "ablations/ablations.md", "ablations/fixed_hold.png"} <= made
    with open(results / "tolerance.csv", newline="") as file:
        tolerances = [(row["method"], row["tolerance_m"]) for row in csv.DictReader(file)]
    assert tolerances == list(product("AB", ("0.001", "0.002", "0.005", "0.01")))
    with open(results / "budgets.csv", newline="") as file:
        assert all(float(row["simulated_s"]) == float(row["control_steps"]) / 20 for row in csv.DictReader(file))
    text = capsys.readouterr().out
    assert "ablation halves, missing: uniform-penalty, unstuck_only-penalty, steady_only-penalty" in text
    assert "missing" not in "".join(line for line in text.splitlines() if "ablation" not in line)
