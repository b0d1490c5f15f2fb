"""The cup that gives, in every engine: its force, its end stop, and what it leaves as it was."""

from __future__ import annotations

import numpy as np
import pytest

import uarm_rl
from tests.conftest import make_arm
from uarm_rl import configuration
from uarm_rl.sim.cup import Bellows
from uarm_rl.task import kinematics

PLACE = (0.22, 0.03, 0.03)
BELLOWS = configuration.compose("train", ("cup=bellows",))["cup"]


@pytest.fixture
def press(engine):
    """Bring the cup so far below the upper surface of a box, slowly; the force there, and how far the box was moved."""
    arms = []

    def pressed(depth_m, *overrides):
        arms.append(arm := make_arm(engine, "servo=instant", "servo.reach_time_s=0.5", *overrides))
        arm.place_object(PLACE)
        for height_m in (0.02, -depth_m):
            arm.command_joints(kinematics.inverse((*PLACE[:2], PLACE[2] + height_m)).tolist())
            for _ in range(25):
                arm.advance()
        return arm.contact_n(), float(np.linalg.norm(np.subtract(arm.object_position(), PLACE)))

    yield pressed
    for arm in arms:
        arm.close()


@pytest.mark.parametrize("depth_m", [0.001, 0.002, 0.004])
@pytest.mark.parametrize("stiffness_n_m", [200.0, 400.0])
def test_the_bellows_push_as_springs_do(press, depth_m, stiffness_n_m):
    force_n, moved_m = press(depth_m, "cup=bellows", f"cup.stiffness_n_m={stiffness_n_m}")
    assert force_n == pytest.approx(stiffness_n_m * depth_m, rel=0.15, abs=0.05)
    assert moved_m < 1e-3


def test_beyond_their_travel_the_motors_push(press):
    assert press(0.007, "cup=bellows")[0] > 3.0 * BELLOWS["stiffness_n_m"] * BELLOWS["travel_m"]


def test_a_rigid_cup_pushes_at_once(press):
    assert press(0.002)[0] > 3.0


def test_a_cup_in_the_air_feels_nothing(press):
    assert press(-0.005, "cup=bellows") == (0.0, pytest.approx(0.0, abs=1e-4))


def test_the_lip_comes_back(engine):
    """After a press the next one is as the first."""
    with make_arm(engine, "cup=bellows", "servo=instant", "servo.reach_time_s=0.3") as arm:
        arm.place_object(PLACE)
        forces = []
        for height_m in (0.03, -0.003, 0.03, -0.003):
            arm.command_joints(kinematics.inverse((*PLACE[:2], PLACE[2] + height_m)).tolist())
            for _ in range(20):
                arm.advance()
            forces.append(arm.contact_n())
    assert forces[0] == forces[2] == 0.0
    assert forces[1] == pytest.approx(forces[3], rel=0.02)


def test_the_observation_does_not_see_it(engine):
    """The cup of the observation is that of the joints, as on the real arm: pressing shows as a distance."""
    with uarm_rl.make_env(f"sim={engine}", "cup=bellows", "buffer=adaptive") as env:
        env.reset(options={"object_position": PLACE})
        down = np.array([0.0, 1.0, 0.35], np.float32)
        for _ in range(12):
            *_, info = env.step(down if info_height(env) > PLACE[2] - 0.002 else np.zeros(3, np.float32))
        trace = env.trace[-1]
    np.testing.assert_allclose(trace[3:6], kinematics.cup_position(trace[:3]), atol=1e-9)
    assert info["distance_m"] == pytest.approx(np.linalg.norm(trace[3:6] - trace[6:9]))


def info_height(env):
    return env.state()[5]


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ((0.0, 0.005, 0.003), "cup.stiffness_n_m must be a number above 0"),
        ((400.0, 0.0, 0.003), "cup.travel_m must be a number above 0"),
        ((400.0, 0.005, 0.0), "cup.mass_kg must be a number from 0.0001"),
    ],
)
def test_cups_that_cannot_be(values, sentence):
    with pytest.raises(ValueError, match=sentence):
        Bellows(*values)
