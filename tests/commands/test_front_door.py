"""Words, surroundings and multiruns: one sentence for what is wrong, and nothing lost."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands.test_cli import assert_refused
from tests.conftest import FAST, uarm_rl

RUN = Path(__file__).parents[2] / "results" / "adaptive-plain" / "seed0"

QUICK = (*FAST, "episodes=1", "simulate_beside=false")


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["train", "bufer=uniform"], ["no setting 'bufer'", "did you mean buffer?"]),
        (["train", "agent.gama=0.5"], ["no setting 'agent.gama'", "did you mean agent.gamma?"]),
        (["train", "seed=0,1"], ["seed=0,1 are several values", "-m", "seed=[0,1]"]),
        (["train", "seed=-1"], ["seed must be a whole number from 0 to 4294967296, got -1"]),
        (["train", "episodes=1e3"], ["episodes must be a whole number", "write episodes=1000"]),
        (["train", "agent.hidden=64"], ["agent.hidden must be a list, as in agent.hidden=[400,300]", "got 64"]),
        (["train", "agent.hidden=[]"], ["agent.hidden must be a list, as in agent.hidden=[400,300]"]),
        (["train", "batch_size=100000"], ["batch_size must be a whole number from 1 to 10000"]),
        (["train", "resume=true", "overwrite=true"], ["give one of them"]),
        (["train", "sim.gui=true", *QUICK], ["needs a screen"]),
        (["render", "run=x", "position=abc"], ["position must be three numbers"]),
        (["render", "run=x", "width=100000"], ["width must be a whole number from 64 to 4096"]),
        (["render", "run=x"], ["there is no run folder x; a run is results/NAME/seedN"]),
        (["render", f"run={RUN}", "out=films/a.gif"], ["there is no folder films"]),
        (["render", f"run={RUN}", "out=a.mp4", "width=321"], ["even width and height"]),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_done(tmp_path, monkeypatch, words, parts):
    monkeypatch.delenv("DISPLAY", raising=False)
    done = uarm_rl(*words, cwd=tmp_path)
    assert_refused(done, done.returncode, *parts)
    assert done.returncode in (1, 2)
    assert list(tmp_path.iterdir()) == []


def test_an_extra_that_is_missing_is_named_with_its_pip_line(tmp_path):
    hide = "import sys; sys.modules.update({'hydra_plugins': None, 'tensorboard': None}); "
    code = f"{hide}from uarm_rl.cli import main; main(sys.argv[1:])"
    launchers = {"joblib": "launch", "submitit_slurm": "slurm", "submitit_local": "slurm", "ray": "ray"}
    chosen = [(["-m", f"hydra/launcher={name}"], extra) for name, extra in launchers.items()]
    for words, extra in (*chosen, (["logger=tensorboard", *QUICK], "tensorboard")):
        command = [sys.executable, "-c", code, "train", *words]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert_refused(done, 2, f"pip install -c constraints.txt -e '.[{extra}]'")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "closed"),
    [
        (["--help"], (1,)),
        (["evaluate", "run=nowhere"], (2,)),
        (["doctor"], (0, 1, 2)),
        (["train", *QUICK], (0, 1, 2)),
    ],
)
def test_closed_streams_change_nothing_but_what_is_seen(tmp_path, words, closed):
    redirections = " ".join(f"{number}>&-" for number in closed)
    command = f'exec "$0" -m uarm_rl "$@" {redirections}'
    plain = uarm_rl(*words, cwd=tmp_path / "plain" if (tmp_path / "plain").mkdir() is None else tmp_path)
    (tmp_path / "closed").mkdir()
    done = subprocess.run(
        ["sh", "-c", command, sys.executable, *words], cwd=tmp_path / "closed", capture_output=True, text=True, check=False
    )
    assert (done.returncode, "bug" in done.stderr) == (plain.returncode, False), done.stderr
    made, expected = (
        sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))
        for folder in (tmp_path / "closed", tmp_path / "plain")
    )
    assert made == expected
    for path in (tmp_path / "closed").rglob("config.yaml"):
        assert path.read_bytes() == (tmp_path / "plain" / path.relative_to(tmp_path / "closed")).read_bytes()


def test_a_full_device_is_said(tmp_path):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "uarm_rl", "--help"]
        done = subprocess.run(command, cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert_refused(done, 1, "No space left on device")


def test_no_home_and_no_temporary_folder_are_needed(tmp_path):
    keep = {name: os.environ[name] for name in ("PATH",)}
    command = [sys.executable, "-m", "uarm_rl", "train", *QUICK]
    surroundings = keep | {"TMPDIR": "/proc", "HOME": "/nonexistent"}
    done = subprocess.run(command, cwd=tmp_path, env=surroundings, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    command = [sys.executable, "-m", "uarm_rl", "report"]
    done = subprocess.run(command, cwd=tmp_path, env=surroundings, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    assert (tmp_path / "results" / "table1.csv").exists()


def test_a_name_in_any_alphabet(tmp_path):
    done = uarm_rl("train", "name=zwei Ümlaute", *QUICK, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "results" / "zwei Ümlaute" / "seed0" / "policy.safetensors").exists()
    assert done.stdout.endswith("uarm-rl evaluate run='results/zwei Ümlaute/seed0'\n")


def test_a_finished_run_leaves_nothing_that_only_a_training_needs(tmp_path):
    assert uarm_rl("train", *QUICK, cwd=tmp_path).returncode == 0
    (run,) = tmp_path.glob("results/*/seed0")
    assert sorted(path.name for path in run.iterdir()) == ["config.yaml", "policy.safetensors", "progress.csv"]
