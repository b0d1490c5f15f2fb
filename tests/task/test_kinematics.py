"""The geometry against the firmware's own vectors, against its inverse, and at its limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from uarm_rl.task import kinematics

#: B, L, R (degrees) -> X, Y, Z (mm): what M2221 of firmware V4.10.0 answered, within 0.0002 mm.
FIRMWARE_VECTORS = [
    (90, 100.9902, 8.0774, 200.0, 0, 150.0),
    (90, 123.6172, 0.4184, 150.0, 0, 150.0),
    (90, 118, 50, 105.2333, 0, 36.6348),
    (90, 32.758930, 88.980537, 192.15, 0, -49.06),
    (90, 90, 0.5, 228.654, 0, 173.5341),
    (90, 29.5, 0.5, 352.3054, 0, 101.4228),
    (135, 80, 30, 164.0867, 164.0867, 93.3566),
    (45, 80, 30, 164.0867, -164.0867, 93.3566),
    (90, 45, 75, 211.4117, 0, -20.09),
    (90, 55.9357, 71.4307, 200.0, 0, 0),
    (109.6538, 40.3782, 41.3348, 280.0, 100.0, 20.0),
    (45, 111.6799, 16.4119, 120.0, -120.0, 120.0),
    (90, -3, 60, 291.1303, 0, -112.1189),
    (90, 100, -3, 203.7722, 0, 181.0731),
]

angles = st.tuples(*(st.floats(low, high) for low, high in kinematics.JOINT_LIMITS_RAD.tolist()))
anything = st.floats(allow_nan=True, allow_infinity=True)


@pytest.mark.parametrize("vector", FIRMWARE_VECTORS, ids=str)
def test_agrees_with_the_firmware(vector):
    motors, cup_mm = vector[:3], np.array(vector[3:])
    joints = kinematics.from_motor_deg(*motors)
    assert kinematics.cup_position(joints) * 1000 == pytest.approx(cup_mm, abs=5e-4)
    assert kinematics.to_motor_deg(kinematics.inverse(cup_mm / 1000)) == pytest.approx(motors, abs=5e-4)


@given(angles)
def test_inverse_undoes_forward(joints):
    assume(kinematics.within_limits(joints))
    assert kinematics.inverse(kinematics.cup_position(joints)) == pytest.approx(joints, abs=1e-7)


@given(angles)
def test_motor_angles_convert_both_ways(joints):
    assert kinematics.from_motor_deg(*kinematics.to_motor_deg(joints)) == pytest.approx(joints, abs=1e-12)


@given(st.tuples(*[st.floats(-100, 100)] * 3))
def test_clipping_gives_legal_angles_and_leaves_legal_ones_alone(joints):
    clipped = kinematics.clip_to_limits(*joints)
    assert kinematics.within_limits(clipped, tolerance_rad=1e-12)
    if kinematics.within_limits(joints):
        assert clipped == joints


@given(st.tuples(anything, anything, anything))
def test_inverse_gives_legal_angles_or_refuses(cup):
    if kinematics.reachable(cup):
        joints = kinematics.inverse(cup)
        assert kinematics.cup_position(joints) == pytest.approx(cup, abs=1e-9)
        assert kinematics.within_limits(joints, tolerance_rad=1e-9)
    else:
        with pytest.raises(kinematics.UnreachableError, match="cannot reach"):
            kinematics.inverse(cup)


@pytest.mark.parametrize(
    ("base", "left", "right", "legal"),
    [
        (90, 100, 50, True),
        (0, 100, 50, True),
        (-0.1, 100, 50, False),
        (180.1, 100, 50, False),
        (90, -4, 100, True),
        (90, -4.1, 100, False),
        (90, 135.6, 20, True),
        (90, 135.7, 20, False),
        (90, 80, -4, True),
        (90, 80, -4.1, False),
        (90, 40, 119.9, True),
        (90, 40, 120.0, False),
        (90, 20, 8.9, False),  # coupled: the elbow opens beyond 151 degrees
        (90, 20, 9.1, True),
        (90, 100, 70.1, False),  # coupled: the elbow closes below 10 degrees
        (90, 100, 69.9, True),
    ],
)
def test_limits_are_the_firmwares(base, left, right, legal):
    assert kinematics.within_limits(kinematics.from_motor_deg(base, left, right), tolerance_rad=1e-9) is legal


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_no_number_is_not_within_limits(bad):
    for place in range(3):
        joints = kinematics.HOME_JOINTS_RAD.copy()
        joints[place] = bad
        assert not kinematics.within_limits(joints)


def test_link_lengths_are_kept():
    ends = kinematics.forward((0.3, 0.2, 0.5))
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(kinematics.LOWER_ARM_M)
    assert np.linalg.norm(ends[2] - ends[1]) == pytest.approx(kinematics.FOREARM_M)
    assert ends[2][2] - ends[3][2] == pytest.approx(kinematics.CUP_DOWN_M)
