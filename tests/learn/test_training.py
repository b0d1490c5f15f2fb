"""Training through the command line's own functions: determinism, resume, folders."""

from __future__ import annotations

import csv
import itertools
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import FAST, uarm_rl
from uarm_rl import configuration, progress
from uarm_rl.commands import train as commands_train
from uarm_rl.evaluation import evaluate
from uarm_rl.learn import checkpoint
from uarm_rl.learn.async_env import InlineEnv, SubprocessEnv
from uarm_rl.learn.ddpg import DDPG, DivergenceError
from uarm_rl.learn.run import RunFolderError
from uarm_rl.sim import engines
from uarm_rl.task.arm import ArmError
from uarm_rl.task.env import UArmSuctionEnv


def train(results: Path, *overrides: str) -> Path:
    settings = configuration.compose("train", (*FAST, f"results_dir={results}", "simulate_beside=false", *overrides))
    commands_train.run(settings)
    return results / settings["name"] / f"seed{settings['seed']}"


def outcome(run: Path) -> dict[str, object]:
    """What must be identical: the policy's bytes, and the log without its wall time."""
    with open(run / "progress.csv", newline="") as file:
        rows = [{key: value for key, value in row.items() if key != "wall_s"} for row in csv.DictReader(file)]
    return {"policy": (run / "policy.safetensors").read_bytes(), "progress": rows}


def interrupt_after(monkeypatch: pytest.MonkeyPatch, episode: int) -> None:
    """Send this process a Ctrl-C at the end of an episode, as a user would."""
    write = checkpoint.write

    def write_and_interrupt(run_dir, saved):
        write(run_dir, saved)
        if saved.episode == episode:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(checkpoint, "write", write_and_interrupt)


@pytest.mark.parametrize("method", ["buffer=uniform", "buffer=adaptive"])
def test_the_same_seed_trains_the_same_policy(tmp_path, method):
    first = outcome(train(tmp_path / "a", method))
    assert first == outcome(train(tmp_path / "b", method))
    assert first != outcome(train(tmp_path / "c", method, "seed=1"))
    rows = first["progress"]
    assert [int(row["episode"]) for row in rows] == [1, 2, 3, 4]
    assert [int(row["experiences"]) for row in rows] == [25, 50, 75, 100]
    assert [row["validation_success_rate"] != "" for row in rows] == [False, True, False, True]
    assert all(0 < float(row["admission_rate"]) <= 1 for row in rows)


def test_simulating_beside_gives_the_same_numbers(tmp_path):
    inline = outcome(train(tmp_path / "a"))
    settings = configuration.compose("train", (*FAST, f"results_dir={tmp_path / 'b'}", "simulate_beside=true"))
    commands_train.run(settings)
    assert outcome(tmp_path / "b" / settings["name"] / "seed0") == inline


def interrupt_in(monkeypatch: pytest.MonkeyPatch, owner: object, name: str, number: int, signum: signal.Signals) -> None:
    """Signal this process inside the ``number``-th call of a function."""
    real, calls = getattr(owner, name), itertools.count(1)

    def call(*arguments, **keywords):
        if next(calls) == number:
            signal.raise_signal(signum)
        return real(*arguments, **keywords)

    monkeypatch.setattr(owner, name, call)


@pytest.mark.parametrize(
    ("owner", "name", "number", "saved_episode"),
    [
        (UArmSuctionEnv, "step", 3, 0),
        (DDPG, "update", 10, 1),
        (DDPG, "update", 74, 3),
        (evaluate, "run_episode", 2, 1),  # in the first validation, after episode 2
        (evaluate, "run_episode", 53, 3),  # in the last one
    ],
)
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_is_at_once_and_loses_only_the_episode_in_hand(
    tmp_path, monkeypatch, owner, name, number, saved_episode, signum
):
    wrapping = "buffer.capacity=60"  # the next episode has already overwritten the oldest rows when the stop comes
    whole = outcome(train(tmp_path / "whole", wrapping))
    with monkeypatch.context() as patch, pytest.raises(SystemExit) as stopped:
        interrupt_in(patch, owner, name, number, signum)
        train(tmp_path / "parts", wrapping, "checkpoint_every=4")
    assert stopped.value.code == 130
    (run,) = (tmp_path / "parts").glob("*/seed0")
    assert [path.name for path in run.glob("checkpoint-*")] == [f"checkpoint-{saved_episode:06d}"]
    assert outcome(train(tmp_path / "parts", wrapping, "checkpoint_every=4", "resume=true")) == whole


PRIORITIZED = ("sampling@buffer.sampling=prioritized", "agent.n_steps=3", "buffer.capacity=60")


@pytest.mark.parametrize(
    "method",
    [
        ("buffer=uniform",),
        ("buffer=adaptive",),
        ("buffer=every_step", *PRIORITIZED),
        ("buffer=learned_hold", "observation=stack", "actions=reference"),
        ("buffer=adaptive", "hindsight_targets=3", "agent.annealing=0.5"),
    ],
    ids=["uniform", "adaptive", "prioritized", "learned", "hindsight"],
)
def test_an_interrupted_and_resumed_run_ends_as_an_uninterrupted_one(tmp_path, monkeypatch, method, capsys):
    whole = outcome(train(tmp_path / "whole", *method))
    with monkeypatch.context() as patch:
        interrupt_after(patch, episode=2)
        with pytest.raises(SystemExit) as stopped:
            train(tmp_path / "parts", *method)
    assert stopped.value.code == 130
    assert "resume=true continues it" in capsys.readouterr().out
    run = train(tmp_path / "parts", *method, "resume=true")
    assert outcome(run) == whole


