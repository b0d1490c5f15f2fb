"""Many runs in one process, by the command line: each has the files of a run on its own, whatever becomes of the others."""

from __future__ import annotations

import csv
import signal
from pathlib import Path

import pytest
import torch

from tests.commands.test_multirun import SWEEP, TINY, TOLD, run
from uarm_rl.learn import checkpoint

__all__ = ["run"]  # the fixture

RUNS = ("agent.n_steps=2", "episodes=3", "checkpoint_every=2", "buffer.capacity=45", *TINY)
RUNS = tuple(word for word in RUNS if word != "episodes=1")


def outcome(folder: Path) -> tuple[bytes, list[dict[str, str]]]:
    with open(folder / "progress.csv", newline="") as file:
        rows = [{name: value for name, value in row.items() if name != "wall_s"} for row in csv.DictReader(file)]
    return (folder / "policy.safetensors").read_bytes(), rows


def test_each_run_has_the_bytes_that_it_has_alone_killed_and_resumed_in_other_company_too(run, tmp_path, monkeypatch):
    methods = ("buffer=adaptive,uniform", *RUNS)
    assert run("train", "-m", "seed=0,1", *methods, "results_dir=alone") == (0, "")
    write = checkpoint.write

    def write_and_interrupt(folder, saved):
        write(folder, saved)
        if saved.episode == 2 and folder.match("uniform-penalty/seed0"):
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "write", write_and_interrupt)
        code, said = run("train", "-m", "seed=0", *methods, "stacked=true", "results_dir=many")
    assert (code, "stopping and saving" in said) == (130, True)
    assert not list((tmp_path / "many").rglob("policy.safetensors"))
    assert run("train", "buffer=uniform", "seed=0", *RUNS, "resume=true", "results_dir=many") == (0, "")
    assert run("train", "-m", "seed=0,1", *methods, "stacked=true", "resume=true", "results_dir=many") == (0, "")
    for folder in (tmp_path / "alone").glob("*/seed*"):
        assert outcome(tmp_path / "many" / folder.relative_to(tmp_path / "alone")) == outcome(folder)
        assert (tmp_path / "many" / folder.relative_to(tmp_path / "alone") / "config.yaml").read_bytes() == (
            folder / "config.yaml"
        ).read_bytes()


def test_a_failing_one_is_told_once_and_does_not_stop_the_others(run, tmp_path):
    code, said = run(*SWEEP, "stacked=true")
    assert (code, said.splitlines()) == (2, TOLD)
    assert (tmp_path / "results" / "gamma-0.9" / "seed3" / "policy.safetensors").exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("stacked=true", "hydra/launcher=joblib"), "hydra/launcher=joblib gives each run a process"),
        (("stacked=true", "logger=mlflow"), "logger=mlflow has one run a process"),
        (("stacked=perhaps",), "stacked must be true or false"),
        (("device=tpu",), "device must be cpu or cuda, got 'tpu'"),
        pytest.param(
            ("device=cuda",),
            "device=cuda needs a GPU that torch can use, and here is none; device=cpu trains without",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU"),
        ),
    ],
)
def test_what_cannot_be_is_refused_before_the_first(run, tmp_path, words, sentence):
    code, said = run("train", "-m", "seed=0,1", *TINY, *words)
    assert (code, sentence in said) == (2, True), said
    assert list(tmp_path.rglob("policy.safetensors")) == []


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")
def test_on_a_gpu_a_run_begins_as_on_the_processor_and_goes_on_there(run, tmp_path):
    assert run("train", *RUNS, "results_dir=cpu") == (0, "")
    assert run("train", "-m", "seed=0,1", *RUNS, "device=cuda", "results_dir=gpu") == (0, "")
    (_, ours), (_, theirs) = (outcome(tmp_path / where / "adaptive-penalty" / "seed0") for where in ("gpu", "cpu"))
    assert float(ours[0]["episode_return"]) == pytest.approx(float(theirs[0]["episode_return"]), rel=1e-3)
    assert len(ours) == len(theirs)
