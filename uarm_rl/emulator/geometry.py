"""The firmware's own arithmetic: mm and motor degrees, tool modes, limits by version, encoder counts."""

from __future__ import annotations

import math
from typing import Final

from uarm_rl.emulator.motion import MotorAngles
from uarm_rl.task import kinematics
from uarm_rl.task.kinematics import ELBOW_OPENING_DEG, MOTOR_LIMITS_DEG

#: The calibration pose, from which the encoders count: 2000 counts there, 4096 a turn.
POINT_B_DEG: Final[MotorAngles] = (90.0, 32.758930, 88.980537)
_REFERENCE_COUNT: Final = 2000
_COUNT_DEG: Final = 360.0 / 4096.0

#: Tool mode (M2400) -> cup below and ahead of the wrist, mm. Modes 4 and 5 home a motor that the stand-in lacks, and
#: mode 7 is the user's.
TOOLS_MM: Final = {
    0: (74.55, 56.65),
    1: (51.04, 64.4),
    2: (74.43, 56.5),
    3: (43.0, 69.5),
    6: (77.2, 54.5),
    8: (0.0, 0.0),
    9: (74.55, 56.65),
}
_LIMITS_BEFORE_4_8_DEG: Final = {"B": (0.0, 180.0), "L": (0.0, 135.6), "R": (0.0, 119.9)}


def counts(motor_deg: MotorAngles) -> tuple[int, ...]:
    """What the encoders count at ``motor_deg``."""
    pairs = zip(motor_deg, POINT_B_DEG, strict=True)
    return tuple(round((angle - reference) / _COUNT_DEG) + _REFERENCE_COUNT for angle, reference in pairs)


def quantised(motor_deg: MotorAngles) -> MotorAngles:
    """The angles that the firmware makes of the counts."""
    pairs = zip(counts(motor_deg), POINT_B_DEG, strict=True)
    b, left, right = (reference + (count - _REFERENCE_COUNT) * _COUNT_DEG for count, reference in pairs)
    return b, left, right


def legal(motor_deg: MotorAngles, version: tuple[int, ...]) -> bool:
    """Whether the firmware accepts the angles; not for NaN."""
    limits = MOTOR_LIMITS_DEG if version >= (4, 8, 0) else _LIMITS_BEFORE_4_8_DEG
    own = all(low <= angle <= high for angle, (low, high) in zip(motor_deg, limits.values(), strict=True))
    low, high = ELBOW_OPENING_DEG
    return own and low <= 180.0 - motor_deg[1] - motor_deg[2] <= high


def cup_mm(motor_deg: MotorAngles, tool_mode: int) -> tuple[float, float, float]:
    """Where the tool's tip is."""
    down, forward = TOOLS_MM[tool_mode]
    x, y, z = (1000.0 * kinematics.cup_position(kinematics.from_motor_deg(*motor_deg))).tolist()
    ahead, turn = forward - 1000.0 * kinematics.CUP_FORWARD_M, math.radians(motor_deg[0] - 90.0)
    return x + ahead * math.cos(turn), y + ahead * math.sin(turn), z - down + 1000.0 * kinematics.CUP_DOWN_M


def motors_deg(x: float, y: float, z: float, tool_mode: int) -> MotorAngles:
    """Inverse kinematics without a look at the limits; NaN where there is no solution, or behind the arm."""
    down, forward = TOOLS_MM[tool_mode]
    a, b = 1000.0 * kinematics.LOWER_ARM_M, 1000.0 * kinematics.FOREARM_M
    r = math.hypot(x, y) - forward - 1000.0 * kinematics.SHOULDER_FORWARD_M
    k = z + down - 1000.0 * kinematics.SHOULDER_HEIGHT_M
    d = math.hypot(r, k)
    if x < 0.0 or not abs(a - b) < d <= a + b:
        return math.nan, math.nan, math.nan
    phi = math.atan2(k, r)
    left = phi + math.acos(min(1.0, (d * d + a * a - b * b) / (2.0 * a * d)))
    right = math.acos(min(1.0, (d * d + b * b - a * a) / (2.0 * b * d))) - phi
    return 90.0 + math.degrees(math.atan2(y, x)), math.degrees(left), math.degrees(right)


def from_polar(stretch: float, base_deg: float) -> tuple[float, float]:
    """X and Y of a stretch (mm) along the base angle B."""
    turn = math.radians(base_deg - 90.0)
    return stretch * math.cos(turn), stretch * math.sin(turn)
