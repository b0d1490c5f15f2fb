"""Evaluation: its rows, its independence of workers, its measures of shaking."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from uarm_rl import configuration
from uarm_rl.evaluation.evaluate import evaluate
from uarm_rl.evaluation.measures import COLUMNS, CONDITIONS, MEASURED, TRACES, measure, shaking, trace_rows
from uarm_rl.task import positions
from uarm_rl.task.env import TRACE_COLUMNS
from uarm_rl.task.policy import InverseKinematicsPolicy
from uarm_rl.task.rollout import Episode

SETTINGS = configuration.compose("train", ("time_limit_s=4",))
COMMON = configuration.build("reward", configuration.compose("train", ("reward=penalty",))["reward"])


def episodes(workers: int, count: int = 6, policy: object = None, time_limit_s: float = 4.0) -> list[Episode]:
    make = partial(configuration.build_env, SETTINGS, time_limit_s=time_limit_s)
    policy = policy or InverseKinematicsPolicy(0.15)
    return list(evaluate(make, policy, positions.load_named("validation")[:count], processes=workers))


def rows(episodes: list[Episode]) -> list[dict[str, object]]:
    return [measure(number, episode, COMMON, control_hz=20) for number, episode in enumerate(episodes)]


def test_evaluations_are_identical_however_many_work_on_them():
    one, again, two = episodes(1), episodes(1), episodes(2)
    assert rows(one) == rows(again) == rows(two)
    for first, second in zip(one, two, strict=True):
        assert first.trace.tobytes() == second.trace.tobytes()


def test_inverse_kinematics_reaches_every_validation_position():
    result = rows(episodes(1, count=50, time_limit_s=10.0))
    assert sum(row["success"] for row in result) == 50
    for row in result:
        assert tuple(row) == MEASURED
        assert row["final_distance_m"] <= 0.005
        assert row["min_distance_m"] <= row["final_distance_m"]
        assert row["object_displacement_m"] < 0.005
        assert 0 < row["time_s"] < 10


class Still:
    def act(self, observation):
        return np.zeros(3, np.float32)


def test_a_policy_that_does_nothing_fails_and_does_not_shake():
    for row in rows(episodes(1, count=2, policy=Still())):
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


def test_a_file_says_under_which_conditions_it_was_made():
    assert (*MEASURED, *CONDITIONS) == COLUMNS
    assert CONDITIONS[:2] == ("tolerance_m", "hold")


def test_traces_hold_every_control_step_in_micrometres():
    (episode,) = episodes(1, count=1)
    traced = list(trace_rows(7, episode, control_hz=20))
    assert len(traced) == len(episode.trace)
    assert tuple(traced[0]) == TRACES == ("position", "step", "time_s", *TRACE_COLUMNS)
    assert [row["position"] for row in traced] == [7] * len(traced)
    assert [row["step"] for row in traced] == list(range(len(traced)))
    assert [row["time_s"] for row in traced[:3]] == [0.0, 0.05, 0.1]
    values = np.array([[row[column] for column in TRACE_COLUMNS] for row in traced])
    assert np.abs(values - episode.trace).max() <= 0.5000001e-6
    x, y, z = positions.load_named("validation")[0]
    assert (traced[0]["object_x_m"], traced[0]["object_y_m"], traced[0]["object_z_m"]) == (x, y, z)
    assert (traced[0]["cup_x_m"], traced[0]["cup_y_m"], traced[0]["cup_z_m"]) == (0.2, 0.0, 0.15)
