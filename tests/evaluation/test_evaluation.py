"""Evaluation: its rows, its independence of workers, its measures of shaking."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from uarm_rl import configuration
from uarm_rl.columns import MEASURED, STATE, TOUCHING, TRACES
from uarm_rl.evaluation.evaluate import evaluate
from uarm_rl.evaluation.measures import measure, shaking, trace_rows
from uarm_rl.task import layouts, positions
from uarm_rl.task.policy import InverseKinematicsPolicy
from uarm_rl.task.rollout import Episode

COMMON = configuration.build("reward", configuration.compose("train", ("reward=penalty",))["reward"])


def episodes(
    workers: int, count: int = 6, policy: object = None, time_limit_s: float = 4.0, control_hz: int = 20
) -> list[Episode]:
    settings = configuration.compose("train", (f"control_hz={control_hz}",))
    make = partial(configuration.build_env, settings, time_limit_s=time_limit_s)
    policy = policy or InverseKinematicsPolicy(0.15)
    return list(evaluate(make, policy, layouts.load_named("validation", 0)[:count], processes=workers))


def rows(episodes: list[Episode], control_hz: int = 20) -> list[dict[str, object]]:
    return [measure(number, episode, COMMON, control_hz=control_hz) for number, episode in enumerate(episodes)]


def test_evaluations_are_identical_however_many_work_on_them():
    one, again, two = episodes(1), episodes(1), episodes(2)
    assert rows(one) == rows(again) == rows(two)
    for first, second in zip(one, two, strict=True):
        assert first.trace.tobytes() == second.trace.tobytes()


def test_inverse_kinematics_reaches_every_validation_position():
    result = rows(episodes(1, count=50, time_limit_s=10.0))
    assert sum(row["success"] for row in result) == 50
    for row in result:
        assert tuple(row) == (*MEASURED, "press_m", "reference_press_m", "contact_n", *TOUCHING)
        assert row["final_distance_m"] <= 0.005
        assert row["min_distance_m"] <= row["final_distance_m"]
        assert row["object_displacement_m"] < 0.005
        assert 0 < row["time_s"] < 10


class Still:
    def act(self, observation):
        return np.zeros(3, np.float32)


@pytest.mark.parametrize("control_hz", [10, 20, 40])
def test_a_policy_that_does_nothing_fails_and_does_not_shake(control_hz):
    for episode in episodes(1, count=2, policy=Still(), control_hz=control_hz):
        (row,) = rows([episode], control_hz)
        assert not row["success"]
        assert row["time_s"] == 4.0
        assert row["tip_travel_last_s_m"] < 1e-5
        assert row["reversals_per_s"] == 0
        state = episode.trace[0, 3:6], episode.trace[0, 6:9]
        assert row["common_return"] == pytest.approx(4 * control_hz * COMMON(*state, *state).total, rel=1e-4)


def test_measures_of_a_known_episode():
    """The cup comes down from 40 mm to 10 and goes up to 20; at the second step it shoves the object 3 mm aside."""
    heights, shoved = [0.04, 0.03, 0.01, 0.02], [0.0, 0.0, 0.003, 0.003]
    trace = [[0, 0, 0, 0.2, y, 0.03 + z, 0.2, y, 0.03] for z, y in zip(heights, shoved, strict=True)]
    row = measure(7, Episode(True, -3.5, 2, np.array(trace)), COMMON, control_hz=10)
    assert (row["position"], row["success"], row["return"], row["decisions"]) == (7, True, -3.5, 2)
    measured = [row[name] for name in ("time_s", "final_distance_m", "min_distance_m", "object_displacement_m")]
    assert measured == pytest.approx([0.3, 0.02, 0.01, 0.003])
    r_d = [COMMON.beta_d * height for height in heights]
    expected = COMMON.alpha * sum(r_d[1:]) + COMMON.beta * (r_d[-1] - r_d[0]) + COMMON.sigma * 0.003
    assert row["common_return"] == pytest.approx(expected)


@pytest.mark.parametrize("control_hz", [10, 20])
def test_shaking_of_known_paths(control_hz):
    time = np.arange(0, 5, 1 / control_hz)
    still = np.tile([0.2, 0.0, 0.1], (len(time), 1))
    assert shaking(still, control_hz=control_hz) == {"reversals_per_s": 0, "rms_jerk": 0, "tip_travel_last_s_m": 0}
    straight = still + np.outer(time, [0.1, 0, 0])
    result = shaking(straight, control_hz=control_hz)
    assert result["reversals_per_s"] == 0
    assert result["tip_travel_last_s_m"] == pytest.approx(0.1)
    assert result["rms_jerk"] == pytest.approx(0, abs=1e-6)
    zigzag = still.copy()
    zigzag[::2, 1] += 0.002  # turns at every control step
    result = shaking(zigzag, control_hz=control_hz)
    assert result["reversals_per_s"] == pytest.approx(control_hz, rel=0.05)
    assert result["tip_travel_last_s_m"] == pytest.approx(control_hz * 0.002)
    assert result["rms_jerk"] == pytest.approx(8 * 0.002 * control_hz**3 / 2, rel=0.01)  # 3rd difference of +-a/2 is 4a
    for tremble_m in (0.00005, 0.002):  # too small a movement has no direction, whether it is one of two or both
        moves = np.tile([[0.002, 0, 0], [-0.00005, 0, 0], [-tremble_m, 0, 0]], (20, 1))
        reversals = shaking(np.cumsum(moves, axis=0), control_hz=control_hz)["reversals_per_s"] * len(moves) / control_hz
        assert reversals == pytest.approx(0 if tremble_m < 1e-4 else 20, abs=1)
    assert shaking(still[:2], control_hz=control_hz)["rms_jerk"] == 0


def test_traces_hold_every_control_step_in_micrometres():
    (episode,) = episodes(1, count=1, control_hz=40)
    traced = list(trace_rows(7, episode, control_hz=40))
    assert len(traced) == len(episode.trace)
    assert tuple(traced[0]) == tuple(TRACES)
    assert [row["position"] for row in traced] == [7] * len(traced)
    assert [row["step"] for row in traced] == list(range(len(traced)))
    assert [row["time_s"] for row in traced[:3]] == [0.0, 0.025, 0.05]
    values = np.array([[row[column] for column in STATE] for row in traced])
    assert np.abs(values - episode.trace).max() <= 0.5000001e-6
    x, y, z = positions.load_named("validation")[0]
    assert (traced[0]["object_x_m"], traced[0]["object_y_m"], traced[0]["object_z_m"]) == (x, y, z)
    assert (traced[0]["cup_x_m"], traced[0]["cup_y_m"], traced[0]["cup_z_m"]) == (0.2, 0.0, 0.15)
