"""Geometry of the uArm Swift Pro: forward and inverse kinematics, limits, angle conventions.

Frame: x forward, y left, z up, origin on the base axis at table level. Lengths are metres, angles radians,
unless a name says otherwise. *Chain angles* are those of the serial open chain joint1..joint4 (the ROS URDF's
convention: zero pose = lower arm vertical, forearm horizontal). *Motor angles* B, L, R (degrees) are what the
firmware speaks: B turns the base (90 = straight ahead), L is the elevation of the lower arm, R the depression
of the forearm, both against the horizontal.

Numbers: firmware V4.2 to V4.10, ``src/uarm_coord_convert.h`` (lengths, tool offset of mode 0) and
``src/uarm_coord_convert.c`` (joint limits of V4.8 and later).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

SHOULDER_FORWARD_M: Final = 0.0132  # shoulder axis ahead of the base axis
SHOULDER_HEIGHT_M: Final = 0.1074  # shoulder axis above the table
LOWER_ARM_M: Final = 0.14207  # shoulder to elbow
FOREARM_M: Final = 0.15881  # elbow to wrist
CUP_FORWARD_M: Final = 0.05665  # wrist to suction cup, tool mode 0
CUP_RADIUS_M: Final = 0.0095  # of the lip, from the maker's CAD model
CUP_DOWN_M: Final = 0.07455  # wrist to the tip of the suction cup, tool mode 0

REACH_M: Final = SHOULDER_FORWARD_M + LOWER_ARM_M + FOREARM_M + CUP_FORWARD_M  # no cup is farther from the base axis
HEIGHT_M: Final = SHOULDER_HEIGHT_M + LOWER_ARM_M + FOREARM_M  # nor higher above the table

#: Limits of the motor angles in degrees, firmware V4.8 and later.
MOTOR_LIMITS_DEG: Final = {"B": (0.0, 180.0), "L": (-4.0, 135.6), "R": (-4.0, 119.9)}
#: Limits of the elbow opening 180 - L - R in degrees: the coupled limit.
ELBOW_OPENING_DEG: Final = (10.0, 151.0)

#: Limits of the chain angles joint1, joint2, joint3 taken alone (radians), shape (3, 2).
JOINT_LIMITS_RAD: Final[Vector] = np.radians([[-90.0, 90.0], [-45.6, 94.0], [-61.0, 80.0]])
#: Coupled limit: joint2 + joint3 is the depression R of the forearm.
FOREARM_LIMITS_RAD: Final = (math.radians(-4.0), math.radians(119.9))

#: The vendor's reset pose: cup at (200, 0, 150) mm.
HOME_CUP_M: Final = (0.2, 0.0, 0.15)


class UnreachableError(ValueError):
    """A cup position that no joint position within the limits reaches."""


def level(joint2: float, joint3: float) -> float:
    """Angle of joint4 that keeps link4 horizontal and the cup vertical."""
    return -(joint2 + joint3)


def forward(joints_rad: Sequence[float] | Vector) -> Vector:
    """Positions of the ends of link1, link2, link3 and of the suction cup (= end of link4).

    ``joints_rad`` holds joint1..joint3 (further entries are ignored: joint4 follows from them).
    Returns an array of shape (4, 3) in metres.
    """
    joint1, joint2, joint3 = joints_rad[0], joints_rad[1], joints_rad[2]
    cos1, sin1 = math.cos(joint1), math.sin(joint1)
    elbow_r, elbow_z, wrist_r, wrist_z = _from_the_side(joint2, joint3, math.cos, math.sin)
    cup_r = wrist_r + CUP_FORWARD_M
    return np.array(
        [
            [SHOULDER_FORWARD_M * cos1, SHOULDER_FORWARD_M * sin1, SHOULDER_HEIGHT_M],
            [elbow_r * cos1, elbow_r * sin1, elbow_z],
            [wrist_r * cos1, wrist_r * sin1, wrist_z],
            [cup_r * cos1, cup_r * sin1, wrist_z - CUP_DOWN_M],
        ]
    )


def forward_all(joints_rad: Vector) -> Vector:
    """:func:`forward` of many joint positions, shape (n, 3), in one go; shape (n, 4, 3)."""
    joint1, joint2, joint3 = joints_rad.T
    elbow_r, elbow_z, wrist_r, wrist_z = _from_the_side(joint2, joint3, np.cos, np.sin)
    radii = np.array([np.full(len(joint1), SHOULDER_FORWARD_M), elbow_r, wrist_r, wrist_r + CUP_FORWARD_M])
    heights = np.array([np.full(len(joint1), SHOULDER_HEIGHT_M), elbow_z, wrist_z, wrist_z - CUP_DOWN_M])
    ends: Vector = np.array([radii * np.cos(joint1), radii * np.sin(joint1), heights]).transpose(2, 1, 0)
    return ends


def _from_the_side(joint2: Any, joint3: Any, cos: Callable[[Any], Any], sin: Callable[[Any], Any]) -> tuple[Any, Any, Any, Any]:
    """Distance from the base's axis and height of elbow and wrist, of numbers or of arrays."""
    depression = joint2 + joint3
    elbow_r = SHOULDER_FORWARD_M + LOWER_ARM_M * sin(joint2)
    elbow_z = SHOULDER_HEIGHT_M + LOWER_ARM_M * cos(joint2)
    return elbow_r, elbow_z, elbow_r + FOREARM_M * cos(depression), elbow_z - FOREARM_M * sin(depression)


