"""Policy files: what is saved is what is loaded, and nothing else is taken for a policy."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from safetensors.numpy import save

from uarm_rl.task import kinematics, observation
from uarm_rl.task.policy import ActorPolicy, InverseKinematicsPolicy, PolicyFileError

METADATA = {"max_delta_rad": 0.15, "hold": {"name": "fixed", "control_steps": 1}}


def policy(seed: int = 0, widths: tuple[int, ...] = (8, 6, 3)) -> ActorPolicy:
    generator = np.random.default_rng(seed)
    widths = (observation.SIZE, *widths)
    layers = [
        (generator.normal(0, 0.5, (a, b)).astype(np.float32), generator.normal(0, 0.5, b).astype(np.float32))
        for a, b in pairwise(widths)
    ]
    return ActorPolicy(layers, offset=observation.OFFSET, scale=observation.SCALE, metadata=METADATA)


def test_round_trip(tmp_path):
    path = tmp_path / "policy.safetensors"
    policy().save(path)
    loaded = ActorPolicy.load(path)
    seen = np.random.default_rng(1).normal(0, 0.2, observation.SIZE).astype(np.float32)
    np.testing.assert_array_equal(loaded.act(seen), policy().act(seen))
    assert loaded.metadata == METADATA
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


def test_every_flipped_bit_is_refused(tmp_path):
    path = tmp_path / "policy.safetensors"
    ActorPolicy(policy(widths=(2, 3)).layers, offset=observation.OFFSET, scale=observation.SCALE, metadata=METADATA).save(path)
    data = bytearray(path.read_bytes())
    for bit in range(8 * len(data)):
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        with pytest.raises(PolicyFileError):
            ActorPolicy.load(path)
        data[bit // 8] ^= 1 << bit % 8


def test_foreign_files_are_refused(tmp_path):
    path = tmp_path / "policy.safetensors"
    good = {"offset": observation.OFFSET, "scale": observation.SCALE}
    damaged = [
        b"",
        b"PK\x03\x04",
        b"\x80\x04K\x01.",
        os.urandom(200),
        save({}),
        save(good),
        save(good, {"uarm-rl policy 1": "[]"}),
    ]
    for content in damaged:
        path.write_bytes(content)
        with pytest.raises(PolicyFileError, match="damaged or no policy"):
            ActorPolicy.load(path)
    path.write_bytes(save(good, {"uarm-rl policy 99": "{}"}))
    with pytest.raises(PolicyFileError, match="its format is uarm-rl policy 99"):
        ActorPolicy.load(path)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"layers": [(np.ones((5, 3), np.float32), np.ones(3, np.float32))]}, "another arm"),
        ({"layers": [(np.full((20, 3), np.nan, np.float32), np.ones(3, np.float32))]}, "not finite"),
        ({"scale": np.zeros(20, np.float32)}, "not finite"),
        ({"metadata": {"max_delta_rad": 0.15}}, "lacks max_delta_rad or hold"),
    ],
)
def test_policies_that_cannot_run_are_refused(tmp_path, change, sentence):
    parts = {"layers": policy().layers, "offset": observation.OFFSET, "scale": observation.SCALE, "metadata": METADATA} | change
    path = tmp_path / "policy.safetensors"
    ActorPolicy(parts.pop("layers"), **parts).save(path)
    with pytest.raises(PolicyFileError, match=sentence):
        ActorPolicy.load(path)


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
