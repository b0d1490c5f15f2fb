"""The simulated world: geometry, limits, contact, determinism, lifetime."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from uarm_rl import configuration
from uarm_rl.sim.pybullet_arm import SimArm
from uarm_rl.task import kinematics

CONFIG = configuration.compose("train")


def make_arm(*overrides: str) -> SimArm:
    config = configuration.compose("train", overrides)
    return SimArm(configuration.build("servo", config["servo"]), control_hz=20, **config["sim"])


def run(arm: SimArm, reference: np.ndarray, control_steps: int = 60) -> np.ndarray:
    arm.command_joints(kinematics.clip_to_limits(*reference))
    for _ in range(control_steps):
        arm.advance()
    return np.array(arm.read_joints())


@pytest.fixture(scope="module")
def arm():
    with make_arm() as one:
        yield one


unit = st.floats(0, 1)


@settings(max_examples=30, deadline=None)
@given(st.tuples(unit, unit, unit))
def test_pybullet_and_forward_kinematics_agree(arm, share):
    low, high = kinematics.JOINT_LIMITS_RAD.T
    reference = np.array(kinematics.clip_to_limits(*(low + share * (high - low))))
    assume(kinematics.cup_position(reference)[2] > 0.005)  # above the table
    arm.home()
    joints = run(arm, reference)
    assert joints == pytest.approx(reference, abs=0.005)
    assert np.abs(arm.link_ends() - kinematics.forward(joints)).max() < 1e-4


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 3), min_size=1, max_size=8))
def test_no_command_drives_a_joint_past_its_limits(arm, actions):
    arm.home()
    for action in actions:
        joints = run(arm, np.array(arm.read_joints()) + 0.8 * np.array(action), 4)
        assert kinematics.within_limits(joints, tolerance_rad=0.002)


def test_link4_stays_level():
    with make_arm() as arm:
        for reference in ([0.5, 0.3, 0.6], [-0.5, -0.4, 0.9], [0.0, 0.2, -0.1]):
            arm.command_joints(reference)
            for _ in range(20):
                arm.advance()
                wrist, cup = arm.link_ends()[2:]
                assert wrist[2] - cup[2] == pytest.approx(kinematics.CUP_DOWN_M, abs=1e-4)


def test_a_resting_object_stays_where_it_was_put():
    with make_arm() as arm:
        arm.place_object((0.2, -0.1, 0.03))
        for _ in range(200):
            arm.advance()
        assert arm.object_position() == pytest.approx((0.2, -0.1, 0.03), abs=1e-4)


def test_the_cup_pushes_the_object_aside():
    with make_arm() as arm:
        arm.place_object((0.2, 0.05, 0.03))
        beside = kinematics.inverse((0.2, 0.0, 0.02))
        run(arm, beside)
        run(arm, kinematics.inverse((0.2, 0.05, 0.02)))
        _, y, z = arm.object_position()
        assert y > 0.065
        assert z == pytest.approx(0.03, abs=0.001)


@pytest.mark.parametrize(("exact_cup", "gap_m"), [("false", 0.00097), ("true", 0.0)])
def test_the_rigid_cup_rests_on_the_object(exact_cup, gap_m):
    """PyBullet's hull of the cup stands 0.97 mm proud of it; the exact one touches where its lip is drawn."""
    with make_arm(f"sim.exact_cup={exact_cup}") as arm:
        arm.place_object((0.2, 0.0, 0.03))
        joints = run(arm, kinematics.inverse((0.2, 0.0, 0.025)), 60)
        x, y, top_m = arm.object_position()
        assert kinematics.cup_position(joints)[2] - top_m == pytest.approx(gap_m, abs=5e-5)
        assert (x, y) == pytest.approx((0.2, 0.0), abs=0.005)


def test_a_toppled_object_is_lost():
    with make_arm() as arm:
        arm.place_object((0.2, 0.1, 0.03))
        assert arm.object_position() is not None
        arm.place_object((2.0, 0.1, 0.03))  # beside the table: it falls
        for _ in range(40):
            arm.advance()
        assert arm.object_position() is None


def trajectory(arm: SimArm, seed: int) -> bytes:
    """An episode with contact, as bytes."""
    generator = np.random.default_rng(seed)
    arm.home()
    arm.place_object((0.22, 0.02, 0.03))
    rows = []
    for reference in (kinematics.inverse((0.2, -0.03, 0.02)), kinematics.inverse((0.24, 0.06, 0.02))):
        for _ in range(15):
            arm.command_joints(kinematics.clip_to_limits(*(reference + generator.normal(0, 0.02, 3))))
            arm.advance()
            rows.append((*arm.read_joints(), *(arm.object_position() or (0, 0, 0))))
    return np.array(rows).tobytes()


def test_episodes_repeat_to_the_last_bit_whatever_ran_before():
    with make_arm() as fresh:
        expected = [trajectory(fresh, seed) for seed in (0,)]
    with make_arm() as used:
        for seed in (5, 6, 7):
            trajectory(used, seed)
        assert [trajectory(used, seed) for seed in (0,)] == expected
        assert trajectory(used, 1) != expected[0]


def test_closing_twice_is_fine():
    arm = make_arm()
    arm.close()
    arm.close()


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("sim.physics_hz=130", r"sim\.physics_hz must be a multiple of control_hz \(20\), got 130"),
        ("sim.physics_hz=60", r"sim\.physics_hz must be a whole number from 120 to 10000, got 60"),
        ("sim.object_mass_kg=0", r"sim\.object_mass_kg must be a number above 0"),
    ],
)
def test_bad_values_are_refused_in_a_sentence(override, sentence):
    with pytest.raises(ValueError, match=sentence):
        make_arm(override)


def test_a_window_needs_a_screen(monkeypatch):
    from uarm_rl.task.arm import ArmError

    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ArmError, match=r"sim\.gui=true needs a screen"):
        make_arm("sim.gui=true")
