"""`uarm-rl runs`: every run in its state, what is stale, and how two runs differ."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from filelock import FileLock

from tests.report import runs
from uarm_rl import cli, columns, csvfile
from uarm_rl.configuration import compose

HEAD = ["Name", "Method", "State", "Engine", "Seeds", "Episodes", "Success", "Changed", "Size", "Stale"]


@pytest.fixture
def results(tmp_path, monkeypatch) -> Path:
    """A, seeds 0, 1 and 3 evaluated; C trained, training, and interrupted; one of a name of its own in a folder of its own."""
    results = tmp_path / "results"
    for seed, successes in ((0, "1111"), (1, "1100"), (3, "1110")):
        add(results, "A", seed, successes, words=("experiment=A",), sigma="0")
    for seed, rates in ((0, ("", "0.5")), (1, ("0.25",)), (2, ("", "", "")), (4, ())):
        add(results, "C", seed, rates=rates, words=("experiment=C", "episodes=2"))
    (results / "adaptive-penalty" / "seed0" / "policy.safetensors").touch()
    add(results / "inner", "mine", 7, "10", words=("name=mine", "sim=mujoco"), engine="pybullet")
    monkeypatch.chdir(tmp_path)
    return results


def add(results: Path, name: str, seed: int, successes="", words=(), rates=(), **conditions: str) -> None:
    run = results / runs.NAMES.get(name, name) / f"seed{seed}"
    settings = compose("train", ("sim=pybullet", *words, f"seed={seed}"))
    runs.write_config(run, {key: value for key, value in settings.items() if key not in ("results_dir", "resume", "overwrite")})
    if successes:
        runs.add_evaluation(results, name, seed, successes, **({"control_hz": "20", "tolerance_m": "0.005"} | conditions))
    elif rates:
        runs.add_progress(results, name, seed, *rates)
    else:
        csvfile.write_rows(run / "progress.csv", columns.PROGRESS, [])


@pytest.fixture
def listed(capsys):
    """The rows of the list, without the times, and the sentences below it."""

    def listed(*words: str) -> tuple[list[list[str]], list[str]]:
        cli.main(["runs", *words])
        lines = capsys.readouterr().out.splitlines()
        rows = [[cell.strip() for cell in line.split("  ") if cell.strip()] for line in lines if not line.startswith("stale:")]
        if rows[0][0] == "Name":
            assert rows[0] == HEAD
            rows = [[*row[:7], row[9]] for row in rows[3:]]
        return rows, [line for line in lines if line.startswith("stale:")]

    return listed


EVALUATED = ["adaptive-plain", "A", "evaluated", "pybullet", "0-1,3", "1500", "75.0", "-"]
MINE = ["inner/mine", "adaptive, penalty", "evaluated", "mujoco, tested in pybullet", "7", "1500", "50.0", "-"]
TRAINED = ["adaptive-penalty", "C", "trained", "pybullet", "0", "2", "50.0 (validation)", "-"]
TRAINING = ["adaptive-penalty", "C", "training", "pybullet", "1", "1 of 2", "25.0 (validation)", "-"]
INTERRUPTED = ["adaptive-penalty", "C", "interrupted", "pybullet", "2,4", "0-3 of 2", "-", "-"]


def test_runs_are_listed_in_their_states(results, listed):
    with FileLock(results / "adaptive-penalty" / "seed1" / ".lock"):
        assert listed() == ([TRAINED, TRAINING, INTERRUPTED, EVALUATED, MINE], [])
        assert listed("state=training") == ([TRAINING], [])
    assert listed("state=training")[0][0][0].startswith("results holds no such run; none of its 8 is what was asked for")
    assert listed("name=inner/*") == listed("engine=mujoco") == ([MINE], [])
    assert listed("method=A") == listed("name=*-plain", "state=evaluated") == ([EVALUATED], [])
    assert listed("method=penalty", "state=evaluated") == ([MINE], [])
    assert listed("method=inner/mine")[0][0][0].endswith("inner/mine is a name and no method: name=inner/mine")


def test_what_is_stale_is_said(results, listed):
    run = results / "adaptive-plain" / "seed0"
    assert listed("stale=true")[0][0][0].startswith("results holds no such run")
    later = (run / "evaluation.csv").stat().st_mtime + 3600
    (run / "policy.safetensors").touch()
    os.utime(run / "policy.safetensors", (later, later))
    other = results / "adaptive-plain" / "seed1"
    runs.add_evaluation(results, "A", 1, "1100", tolerance_m="0.002", control_hz="20")
    (results / "adaptive-plain" / "seed3" / "evaluation.csv").write_text("position\n")
    rows, stale = listed("stale=true")
    assert rows == [[*EVALUATED[:6], "75.0", "3"]]
    name = "results/adaptive-plain/seed"
    assert stale[:2] == [
        f"stale: {name}0/evaluation.csv is older than the policy",
        f"stale: {name}1/evaluation.csv was made with tolerance_m=0.002, and the run's is 0.005",
    ]
    assert stale[2].startswith(f"stale: {name}3/evaluation.csv lacks the column success")
    assert other.exists()


def test_a_report_of_other_runs_is_stale(results, listed, capsys):
    cli.main(["report"])
    capsys.readouterr()
    assert listed()[1] == []
    shutil.rmtree(results / "adaptive-plain" / "seed1")
    assert listed()[1] == ["stale: results/table1.csv shows other runs of A than there are; `uarm-rl report` makes it anew"]


def test_two_runs_are_compared(results, capsys):
    def compared(*words: str) -> list[str]:
        cli.main(["runs", *words])
        return capsys.readouterr().out.splitlines()

    one, other = "results/adaptive-plain/seed0", "results/adaptive-penalty/seed1"
    told = compared("--compare", one, other)
    assert told[0] == f"{one} and {other} differ in"
    assert set(told[1:]) >= {"  reward=plain, not penalty", "  seed=0, not 1", "  episodes=1500, not 2"}
    assert compared(f"compare=[{one},{one}]") == [f"{one} and {one} have the same settings"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["compare=[a]"], "compare takes two folders of runs, as in --compare results/a/seed0 results/b/seed0"),
        (["compare=[results/a/seed0,results/b/seed0]"], "there is no run folder results/a/seed0"),
        (["state=lost"], "state must be training or interrupted or trained or evaluated, got 'lost'"),
        (["results_dir=nowhere"], "nowhere is not a folder"),
    ],
)
def test_bad_words_get_a_sentence(results, capsys, words, sentence):
    with pytest.raises(SystemExit):
        cli.main(["runs", *words])
    assert capsys.readouterr().err.startswith(f"error: {sentence}")


def test_an_empty_folder_says_what_makes_a_run(tmp_path, capsys):
    cli.main(["runs", f"results_dir={tmp_path}"])
    assert capsys.readouterr().out == f"{tmp_path} holds no such run; uarm-rl train makes one\n"


def test_the_list_needs_neither_torch_nor_an_engine(results):
    import subprocess
    import sys

    code = "import sys; from uarm_rl import cli; cli.main(['runs']); print({'torch', 'pybullet', 'mujoco'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=results.parent, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"
