"""How the simulated joints respond: rise, overshoot, rest, dead time, queue; measured in every engine, gravity included."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.conftest import make_arm
from uarm_rl import configuration
from uarm_rl.sim.servo import rise_time_s
from uarm_rl.task import kinematics

STEP_RAD = 0.15
HOME = kinematics.HOME_JOINTS_RAD


def respond(
    engine: str, servo: str, *overrides: str, steps: int = 60, step_rad: tuple[float, float, float] = (STEP_RAD, 0, 0)
) -> np.ndarray:
    """Joint angles relative to home after each control step following a command; shape (steps, 3)."""
    with make_arm(engine, f"servo={servo}", *overrides) as arm:
        arm.command_joints(HOME + step_rad)
        path = []
        for _ in range(steps):
            arm.advance()
            path.append(np.array(arm.read_joints()) - HOME)
    return np.array(path)


def crossing_s(path: np.ndarray, share: float) -> float:
    """When the first joint crosses a share of the step, interpolated between control steps."""
    times, values = np.arange(len(path) + 1) / 20, np.concatenate(([0.0], path[:, 0] / STEP_RAD))
    index = int(np.argmax(values >= share))
    return float(np.interp(share, values[index - 1 : index + 1], times[index - 1 : index + 1]))


def test_second_order_rises_and_overshoots_as_its_equation_says(engine):
    path = respond(engine, "second_order")
    assert 0.3 <= crossing_s(path, 0.9) - crossing_s(path, 0.1) <= 0.6
    damping = 0.5
    overshoot = math.exp(-math.pi * damping / math.sqrt(1 - damping**2))
    assert path[:, 0].max() / STEP_RAD - 1 == pytest.approx(overshoot, abs=0.02)


@pytest.mark.parametrize("servo", ["second_order", "stepper", "instant"])
def test_every_joint_arrives_and_does_not_creep(engine, servo):
    path = respond(engine, servo, steps=200, step_rad=(0.15, 0.1, -0.1))
    assert path[-1] == pytest.approx([0.15, 0.1, -0.1], abs=0.0002)  # gravity included
    assert np.abs(path[-1] - path[-100]).max() < 1e-6


def test_speed_limit_holds(engine):
    path = respond(engine, "second_order", "servo.speed_limit_rad_s=0.2", steps=10)
    assert np.abs(np.diff(path[:, 0])).max() * 20 <= 0.2 + 1e-6


@pytest.mark.parametrize(("servo", "low", "high"), [("second_order", 0.3, 0.6), ("stepper", 0.2, 0.4), ("instant", 0.03, 0.05)])
def test_the_rise_time_is_that_of_the_simulated_joint(engine, servo, low, high):
    rise_s = rise_time_s(configuration.build("servo", configuration.compose("train", (f"servo={servo}",))["servo"]))
    assert low <= rise_s <= high
    path = respond(engine, servo)
    assert rise_s == pytest.approx(crossing_s(path, 0.9) - crossing_s(path, 0.1), abs=0.02)


def test_rise_time_scales_with_the_frequency_and_ends():
    def rise_s(frequency: float) -> float:
        return rise_time_s(
            configuration.build(
                "servo",
                {**configuration.compose("train")["servo"], "natural_frequency_rad_s": frequency, "speed_limit_rad_s": 100.0},
            )
        )

    assert rise_s(2.5) == pytest.approx(2.0 * rise_s(5.0), abs=0.003) == pytest.approx(4.0 * rise_s(10.0), abs=0.006)
    with pytest.raises(ValueError, match=r"more than a minute for 0\.15 rad"):
        rise_s(0.001)


def test_instant_arrives_within_one_control_step(engine):
    assert respond(engine, "instant", steps=1)[0, 0] == pytest.approx(STEP_RAD, abs=1e-6)


@pytest.mark.parametrize(
    ("step_rad", "measured_s"),
    # Durations that firmware V4.10.0 showed for F 20 (first to last step pulse): one joint, and all three motors.
    [((STEP_RAD, 0, 0), 0.352), ((STEP_RAD, -STEP_RAD, 2 * STEP_RAD), 0.574)],
)
def test_stepper_takes_as_long_as_the_firmware(engine, step_rad, measured_s):
    path = respond(engine, "stepper", "sim.physics_hz=480", step_rad=step_rad, steps=30)
    arrived = np.abs(path - step_rad).max(axis=1) < 1e-5
    duration_s = (int(np.argmax(arrived)) + 1) / 20
    assert measured_s + 0.016 <= duration_s <= measured_s + 0.016 + 0.055
    assert path[:, 0].max() <= STEP_RAD + 1e-6  # no overshoot


def test_stepper_moves_on_a_straight_line_in_joint_space(engine):
    path = respond(engine, "stepper", step_rad=(0.15, 0.05, -0.1), steps=8)
    share = path[:, 0] / 0.15
    np.testing.assert_allclose(path, share[:, None] * np.array([0.15, 0.05, -0.1]), atol=2e-5)


@pytest.mark.parametrize("queue", [True, False])
def test_a_second_command_queues_or_replaces(engine, queue):
    with make_arm(engine, "servo=stepper", f"servo.queue={str(queue).lower()}") as arm:
        arm.command_joints(HOME + [0.3, 0, 0])
        arm.advance()
        arm.command_joints(HOME)
        farthest = 0.0
        for _ in range(60):
            arm.advance()
            farthest = max(farthest, arm.read_joints()[0])
        assert arm.read_joints()[0] == pytest.approx(0.0, abs=1e-5)
    assert farthest == pytest.approx(0.3, abs=0.02) if queue else farthest < 0.05


@pytest.mark.parametrize(
    ("servo", "override", "sentence"),
    [
        ("second_order", "servo.damping=0", "servo.damping must be a number above 0 and at most 2, got 0"),
        ("stepper", "servo.feed=-1", "servo.feed must be a number above 0 and at most 250, got -1"),
        ("stepper", "servo.queue=1", "servo.queue must be true or false, got 1"),
    ],
)
def test_bad_values_are_refused_in_a_sentence(servo, override, sentence):
    with pytest.raises(ValueError, match=sentence):
        settings = configuration.compose("train", (f"servo={servo}", override))
        configuration.build("servo", settings["servo"])
