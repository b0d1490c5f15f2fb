"""Evaluation: its rows, its independence of workers, its measures of shaking."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from uarm_rl import cli, positions
from uarm_rl.evaluate import COLUMNS, evaluate, shaking
from uarm_rl.policy import InverseKinematicsPolicy

SETTINGS = cli.compose("train", ("time_limit_s=4",))
COMMON = cli.build("reward", cli.compose("train", ("reward=penalty",))["reward"])


def rows(workers: int, count: int = 6, policy: object = None) -> list[dict[str, object]]:
    make = partial(cli.build_env, SETTINGS, time_limit_s=4.0)
    policy = policy or InverseKinematicsPolicy(0.15)
    where = positions.load_packaged("validation_positions.csv")[:count]
    return list(evaluate(make, policy, where, COMMON, control_hz=20, workers=workers))


def test_evaluations_are_identical_however_many_work_on_them():
    assert rows(1) == rows(1) == rows(2)


def test_inverse_kinematics_reaches_every_validation_position():
    settings = cli.compose("train")
    make = partial(cli.build_env, settings, time_limit_s=10.0)
    where = positions.load_packaged("validation_positions.csv")
    result = list(evaluate(make, InverseKinematicsPolicy(0.15), where, COMMON, control_hz=20, workers=1))
    assert sum(row["success"] for row in result) == 50
    for row in result:
        assert set(row) == set(COLUMNS)
        assert row["final_distance_m"] <= 0.005
        assert row["min_distance_m"] <= row["final_distance_m"]
        assert row["object_displacement_m"] < 0.005
        assert 0 < row["time_s"] < 10


class Still:
    def act(self, observation):
        return np.zeros(3, np.float32)


def test_a_policy_that_does_nothing_fails_and_does_not_shake():
    for row in rows(1, count=2, policy=Still()):
        assert not row["success"]
        assert row["time_s"] == 4.0
        assert row["tip_travel_last_s_m"] < 1e-5
        assert row["reversals_per_s"] == 0
        # 80 control steps at the same distance d, alpha = 1, no progress: -80 d in the 1-norm of d_h and d_v
        assert row["common_return"] < -80 * row["final_distance_m"] * 0.99


def test_shaking_of_known_paths():
    time = np.arange(0, 5, 0.05)
    still = np.tile([0.2, 0.0, 0.1], (len(time), 1))
    assert shaking(still, control_hz=20) == {"reversals_per_s": 0, "rms_jerk": 0, "tip_travel_last_s_m": 0}
    straight = still + np.outer(time, [0.1, 0, 0])
    result = shaking(straight, control_hz=20)
    assert result["reversals_per_s"] == 0
    assert result["tip_travel_last_s_m"] == pytest.approx(0.1)
    assert result["rms_jerk"] == pytest.approx(0, abs=1e-6)
    zigzag = still.copy()
    zigzag[::2, 1] += 0.002  # turns at every control step
    result = shaking(zigzag, control_hz=20)
    assert result["reversals_per_s"] == pytest.approx(20, rel=0.03)
    assert result["tip_travel_last_s_m"] == pytest.approx(20 * 0.002)
    assert result["rms_jerk"] == pytest.approx(8 * 0.002 * 20**3 / 2, rel=0.01)  # 3rd difference of +-a/2 is 4a
    assert shaking(still[:2], control_hz=20)["rms_jerk"] == 0