def cup_position(joints_rad: Sequence[float] | Vector) -> Vector:
    """Position of the tip of the suction cup, shape (3,), metres."""
    position: Vector = forward(joints_rad)[3]
    return position


def inverse(cup_m: Sequence[float] | Vector) -> Vector:
    """Chain angles joint1..joint3 (shape (3,)) that bring the cup to ``cup_m``; the elbow points up.

    Raises :class:`UnreachableError` when the position is not finite, too far, too near, or needs a joint beyond its limits.
    """
    joints = _solve(cup_m)
    if joints is None or not within_limits(joints, tolerance_rad=1e-9):
        x, y, z = (1000.0 * float(value) for value in cup_m)
        raise UnreachableError(
            f"the cup cannot reach ({x:.1f}, {y:.1f}, {z:.1f}) mm within the joint limits; "
            "reachable is a half ring in front of the arm, about 100 to 360 mm from the base axis at table level"
        )
    return joints


def reachable(cup_m: Sequence[float] | Vector, margin_rad: float = 0.0) -> bool:
    """Whether the cup reaches ``cup_m`` with every joint at least ``margin_rad`` inside its limits."""
    joints = _solve(cup_m)
    return joints is not None and within_limits(joints, tolerance_rad=-margin_rad)


def _solve(cup_m: Sequence[float] | Vector) -> Vector | None:
    x, y, z = (float(value) for value in cup_m)
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        return None
    radius = math.hypot(x, y) - CUP_FORWARD_M - SHOULDER_FORWARD_M  # shoulder to wrist, horizontally
    height = z + CUP_DOWN_M - SHOULDER_HEIGHT_M  # shoulder to wrist, vertically
    squared = radius * radius + height * height
    distance = math.sqrt(squared)
    if not abs(LOWER_ARM_M - FOREARM_M) < distance < LOWER_ARM_M + FOREARM_M:
        return None
    elevation = math.atan2(height, radius)
    lower = elevation + _corner(squared + LOWER_ARM_M**2 - FOREARM_M**2, 2.0 * LOWER_ARM_M * distance)
    depression = _corner(squared + FOREARM_M**2 - LOWER_ARM_M**2, 2.0 * FOREARM_M * distance) - elevation
    joint2 = math.pi / 2.0 - lower
    return np.array([math.atan2(y, x), joint2, depression - joint2])


def _corner(numerator: float, denominator: float) -> float:
    # Rounding may push the law of cosines a hair over 1 at full stretch.
    return math.acos(max(-1.0, min(1.0, numerator / denominator)))


def within_limits(joints_rad: Sequence[float] | Vector, tolerance_rad: float = 0.0) -> bool:
    """Whether joint1..joint3 are finite and inside their own limits and the coupled limits.

    ``tolerance_rad`` > 0 forgives so much beyond a limit, < 0 demands a margin.
    """
    joint1, joint2, joint3 = joints_rad[0], joints_rad[1], joints_rad[2]
    return bool(  # NaN fails
        _LOW1 - tolerance_rad <= joint1 <= _HIGH1 + tolerance_rad
        and _LOW2 - tolerance_rad <= joint2 <= _HIGH2 + tolerance_rad
        and _LOW3 - tolerance_rad <= joint3 <= _HIGH3 + tolerance_rad
        and FOREARM_LIMITS_RAD[0] - tolerance_rad <= joint2 + joint3 <= FOREARM_LIMITS_RAD[1] + tolerance_rad
    )


(_LOW1, _HIGH1), (_LOW2, _HIGH2), (_LOW3, _HIGH3) = JOINT_LIMITS_RAD.tolist()


def clip_to_limits(joint1: float, joint2: float, joint3: float) -> tuple[float, float, float]:
    """Nearest legal angles, joint by joint: joint1, joint2, then joint3 within what joint2 leaves it.

    Every joint2 inside its limits leaves joint3 a non-empty range, so the result is always legal.
    """
    joint1 = min(max(joint1, _LOW1), _HIGH1)
    joint2 = min(max(joint2, _LOW2), _HIGH2)
    low3 = max(_LOW3, FOREARM_LIMITS_RAD[0] - joint2)
    high3 = min(_HIGH3, FOREARM_LIMITS_RAD[1] - joint2)
    return joint1, joint2, min(max(joint3, low3), high3)


def to_motor_deg(joints_rad: Sequence[float] | Vector) -> tuple[float, float, float]:
    """Motor angles (B, L, R) in degrees of the chain angles joint1..joint3."""
    joint1, joint2, joint3 = (float(value) for value in joints_rad[:3])
    return math.degrees(joint1) + 90.0, 90.0 - math.degrees(joint2), math.degrees(joint2 + joint3)


def from_motor_deg(base: float, left: float, right: float) -> Vector:
    """Chain angles joint1..joint3 (radians, shape (3,)) of the motor angles B, L, R in degrees."""
    return np.radians([base - 90.0, 90.0 - left, left + right - 90.0])


#: Chain angles joint1..joint3 of the home pose.
HOME_JOINTS_RAD: Final[Vector] = inverse(HOME_CUP_M)
