"""Policy files: what is saved is what is loaded, and nothing else is taken for a policy."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from itertools import pairwise

import numpy as np
import pytest
from safetensors.numpy import save

from tests.conftest import CARD
from tests.hostile.tensors import BROKEN
from uarm_rl.task import kinematics, observation
from uarm_rl.task.policy import ActorPolicy, InverseKinematicsPolicy, PolicyFileError, encode

#: The smallest policy.
TENSORS = {
    "offset": observation.OFFSET,
    "scale": observation.SCALE,
    "weight0": np.ones((20, 3), np.float32),
    "bias0": np.zeros(3, np.float32),
}


def policy(seed: int = 0, widths: tuple[int, ...] = (8, 6, 3)) -> ActorPolicy:
    generator = np.random.default_rng(seed)
    widths = (observation.SIZE, *widths)
    layers = [
        (generator.normal(0, 0.5, (a, b)).astype(np.float32), generator.normal(0, 0.5, b).astype(np.float32))
        for a, b in pairwise(widths)
    ]
    return ActorPolicy(layers, offset=observation.OFFSET, scale=observation.SCALE, card=CARD)


def test_round_trip(tmp_path):
    path = tmp_path / "policy.safetensors"
    policy().save(path)
    loaded = ActorPolicy.load(path)
    seen = np.random.default_rng(1).normal(0, 0.2, observation.SIZE).astype(np.float32)
    np.testing.assert_allclose(loaded.act(seen), policy().act(seen), atol=1e-6)
    loaded.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == path.read_bytes()
    (tmp_path / "again").unlink()
    assert loaded.card == CARD
    assert list(tmp_path.iterdir()) == [path]


def test_actions_stay_in_range_and_are_not_reused():
    one = policy()
    generator = np.random.default_rng(2)
    actions = [one.act(generator.normal(0, 0.05, observation.SIZE).astype(np.float32)) for _ in range(50)]
    assert np.abs(actions).max() <= 1
    assert len({action.tobytes() for action in actions}) > 40


def test_every_truncation_is_refused(tmp_path):
    path = tmp_path / "policy.safetensors"
    policy().save(path)
    data = path.read_bytes()
    for length in (*range(0, len(data), 97), len(data) - 1):
        path.write_bytes(data[:length])
        with pytest.raises(PolicyFileError, match="truncated, damaged or no policy"):
            ActorPolicy.load(path)


def test_a_flipped_bit_in_any_byte_is_refused(tmp_path):
    """In every bit: ``tests.torture``."""
    path = tmp_path / "policy.safetensors"
    ActorPolicy(policy(widths=(2, 3)).layers, offset=observation.OFFSET, scale=observation.SCALE, card=CARD).save(path)
    data = bytearray(path.read_bytes())
    for place in range(len(data)):
        data[place] ^= 1 << place % 8
        path.write_bytes(data)
        with pytest.raises(PolicyFileError):
            ActorPolicy.load(path)
        data[place] ^= 1 << place % 8


@pytest.mark.parametrize("content", [*BROKEN.values(), save({}), save(TENSORS), save(TENSORS, {"uarm-rl policy 1": "[]"})])
def test_foreign_files_are_refused(tmp_path, content):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(content)
    with pytest.raises(PolicyFileError, match=r"damaged or no policy|is no policy of uarm-rl: its format is"):
        ActorPolicy.load(path)


def test_a_format_of_the_future_is_named(tmp_path):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(save(TENSORS, {"uarm-rl policy 99": "{}"}))
    with pytest.raises(PolicyFileError, match="its format is uarm-rl policy 99"):
        ActorPolicy.load(path)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"weight0": np.ones((5, 3), np.float32)}, "another arm"),
        ({"weight0": np.full((20, 3), np.nan, np.float32)}, "not finite"),
        ({"scale": np.zeros(20, np.float32)}, "not finite"),
        ({"weight0": np.ones((20, 3)), "bias0": np.ones(3)}, "not finite float32"),
        ({"bias0": np.array([0, np.inf, 0], np.float32)}, "not finite"),
        ({"offset": np.full(20, np.nan, np.float32)}, "not finite"),
        ({"weight0": np.ones((20, 3), np.float16)}, "not finite float32"),
        ({"weight0": np.ones((20, 3), np.int8)}, "not finite float32"),
        ({"weight0": np.ones((20, 3), bool)}, "not finite float32"),
        ({"weight1": np.ones((3, 3), np.float32)}, "another arm"),
        ({"offset": np.zeros(21, np.float32)}, "another arm"),
        ({"scale": np.ones((), np.float32)}, "another arm"),
        ({"weight0": np.ones((3, 20), np.float32)}, "another arm"),
        ({"weight0": np.ones((1, 20, 3), np.float32)}, "another arm"),
        ({"weight0": np.ones((), np.float32)}, "another arm"),
        ({"bias0": np.zeros((1, 3), np.float32)}, "another arm"),
        ({"bias0": np.zeros(1, np.float32)}, "another arm"),
        ({"weight0": np.ones((20, 4), np.float32), "bias0": np.zeros(4, np.float32)}, "another arm"),
        ({"weight0": np.ones((20, 0), np.float32), "bias0": np.zeros(0, np.float32)}, "another arm"),
    ],
)
def test_policies_that_cannot_run_are_refused(tmp_path, change, sentence):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(encode(TENSORS | change, asdict(CARD)))
    with pytest.raises(PolicyFileError, match=sentence):
        ActorPolicy.load(path)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"hold": None}, "its card lacks hold"),
        ({"hold": "until_steady"}, "hold must be a group"),
        ({"hold": {}}, "hold.name must be a text"),
        ({"max_delta_rad": -1.0}, "max_delta_rad must be"),
        ({"seed": "0"}, "seed must be a whole number"),
        ({"wings": 2}, "a key that this version does not know, wings"),
    ],
)
def test_cards_that_cannot_be_followed_are_refused(tmp_path, change, sentence):
    card = {key: value for key, value in (asdict(CARD) | change).items() if value is not None}
    path = tmp_path / "policy.safetensors"
    path.write_bytes(encode(TENSORS, card))
    with pytest.raises(PolicyFileError, match=sentence):
        ActorPolicy.load(path)


def test_what_another_release_of_the_library_writes_around_the_tensors_does_not_count(tmp_path):
    path = tmp_path / "policy.safetensors"
    policy().save(path)
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = json.dumps(json.loads(data[8 : 8 + length]), indent=1).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header + data[8 + length :])
    assert ActorPolicy.load(path).card == CARD


def test_a_policy_of_a_file_acts_alike_whatever_sums_its_products(tmp_path):
    """The rows of a layer in another order are another order of summation; in float32 that shows in the action."""
    generator = np.random.default_rng(5)
    learner = policy(widths=(400, 300, 3))
    learner.save(tmp_path / "policy.safetensors")
    (first, bias), (second, _), *_ = learner.layers
    order = generator.permutation(400)
    turned = ActorPolicy(
        [
            (np.ascontiguousarray(first[:, order]), bias[order]),
            (np.ascontiguousarray(second[order]), learner.layers[1][1]),
            learner.layers[2],
        ],
        offset=learner.offset,
        scale=learner.scale,
        card=CARD,
    )
    turned.save(tmp_path / "turned.safetensors")
    one, other = (ActorPolicy.load(tmp_path / f"{name}.safetensors") for name in ("policy", "turned"))
    seen = [generator.uniform(-0.3, 0.3, observation.SIZE).astype(np.float32) for _ in range(300)]
    actions = [(one.act(observed), other.act(observed), learner.act(observed), turned.act(observed)) for observed in seen]
    assert all(action.dtype == np.float32 for row in actions for action in row)
    assert all(np.array_equal(row[0], row[1]) for row in actions)
    assert not all(np.array_equal(row[2], row[3]) for row in actions)  # what the learner's own float32 shows


def test_policies_need_neither_torch_nor_pybullet():
    code = "import sys, uarm_rl.task.policy; print({'torch', 'pybullet', 'gymnasium'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "set()"


def test_inverse_kinematics_sends_the_clipped_joint_difference():
    joints = kinematics.HOME_JOINTS_RAD
    near = joints + [0.02, -0.01, 0.01]
    target = kinematics.cup_position(near)
    seen = observation.observe(joints.tolist(), kinematics.forward(joints), target, False)
    baseline = InverseKinematicsPolicy(max_delta_rad=0.15, aligned_m=1.0)
    np.testing.assert_allclose(baseline.act(seen) * 0.15, near - joints, atol=1e-6)
    far = observation.observe(joints.tolist(), kinematics.forward(joints), (0.0, 0.3, 0.03), False)
    assert np.abs(baseline.act(far)).max() == 1.0
