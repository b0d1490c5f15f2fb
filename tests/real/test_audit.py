"""The audit: nothing unsafe reaches the wire, whatever is asked."""

from __future__ import annotations

import math
from contextlib import suppress
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from tests.bench import HOME, Bench, spares
from uarm_rl.emulator.realism import Settings
from uarm_rl.real.audit import KnownObject, Limits, ObstructedError, UnsafeCommandError, audit, way
from uarm_rl.task import kinematics
from uarm_rl.task.obstacles import Box, clearances_m, way_clearances_m


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        ((math.nan, 0.0, 0.0), "three finite joint angles"),
        ((math.inf, 0.0, 0.0), "three finite joint angles"),
        ((0.0, 0.0), "three finite joint angles"),
        ((0.0, 0.0, 0.0, 0.0), "three finite joint angles"),
        (("0", "0", "0"), "three finite joint angles"),
        ((1j, 0.0, 0.0), "three finite joint angles"),
        (None, "three finite joint angles"),
        (0.0, "three finite joint angles"),
        (np.zeros((3, 3)), "three finite joint angles"),
        ((2.0, HOME[1], HOME[2]), "outside the joint limits; allowed are joint1: -90 to 90"),
        ((HOME[0], -0.9, HOME[2]), "outside the joint limits"),
        ((HOME[0], HOME[1], 1.5), "outside the joint limits"),
        ((0.0, math.radians(60.0), math.radians(70.0)), "outside the joint limits"),  # joint2 + joint3
        ((0.5, HOME[1], HOME[2]), "28.6 degrees; allowed are 14.3 in one step"),
    ],
)
def test_a_refused_reference_sends_nothing(reference, words):
    bench = Bench()
    arm = bench.connect()
    arm.home()
    start = len(bench.port.written)
    with pytest.raises(UnsafeCommandError, match=words):
        arm.command_joints(reference)
    assert len(bench.port.written) == start
    arm.command_joints(HOME)  # and the arm still works
    arm.advance()


@pytest.mark.parametrize(
    ("cup_mm", "limits", "feed", "words"),
    [
        ((200, 0, 2), Limits(), 20.0, "end at .* closer to the table than 3 mm"),
        ((200, 0, 150), Limits(z_m=(0.0, 0.1)), 20.0, "outside the workspace, 0 to 100 mm in z"),
        ((200, 50, 100), Limits(y_m=(-0.01, 0.01)), 20.0, "outside the workspace, -10 to 10 mm in y"),
        ((72, 72, 20), Limits(), 20.0, "touch the arm's own base"),
        ((200, 0, 100), Limits(), 31.0, "allowed is up to 40 deg/s, F 30.0"),
        ((200, 0, 100), Limits(), 0.0, "asks for 0.0 deg/s"),
        ((200, 0, 100), Limits(), math.nan, "asks for nan deg/s"),
    ],
)
def test_the_audit_looks_at_the_cup_and_the_speed(cup_mm, limits, feed, words):
    reference = kinematics.inverse(np.divide(cup_mm, 1000.0)).tolist()
    with pytest.raises(UnsafeCommandError, match=words):
        audit(reference, HOME, feed=feed, limits=limits, single_step=False)


def test_the_audit_looks_at_the_whole_way():
    """The forearm swings through the vertical: both ends are above the table, the middle is not."""
    start, end = (kinematics.from_motor_deg(90.0, 61.1, right).tolist() for right in (70.0, 108.0))
    assert min(kinematics.cup_position(joints)[2] for joints in (start, end)) > 0.005
    with pytest.raises(UnsafeCommandError, match=r"pass at .* closer to the table"):
        audit(end, tuple(start), feed=20.0, limits=Limits(), single_step=False)


def test_references_on_a_limit_are_clamped_by_a_hair_and_counted(caplog):
    caplog.set_level("INFO")
    bench = Bench(limits=Limits(max_step_rad=math.pi))
    arm = bench.connect()
    arm.home()
    assert arm.clamps == 0
    arm.command_joints((math.radians(90.0), HOME[1], HOME[2]))
    arm.advance()  # the firmware does not refuse it
    assert arm.clamps == 1
    assert "clamped to the limits" in caplog.text


_ANY_NUMBER = (
    st.floats(allow_nan=True, allow_infinity=True)
    | st.floats(-0.3, 0.3)
    | st.integers()
    | st.sampled_from([math.nan, math.inf, -math.inf, 5e-324, 1e308, -0.0, 10**400, True, "1", None, 1j, Fraction(1, 7), b"0"])
)
_ANY_REFERENCE = (
    st.lists(_ANY_NUMBER, max_size=5)
    | st.tuples(*3 * [st.floats(-0.3, 0.3)])
    | st.tuples(*3 * [st.floats(-0.3, 0.3)]).map(np.array)
    | st.sampled_from([None, 0.0, "abc", {}, np.zeros((3, 1)), np.array([None, 0, 0]), np.zeros(3, np.complex64)])
)


@pytest.fixture(scope="module")
def homed():
    bench = Bench(Settings(tick_s=0.02))
    arm = bench.connect()
    arm.home()
    return bench, arm


