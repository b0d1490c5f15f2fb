"""Words, surroundings and multiruns: one sentence for what is wrong, and nothing lost."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.commands.test_cli import assert_refused
from tests.conftest import FAST, uarm_rl
from uarm_rl.commands.completion import candidates

QUICK = (*FAST, "episodes=1", "simulate_beside=false")


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["train", "bufer=uniform"], ["no setting 'bufer'", "did you mean buffer?"]),
        (["train", "agent.gama=0.5"], ["no setting 'agent.gama'", "did you mean agent.gamma?"]),
        (["train", "seed=0,1"], ["seed=0,1 are several values", "-m", "seed=[0,1]"]),
        (["train", "seed=-1"], ["seed must be a whole number from 0 to 4294967296, got -1"]),
        (["train", "episodes=1e3"], ["episodes must be a whole number", "write episodes=1000"]),
        (["train", "agent.hidden=64"], ["agent.hidden must be a list of whole numbers", "got 64"]),
        (["train", "agent.hidden=[]"], ["agent.hidden must be a list of whole numbers"]),
        (["train", "batch_size=100000"], ["batch_size must be a whole number from 1 to 10000"]),
        (["train", "resume=true", "overwrite=true"], ["give one of them"]),
        (["train", "sim.gui=true", *QUICK], ["needs a screen"]),
        (["render", "run=x", "position=abc"], ["position must be three numbers"]),
        (["render", "run=x", "width=100000"], ["width must be a whole number from 64 to 4096"]),
        (["render", "run=x", "out=films/a.gif"], ["there is no folder films"]),
        (["render", "run=x", "out=a.mp4", "width=321"], ["even width and height"]),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_done(tmp_path, words, parts):
    done = uarm_rl(*words, cwd=tmp_path, environment={"DISPLAY": ""})
    assert_refused(done, done.returncode, *parts)
    assert done.returncode in (1, 2)
    assert list(tmp_path.iterdir()) == []


def test_an_extra_that_is_missing_is_named_with_its_pip_line(tmp_path):
    hide = "import sys; sys.modules.update({'hydra_plugins.hydra_joblib_launcher': None, 'tensorboard': None}); "
    code = f"{hide}from uarm_rl.cli import main; main(sys.argv[1:])"
    for words, extra in ((["-m", "hydra/launcher=joblib"], "launch"), (["tensorboard=true", *QUICK], "tensorboard")):
        command = [sys.executable, "-c", code, "train", *words]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert_refused(done, 2, f"pip install -c constraints.txt -e '.[{extra}]'")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [["--help"], ["report"], ["train", *QUICK], ["evaluate", "run=nowhere"], ["doctor"]])
@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
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


def test_jobs_that_would_share_a_folder_are_refused_before_the_first(tmp_path):
    done = uarm_rl("train", "-m", "agent.gamma=0.9,0.99", *QUICK, "results_dir=q", cwd=tmp_path)
    assert_refused(
        done, 2, "would both train in q/adaptive-penalty/seed0", "name=${buffer.name}-${reward.name}-gamma${agent.gamma}"
    )
    assert not list(tmp_path.glob("q/*/seed*"))


def test_a_failing_job_is_named_once_in_our_words_alone(tmp_path):
    words = ("train", "-m", "agent.gamma=2,0.9", "name=g${agent.gamma}", *QUICK)
    done = uarm_rl(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("agent.gamma must be a number from 0 to 1, got 2") == 1
    assert "Error executing job" not in done.stdout + done.stderr
    assert (tmp_path / "results" / "g0.9" / "seed0" / "policy.safetensors").exists()


def test_a_setting_that_is_given_twice_is_told(tmp_path):
    done = uarm_rl("train", "-m", "seed=0", "seed=1", *QUICK, cwd=tmp_path)
    assert "note: seed is given twice, and seed=1 counts; seed=A,B is a run of each" in done.stderr
    assert [path.name for path in tmp_path.glob("results/*/*")] == ["seed1"]


def test_a_name_in_any_alphabet(tmp_path):
    done = uarm_rl("train", "name=Ümlaut", *QUICK, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "results" / "Ümlaut" / "seed0" / "policy.safetensors").exists()


def test_a_finished_run_leaves_nothing_that_only_a_training_needs(tmp_path):
    assert uarm_rl("train", *QUICK, cwd=tmp_path).returncode == 0
    (run,) = tmp_path.glob("results/*/seed0")
    assert sorted(path.name for path in run.iterdir()) == ["config.yaml", "policy.safetensors", "progress.csv"]


def test_a_missing_value_does_not_keep_the_configuration_from_being_seen(tmp_path):
    done = uarm_rl("render", "--cfg", "job", cwd=tmp_path)
    assert (done.returncode, "run: ???" in done.stdout) == (0, True), done.stderr


@pytest.mark.parametrize(
    ("line", "some", "none"),
    [
        ("uarm-rl train --epi", {"--episodes="}, {"--experiment="}),
        ("uarm-rl train --seed=0 bat", {"batch_size="}, set()),
        ("uarm-rl report ", {"results_dir="}, {"servo=", "buffer=", "episodes="}),
        ("uarm-rl train resume=", {"resume=true", "resume=false"}, set()),
        ("uarm-rl train experiment=", {"experiment=A"}, set()),
        ("uarm-rl evaluate run=a", {"run=a/", "run=ab.csv"}, set()),
        ("uarm-rl jog li", {"limits=", "limits.z_m="}, set()),
    ],
)
def test_completion_offers_what_the_command_takes(tmp_path, monkeypatch, line, some, none):
    (tmp_path / "a").mkdir()
    (tmp_path / "ab.csv").touch()
    monkeypatch.chdir(tmp_path)
    offered = set(candidates(line))
    assert some <= offered
    assert not none & offered
