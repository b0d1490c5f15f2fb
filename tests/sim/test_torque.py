"""Motors that are told torques: what they do to the arm, against the laws of mechanics and against the other engine."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from tests.conftest import make_arm, needs_mujoco, needs_pybullet
from uarm_rl import configuration
from uarm_rl.checks import UsageError
from uarm_rl.sim.simulated_arm import urdf
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError
from uarm_rl.task.obstacles import Box

FINE = ("servo=torque", "sim.physics_hz=960")
MOST_NM, NO_LOAD_RAD_S = 1.18, 2.0


def weighing_nm(joints: np.ndarray) -> np.ndarray:
    """By hand: what the weights of the links, at their centres of mass, turn joint1..joint3 with."""
    inertial = {link.get("name"): link.find("inertial") for link in ET.parse(urdf()).getroot().findall("link")}
    mass = {name: float(one.find("mass").get("value")) for name, one in inertial.items()}
    centre = {name: [float(x) for x in one.find("origin").get("xyz").split()] for name, one in inertial.items()}
    shoulder, elbow, wrist, cup = kinematics.forward(joints)
    ahead, up = np.array([np.cos(joints[0]), np.sin(joints[0]), 0.0]), np.array([0.0, 0.0, 1.0])

    def at(origin: np.ndarray, name: str, pitch: float) -> np.ndarray:
        x, _, z = centre[name]
        return origin + ahead * (x * np.cos(pitch) + z * np.sin(pitch)) + up * (z * np.cos(pitch) - x * np.sin(pitch))

    places = {
        "link2": at(shoulder, "link2", joints[1]),
        "link3": at(elbow, "link3", joints[1] + joints[2]),
        "link4": at(wrist, "link4", 0.0),
        "cup": cup + up * centre["cup"][2],
    }
    turned = [("link2", "link3", "link4", "cup"), ("link3", "link4", "cup")]
    falls = [
        sum(9.81 * mass[name] * ((places[name] - axis) @ ahead) for name in names)
        for axis, names in zip((shoulder, elbow), turned, strict=True)
    ]
    return np.array([0.0, *falls])


def moved(arm, shares: tuple[float, float, float], steps: int) -> np.ndarray:
    """Joints after each control step, shape (steps, 3)."""
    arm.command_torques(shares)
    path = []
    for _ in range(steps):
        arm.advance()
        path.append(arm.read_joints())
    return np.array(path)


def test_a_motor_ends_up_at_its_share_of_the_no_load_speed(engine):
    with make_arm(engine, *FINE, "servo.gravity_compensation=true") as arm:
        for share in (0.25, -0.5):
            turned = np.diff(moved(arm, (share, 0.0, 0.0), 16)[:, 0]) * 20
            assert turned[-1] == pytest.approx(share * NO_LOAD_RAD_S, rel=1e-3)
            assert np.all(np.abs(turned[4:]) <= abs(share) * NO_LOAD_RAD_S * 1.001)


def test_the_torque_that_the_weight_has_by_hand_holds_the_arm(engine):
    with make_arm(engine, *FINE) as arm:
        home = np.array(arm.read_joints())
        held = -weighing_nm(home) / MOST_NM
        assert np.abs(held[1:]).min() > 0.05
        assert moved(arm, tuple(held), 10)[-1] == pytest.approx(home, abs=2e-4)
        arm.home()
        assert np.abs(moved(arm, (0.0, 0.0, 0.0), 10)[-1] - home).max() > 0.05  # it falls


def test_compensation_holds_the_arm_wherever_it_was_brought(engine):
    generator = np.random.default_rng(0)
    with make_arm(engine, *FINE, "servo.gravity_compensation=true") as arm:
        for _ in range(5):
            arm.home()
            moved(arm, tuple(generator.uniform((-1, -0.4, -0.4), (1, 0.1, 0.1))), 6)
            came = moved(arm, (0.0, 0.0, 0.0), 12)
            assert came[-1] == pytest.approx(came[-4], abs=1e-4)


@needs_pybullet
@needs_mujoco
def test_both_engines_do_the_same_in_free_air():
    generator = np.random.default_rng(1)
    shares = generator.uniform((-0.8, -0.3, -0.3), (0.8, 0.1, 0.2), (12, 3))
    paths = []
    for engine in ("pybullet", "mujoco"):
        with make_arm(engine, *FINE) as arm:
            paths.append(np.concatenate([moved(arm, tuple(share), 2) for share in shares]))
    assert np.ptp(paths[0], axis=0).min() > 0.05
    np.testing.assert_allclose(*paths, atol=0.003)


@pytest.mark.parametrize("shares", [(1, 0, 0), (-1, -1, 0), (0, -1, -1), (0, -0.5, 1), (0, 0.3, -1)])
def test_limits_stop_the_joints_and_the_two_that_go_together(engine, shares):
    with make_arm(engine, *FINE) as arm:
        path = moved(arm, shares, 60)
        assert all(kinematics.within_limits(tuple(joints), 0.004) for joints in path)
        assert np.ptp(path[-8:], axis=0).max() < 0.004


def test_a_blocked_arm_pushes_with_the_torque_that_it_is_told(engine):
    """joint1 alone, the hand at a post: the force there is the torque over its distance from the axis."""
    with make_arm(engine, *FINE, "servo.gravity_compensation=true") as arm:
        x, y, _ = kinematics.cup_position(arm.read_joints())
        arm.place_obstacles([Box((x, y + 0.08, 0.2), (0.02, 0.02, 0.4))])
        for share in (0.2, 0.6):
            moved(arm, (share, 0.0, 0.0), 30)
            assert arm.touch_n() == pytest.approx(share * MOST_NM / x, rel=0.15)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("actions=torque",), "actions=torque needs servo=torque; servo=second_order is told where to go"),
        (
            ("servo=torque", "actions=reference"),
            "an action is a torque, which is relative to nothing; leave actions=reference out",
        ),
        (("servo=torque", "observation=reference"), "no reference is pending; take another observation, such as velocity"),
        (("servo=torque", "buffer=every_step"), "admission=every_step needs servo=second_order"),
        (("servo=torque", "servo.torque_nm=0"), "servo.torque_nm must be a number above 0"),
        (("servo=torque", "servo.no_load_speed_rad_s=-1"), "servo.no_load_speed_rad_s must be a number above 0"),
    ],
)
def test_what_does_not_fit_torques_is_refused(words, sentence):
    settings = configuration.compose("train", words)
    with pytest.raises((UsageError, ValueError), match=sentence):
        configuration.build_env(settings, time_limit_s=None, keep_within=words[-1] == "buffer=every_step")


def test_an_arm_takes_places_or_torques_and_not_the_other(engine):
    with make_arm(engine, *FINE) as arm, pytest.raises(ArmError, match="told torques"):
        arm.command_joints(kinematics.HOME_JOINTS_RAD)
    with make_arm(engine) as arm, pytest.raises(ArmError, match="servo=torque makes one"):
        arm.command_torques((0.0, 0.0, 0.0))


def test_a_torque_against_a_limit_is_what_a_reference_beyond_it_is(make_env, engine):
    env = make_env(f"sim={engine}", *FINE, "buffer=uniform", "observation=velocity", "servo.gravity_compensation=true")
    env.reset(seed=0, options={"object_position": (0.2, 0.1, 0.03)})
    one, other = np.array([-1, 0, 0], np.float32), np.array([1, 0, 0], np.float32)
    infos = [env.step(one)[4] for _ in range(40)]
    assert not infos[0]["clipped"]
    assert infos[-1]["clipped"]
    assert infos[-1]["travel_rad"] < 1e-3
    assert not env.step(other)[4]["clipped"]


def test_what_is_steady_is_the_place_or_the_speed(make_env, engine):
    """Told a torque, the arm stands at the limit at last; its speed is steady long before."""
    words = (f"sim={engine}", *FINE, "servo.gravity_compensation=true", "hold.steady_threshold_rad=0.001")
    taken = {}
    for hold in ("until_steady", "steady_speed"):
        env = make_env(*(word.replace("hold.", "buffer.hold.") for word in words), f"hold@buffer.hold={hold}")
        env.reset(seed=0, options={"object_position": (0.2, 0.1, 0.03)})
        info = env.step(np.array([-0.5, 0, 0], np.float32))[4]
        taken[hold] = info["control_steps"], env.arm.read_joints()[0]
    assert taken["steady_speed"][0] in (3, 4)
    assert taken["until_steady"][0] > 25
    assert taken["until_steady"][1] == pytest.approx(-np.pi / 2, abs=0.004)
