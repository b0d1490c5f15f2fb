"""An exported policy: it acts as the policy does, says what its numbers mean, and its card says how it did."""

from __future__ import annotations

import hashlib
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.conftest import uarm_rl
from tests.report import runs
from uarm_rl import cli
from uarm_rl.configuration import compose
from uarm_rl.task import kinematics, observation
from uarm_rl.task.policy import ActorPolicy
from uarm_rl.trained import policy_card

pytest.importorskip("onnx")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run with an actor of the paper's size, of random weights that saturate it here and there."""
    settings = compose("train", ("experiment=C", "sim=pybullet", "seed=3"))
    run = tmp_path_factory.mktemp("user") / "adaptive-penalty" / "seed3"
    runs.write_config(run, settings)
    runs.add_evaluation(run.parents[1], "C", 3, "1" * 90 + "0" * 10)
    runs.add_evaluation(run.parents[1], "C", 3, "0" * 4, "tolerance-1mm.csv", tolerance_m="0.001")
    generator, widths = np.random.default_rng(0), (observation.SIZE, 400, 300, 3)
    layers = [
        (generator.normal(0, 1.5 / np.sqrt(a), (a, b)).astype(np.float32), generator.normal(0, 0.1, b).astype(np.float32))
        for a, b in pairwise(widths)
    ]
    policy = ActorPolicy(layers, offset=observation.OFFSET, scale=observation.SCALE, card=policy_card(settings))
    policy.save(run / "policy.safetensors")
    return run


@pytest.fixture(scope="module")
def exported(run) -> Path:
    out = run.parents[1] / "made" / "policy.onnx"
    cli.main(["export", f"run={run}", "format=onnx", f"out={out}"])
    return out


@pytest.fixture(scope="module")
def observations() -> np.ndarray:
    wild = np.random.default_rng(1).uniform(-2, 2, (1000, observation.SIZE))
    return (observation.OFFSET + observation.SCALE * wild).astype(np.float32)


@pytest.mark.parametrize(("precision", "apart"), [("float64", 1e-6), ("float32", 2e-5)])
def test_it_acts_as_the_policy_does(run, observations, tmp_path, precision, apart):
    runtime = pytest.importorskip("onnxruntime")
    cli.main(["export", f"run={run}", f"precision={precision}", f"out={tmp_path / 'p.onnx'}"])
    session = runtime.InferenceSession(str(tmp_path / "p.onnx"), providers=["CPUExecutionProvider"])
    policy = ActorPolicy.load(run / "policy.safetensors")
    expected = np.array([policy.act(one) for one in observations])
    assert 0.01 < (np.abs(expected) > 0.99).mean() < 0.99
    (actions,) = session.run(["action"], {"observation": observations})
    assert (actions.dtype, actions.shape) == (np.float32, (1000, 3))
    assert np.abs(actions - expected).max() <= apart
    (one,) = session.run(["action"], {"observation": observations[:1]})
    assert np.abs(one - expected[:1]).max() <= apart


def test_it_says_what_its_numbers_mean(run, exported):
    import onnx

    described = json.loads(exported.with_suffix(".json").read_text())
    assert described.pop("file") == "policy.onnx"
    assert described.pop("sha256") == hashlib.sha256(exported.read_bytes()).hexdigest()
    assert described.pop("policy_sha256") == hashlib.sha256((run / "policy.safetensors").read_bytes()).hexdigest()
    assert described.pop("precision") == "float64"
    (inside,) = onnx.load(exported).metadata_props
    assert (inside.key, json.loads(inside.value)) == ("uarm-rl", described)
    assert [number["name"] for number in described["input"]["numbers"]] == list(observation.NAMES)
    assert [described["input"]["numbers"][place]["unit"] for place in (0, 15, 19)] == ["m", "rad", "0 or 1"]
    limits = [[number["low_rad"], number["high_rad"]] for number in described["output"]["numbers"]]
    np.testing.assert_array_equal(limits, kinematics.JOINT_LIMITS_RAD)
    assert described["policy"]["hold"]["name"] == "until_steady"
    assert described["policy"]["max_delta_rad"] == 0.15


def test_the_same_policy_is_the_same_file(run, exported, tmp_path):
    cli.main(["export", f"run={run}", f"out={tmp_path / 'policy.onnx'}"])
    for suffix in (".onnx", ".json", ".md"):
        assert (tmp_path / "policy").with_suffix(suffix).read_bytes() == exported.with_suffix(suffix).read_bytes()


def test_its_card_says_how_it_was_trained_and_how_it_did(exported):
    text = exported.with_suffix(".md").read_text()
    head, _, body = text.removeprefix("---\n").partition("---\n")
    assert yaml.safe_load(head)["license"] == "mit"
    assert body.startswith("\n# adaptive-penalty, seed 3\n")
    assert f"`policy.onnx`, SHA-256 `{hashlib.sha256(exported.read_bytes()).hexdigest()}`" in body
    for row in (
        "| evaluation (test positions) | 90 of 100 (82.6 to 94.5 %) | 2.00 | 5 | fixed(1) | pybullet |",
        "| tolerance-1mm (4 positions) | 0 of 4 (0.0 to 49.0 %) | - | 1 | fixed(1) | pybullet |",
        "| agent | ddpg, hidden layers 400, 300, gamma 0.9 |",
        "| episodes | 1500 of 200 stored experiences |",
        "| engine | pybullet |",
    ):
        assert row in body.splitlines()


def test_what_cannot_be_exported_is_said_and_nothing_is_written(run, tmp_path):
    there = tmp_path / "policy.json"
    there.write_text("mine")
    words = ("export", f"run={run}")
    for more, sentence in (
        (("out=policy.onnx",), "policy.json exists already; remove it, or choose another file with out=FILE.onnx"),
        (("out=policy.pt",), "out must end in .onnx, got policy.pt"),
        (("out=new.onnx", "format=tflite"), "format must be onnx, got 'tflite'"),
        (("out=new.onnx", "precision=int8"), "precision must be float64 or float32, got 'int8'"),
        (("out=new.onnx", "run=nowhere"), "there is no run folder nowhere; a run is results/NAME/seedN, made by uarm-rl train"),
    ):
        done = uarm_rl(*words, *more, cwd=tmp_path)
        assert (done.returncode, done.stderr.splitlines()[-1]) == (2, f"error: {sentence}")
    assert [path.name for path in tmp_path.iterdir()] == ["policy.json"]
    assert there.read_text() == "mine"


def test_without_onnx_the_extra_is_named(run, tmp_path, without):
    done = uarm_rl("export", f"run={run}", "out=p.onnx", cwd=tmp_path, environment=without("onnx"))
    remedy = "pip install -c constraints.txt -e '.[export]'"
    assert (done.returncode, done.stderr) == (2, f"error: onnx is not installed; export needs it; in the checkout: {remedy}\n")