def test_resuming_a_finished_run_changes_nothing(tmp_path, capsys):
    run = train(tmp_path)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    train(tmp_path, "resume=true")
    assert "finished; nothing to do" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_a_finished_run_does_not_pass_for_another(tmp_path):
    run = train(tmp_path)
    before = outcome(run)
    with pytest.raises(RunFolderError, match=r"was begun with agent\.tau=0\.005, not 0\.5"):
        train(tmp_path, "resume=true", "agent.tau=0.5")
    assert outcome(run) == before


def test_a_finished_run_is_not_overwritten_unasked(tmp_path):
    run = train(tmp_path)
    before = outcome(run)
    with pytest.raises(RunFolderError, match=r"already holds a finished run; results_dir=FOLDER"):
        train(tmp_path)
    assert outcome(run) == before
    train(tmp_path, "overwrite=true", "episodes=1")
    assert len(outcome(run)["progress"]) == 1


def test_an_interrupted_run_is_not_resumed_with_another_configuration(tmp_path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        interrupt_after(patch, episode=2)
        train(tmp_path)
    with pytest.raises(RunFolderError, match=r"was begun with agent\.gamma=0\.9, not 0\.8"):
        train(tmp_path, "resume=true", "agent.gamma=0.8")


def test_a_folder_in_use_is_refused(tmp_path):
    run = tmp_path / "adaptive-penalty" / "seed0"
    run.mkdir(parents=True)
    hold = "import filelock, sys; lock = filelock.FileLock(sys.argv[1]); lock.acquire(); print('held', flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", hold, str(run / ".lock")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(RunFolderError, match="another process is training"):
            train(tmp_path)
        other.communicate("\n")


def test_a_sick_training_is_warned_of_in_the_log_and_at_the_bar(tmp_path, capsys):
    rows = outcome(train(tmp_path, "agent.final_layer_init=100", "agent.gamma=0"))["progress"]
    first = next(row for row in rows if row["warning"])
    pattern = r"critic in \[.*\], possible is \[-.*, 11\..*\]; actor saturated in (9\d|100)% of its outputs"
    assert re.fullmatch(pattern, first["warning"])
    err = capsys.readouterr().err
    assert f"warning: episode {first['episode']}: {first['warning']}" in err
    assert err.count("warning: ") == 1  # once, not in every episode; the bar keeps its mark
    assert "WARNING" in err


@pytest.mark.parametrize("victim", ["a weight", "a reward"])
def test_a_number_that_is_not_finite_leaves_a_good_checkpoint(tmp_path, monkeypatch, victim):
    whole = outcome(train(tmp_path / "whole"))
    with monkeypatch.context() as patch, pytest.raises(DivergenceError, match=r"finite|nan"):
        if victim == "a weight":
            spoil(patch, DDPG, "update", 60, lambda agent, _: agent.parameters[1000:1001].fill_(float("nan")))
        else:
            spoil(patch, InlineEnv, "step_wait", 60, lambda _, result: (result[0], float("nan"), *result[2:]))
        train(tmp_path / "parts")
    (run,) = (tmp_path / "parts").glob("*/seed0")
    assert not (run / "policy.safetensors").exists()
    assert all(np.isfinite(array).all() for array in checkpoint.read_latest(run).arrays.values())
    assert outcome(train(tmp_path / "parts", "resume=true")) == whole


def spoil(monkeypatch: pytest.MonkeyPatch, owner: type, name: str, number: int, change: Callable) -> None:
    """Let ``change`` see, and replace, what the ``number``-th call of a method returns."""
    real, calls = getattr(owner, name), itertools.count(1)

    def call(self, *arguments):
        result = real(self, *arguments)
        return change(self, result) if next(calls) == number else result

    monkeypatch.setattr(owner, name, call)


def test_a_healthy_training_is_not_warned_of(tmp_path):
    rows = outcome(train(tmp_path))["progress"]
    assert {row["warning"] for row in rows} == {""}
    assert all(float(row["q_min"]) <= float(row["q_max"]) and 0 <= float(row["saturation"]) <= 1 for row in rows[1:])


def test_a_training_whose_bar_was_switched_off_is_trained_all_the_same(tmp_path):
    """By the variable of tqdm, which reads it when it is imported."""
    words = ("train", *FAST, f"sim={engines.installed()}", "simulate_beside=false")
    done = uarm_rl(*words, cwd=tmp_path, environment={"TQDM_DISABLE": "1"})
    assert (done.returncode, done.stderr) == (0, "")
    assert len(list(tmp_path.glob("results/*/seed0/policy.safetensors"))) == 1


def test_a_dead_simulator_is_named():
    env = SubprocessEnv(_explode, 0)
    with pytest.raises(ArmError, match="the motors are on strike"):
        env.reset(home=True)
    env._process.kill()
    env._process.join()
    with pytest.raises(ArmError, match="has died"):
        env.step_async(np.zeros(3, np.float32))
        env.step_wait()
    env.close()


def _explode():
    raise ArmError("the motors are on strike")


def test_an_episode_that_takes_long_shows_a_sign_of_life(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(progress._Lines, "silence_s", 0.0)
    train(tmp_path, "episodes=1")
    assert capsys.readouterr().err.count(": 0 of 1 episodes, ") >= 25  # one each decision