@settings(max_examples=1000)
@example(reference=[True, True, True], relative=False)
@given(reference=_ANY_REFERENCE, relative=st.booleans())
def test_hostile_references_put_nothing_unsafe_on_the_wire(homed, reference, relative):
    bench, arm = homed
    bench.port.written.clear()
    joints = arm.read_joints()
    if relative and isinstance(reference, tuple):
        reference = [at + change for at, change in zip(joints, reference, strict=False)]
    standing_deg = bench.port.firmware.machine.motion.position
    with suppress(UnsafeCommandError):
        arm.command_joints(reference)
    arm.advance()
    bench.judge(last_deg=standing_deg)


OBJECT = KnownObject((0.21, 0.04, 0.03), (0.03, 0.03, 0.03), 0.004)
_NEAR = st.tuples(st.floats(-0.07, 0.07), st.floats(-0.07, 0.07), st.floats(-0.03, 0.05))


def joints_near(offset):
    return tuple(kinematics.inverse(np.add(OBJECT.top_m, offset)).tolist())


@settings(deadline=None, max_examples=500)
@given(start=_NEAR, goal=_NEAR)
def test_no_way_leads_into_a_known_object(start, goal):
    """From anywhere outside it; what would go in goes to a place that spares it, or nowhere."""
    try:
        joints, reference = joints_near(start), joints_near(goal)
    except kinematics.UnreachableError:
        assume(False)
    assume(OBJECT.depth_m(np.add(OBJECT.top_m, start)) == 0.0)
    try:
        audited = audit(reference, joints, feed=20.0, limits=Limits(), single_step=False, known=OBJECT)
    except UnsafeCommandError:
        return
    assert spares(kinematics.to_motor_deg(joints), audited.command.values[:3], (210.0, 40.0, 30.0), 21.2, 4.0)


def test_a_press_goes_as_deep_as_it_may_and_no_deeper():
    above, low, deep = (joints_near((0.0, 0.0, height)) for height in (0.01, -0.004, -0.009))
    free = audit(low, above, feed=20.0, limits=Limits(), single_step=True, known=OBJECT)
    assert free.pulled_up_m == 0.0
    stopped = audit(deep, above, feed=20.0, limits=Limits(), single_step=True, known=OBJECT)
    assert stopped.pulled_up_m == pytest.approx(0.005, abs=1e-6)
    assert kinematics.cup_position(stopped.joints_rad)[2] == pytest.approx(0.026, abs=1e-5)
    unknown = audit(deep, above, feed=20.0, limits=Limits(), single_step=True)
    assert kinematics.cup_position(unknown.joints_rad)[2] == pytest.approx(0.021, abs=1e-5)


def test_a_cup_that_is_too_deep_already_may_leave_and_not_go_deeper():
    inside = joints_near((0.0, 0.0, -0.01))
    left = audit(joints_near((0.0, 0.0, 0.02)), inside, feed=20.0, limits=Limits(), single_step=False, known=OBJECT)
    assert left.pulled_up_m == 0.0
    kept = audit(joints_near((0.0, 0.0, -0.02)), inside, feed=20.0, limits=Limits(), single_step=False, known=OBJECT)
    assert kinematics.cup_position(kept.joints_rad)[2] > 0.02 - 1e-5


# Obstacles

POST = Box((0.2, 0.12, 0.1), (0.03, 0.03, 0.2))
WITH_POST = Limits(obstacles=(POST,))


@given(st.tuples(*[st.floats(0.0, 1.0)] * 3), st.tuples(*[st.floats(0.0, 1.0)] * 3))
@settings(max_examples=60, deadline=None)
def test_what_passes_keeps_all_of_the_arm_clear_of_an_obstacle_on_its_whole_way(start, end):
    low, high = kinematics.JOINT_LIMITS_RAD.T
    begin, wish = (kinematics.clip_to_limits(*(low + np.array(share) * (high - low)).tolist()) for share in (start, end))
    before = clearances_m(np.array([begin]), [POST])[0]
    with suppress(UnsafeCommandError):
        audited = audit(wish, begin, feed=20.0, limits=WITH_POST, single_step=False)
        shares = np.linspace(0.0, 1.0, 400)[:, np.newaxis]
        way = np.array(begin) + shares * np.subtract(audited.joints_rad, begin)
        assert clearances_m(way, [POST]).min() >= min(WITH_POST.obstacle_clearance_m, before) - 1e-4


def test_the_way_past_an_obstacle_is_refused_with_the_limb_and_not_only_with_the_cup():
    left, right, higher = (
        tuple(kinematics.inverse(place)) for place in ((0.14, 0.24, 0.12), (0.24, 0.0, 0.12), (0.24, 0.0, 0.15))
    )
    with pytest.raises(UnsafeCommandError, match=r"the arm would be within 0 mm of an obstacle, and 10 mm are to be"):
        audit(left, right, feed=20.0, limits=WITH_POST, single_step=False)
    assert not audit(higher, right, feed=20.0, limits=WITH_POST, single_step=False).clamped
    over = tuple(kinematics.inverse((0.28, 0.168, 0.1)))  # the cup is far behind the post, the forearm above it
    behind = tuple(kinematics.inverse((0.29, 0.10, 0.1)))
    assert math.dist(kinematics.cup_position(over)[:2], POST.centre_m[:2]) > 0.08
    with pytest.raises(UnsafeCommandError, match="of an obstacle"):
        audit(over, behind, feed=20.0, limits=WITH_POST, single_step=False)


def test_an_arm_that_stands_too_near_an_obstacle_may_leave_it_and_not_approach():
    near = Limits(obstacles=(Box((0.27, 0.055, 0.12), (0.04, 0.03, 0.24)),))
    at, away, nearer = (tuple(kinematics.inverse(place)) for place in ((0.2, 0.0, 0.12), (0.2, -0.02, 0.12), (0.2, 0.01, 0.12)))
    assert clearances_m(np.array([at]), near.obstacles)[0] < near.obstacle_clearance_m
    audit(away, at, feed=20.0, limits=near, single_step=False)
    with pytest.raises(UnsafeCommandError, match="of an obstacle"):
        audit(nearer, at, feed=20.0, limits=near, single_step=False)


def test_with_an_obstacle_in_its_way_the_arm_draws_in_and_turns():
    left, right, higher = (
        tuple(kinematics.inverse(place)) for place in ((0.14, 0.24, 0.12), (0.24, 0.0, 0.12), (0.24, 0.0, 0.15))
    )
    farther = Limits(obstacles=(Box((0.24, 0.15, 0.1), (0.03, 0.03, 0.2)),))
    legs = way(right, left, feed=20.0, limits=farther)
    assert len(legs) > 1
    at = left
    for leg in legs:
        at = audit(leg, at, feed=20.0, limits=farther, single_step=False).joints_rad
    assert at == pytest.approx(right, abs=1e-9)
    assert way(right, higher, feed=20.0, limits=farther) == [right]


def test_only_an_obstacle_is_gone_round_and_only_where_there_is_room():
    left, right = (tuple(kinematics.inverse(place)) for place in ((0.14, 0.24, 0.12), (0.24, 0.0, 0.12)))
    with pytest.raises(UnsafeCommandError, match="outside the joint limits"):
        way((0.0, 9.0, 0.0), left, feed=20.0, limits=WITH_POST)
    wall = Limits(obstacles=(Box((0.2, 0.12, 0.15), (0.2, 0.02, 0.3)),))
    with pytest.raises(ObstructedError, match="of an obstacle"):
        way(right, left, feed=20.0, limits=wall)


@given(st.floats(-0.6, 0.6), st.floats(0.0, 3.1))
@settings(max_examples=40, deadline=None)
def test_what_hangs_from_the_cup_keeps_clear_too(bearing, turned):
    """A box below the way of the cup, and one that hangs from it, however it is turned: its corners stay outside."""
    low, size_m = Box((0.22, 0.0, 0.02), (0.04, 0.06, 0.04)), np.array([0.05, 0.03, 0.03])
    carrying = Limits(obstacles=(low,)).carrying(size_m.tolist())
    start, end = (tuple(kinematics.inverse((0.22 * math.cos(a), 0.22 * math.sin(a), 0.09))) for a in (-0.9, bearing))
    audit(end, start, feed=20.0, limits=Limits(obstacles=(low,)), single_step=False)
    try:
        audit(end, start, feed=20.0, limits=carrying, single_step=False)
    except ObstructedError:
        assert bearing > -0.5  # else it does not come near
        return
    assert bearing < 0.0
    corners = np.array([[a, b] for a in (-0.5, 0.5) for b in (-0.5, 0.5)]) * size_m[:2]
    spin = np.array([[math.cos(turned), -math.sin(turned)], [math.sin(turned), math.cos(turned)]])
    around = kinematics.cup_position(end)[:2] + corners @ spin.T
    beyond = np.abs(around - low.centre_m[:2]) - np.array(low.size_m[:2]) / 2.0
    assert (beyond.max(axis=1) > 0.0).all()  # a corner of the one is not in the other


def test_an_arm_that_is_just_clear_of_an_obstacle_does_not_come_nearer_on_its_way():
    """The tolerance is for who is too near already: a turn past a box whose nearest point lies within the clearance."""
    box = Box((0.27, 0.0, 0.12), (0.04, 0.03, 0.24))
    start, end = (tuple(kinematics.inverse((0.2 * math.cos(a), 0.2 * math.sin(a), 0.12))) for a in (-0.7, 0.7))
    nearest = way_clearances_m(start, end, [box], math.radians(0.25)).min()
    for spare_m in (0.0001, 0.0005, 0.0009):
        within = Limits(obstacles=(box,), obstacle_clearance_m=max(0.0, float(nearest)) + spare_m)
        assert clearances_m(np.array([start]), [box])[0] > within.obstacle_clearance_m
        with pytest.raises(ObstructedError):
            audit(end, start, feed=20.0, limits=within, single_step=False)
