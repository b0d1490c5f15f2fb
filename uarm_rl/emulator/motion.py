"""How the firmware moves the motors: a queue of trapezoids, and what the motors turn.

Motor angles are B, L, R in degrees (see ``kinematics``). Numbers are those observed with the released binary V4.10.0.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from uarm_rl.real.gcode import ACCELERATION_DEG_S2, FEED_DEG_S
from uarm_rl.sim.trapezoid import Trapezoid, trapezoid

MotorAngles = tuple[float, float, float]

STEPS_PER_DEG: Final = 80.0  # 1.8 degrees, 32 microsteps, 4.5:1
DEAD_TIME_S: Final = 0.0137  # from the last byte of a command to its first step
_LINEAR_MAX_FEED: Final = 100.0


class Joints(Protocol):
    """The mechanics behind the firmware. A physics engine, or ``KinematicJoints``."""

    def drive(self, motor_deg: MotorAngles | None, dt_s: float) -> None:
        """Let ``dt_s`` pass while the motors ask for ``motor_deg``, or are limp (``None``)."""
        ...

    def motor_deg(self) -> MotorAngles:
        """Where the joints really are."""
        ...

    def resynchronise(self) -> None:
        """The firmware takes the encoders' word for where the motors are: steps that were lost do not matter any more."""
        ...

    def suck(self, on: bool) -> None:
        """Switch the pump."""
        ...

    def holding(self) -> bool:
        """Whether something seals the cup while the pump runs."""
        ...

    def tip_pressed(self) -> bool:
        """Whether the contact at the hand is closed."""
        ...


def with_play(joints_deg: MotorAngles, motor_deg: MotorAngles, backlash_deg: float) -> MotorAngles:
    """Where motors at ``motor_deg`` take the joints, which stay where they are inside the play of the gears."""
    half = 0.5 * backlash_deg
    b, left, right = (min(max(at, to - half), to + half) for at, to in zip(joints_deg, motor_deg, strict=True))
    return b, left, right


@dataclass
class KinematicJoints:
    """Joints that are where the motors are, apart from ``backlash_deg`` of play; nothing to hold but ``sealed``."""

    angles: MotorAngles
    backlash_deg: float = 0.0
    sealed: bool = False
    pressed: bool = False
    sucking: bool = False

    def drive(self, motor_deg: MotorAngles | None, dt_s: float) -> None:
        if motor_deg is not None:
            self.angles = with_play(self.angles, motor_deg, self.backlash_deg)

    def motor_deg(self) -> MotorAngles:
        return self.angles

    def resynchronise(self) -> None:
        """Nothing is ever lost here."""

    def suck(self, on: bool) -> None:
        self.sucking = on

    def holding(self) -> bool:
        return self.sucking and self.sealed

    def tip_pressed(self) -> bool:
        return self.pressed


class _Move(NamedTuple):
    """Along ``path``: share of the way -> motor angles."""

    path: Callable[[float], MotorAngles]
    profile: Trapezoid


class Motion:
    """A first-in first-out queue of moves on a clock of its own, which a feed hold stops.

    Each move runs from rest to rest; the firmware blends moves that arrive in time, which is not copied. A hold stops
    at once, where the firmware decelerates.
    """

    def __init__(self, start_deg: MotorAngles) -> None:
        self.origin = start_deg  # steps count from here
        self.position = start_deg  # of the motors
        self.planned = start_deg  # where the last queued move ends
        self.held = False
        self.acceleration_deg_s2 = ACCELERATION_DEG_S2  # of the fastest motor
        self._moves: deque[_Move] = deque()
        self._clock_s = 0.0
        self._stalled_s = 0.0

    @property
    def moving(self) -> bool:
        return bool(self._moves)

    def queue(self, target_deg: MotorAngles, feed: float) -> None:
        """A straight line in motor angles: G0, G2202, G2206."""
        start, end = self.planned, self._to_steps(target_deg)
        change = [b - a for a, b in zip(start, end, strict=True)]
        largest = max(abs(c) for c in change)
        if largest > 0.0 and feed > 0.0:  # with F 0 the firmware answers ok and does not move
            distance = math.hypot(*change)
            self._append(
                lambda share: _mix(start, end, share), end, distance, feed, distance / largest * self.acceleration_deg_s2
            )

    def queue_line(self, path: Callable[[float], MotorAngles], feed: float) -> None:
        """A straight line of the cup: G1, G2201, G2204, G2205. F is capped and the acceleration is lower."""
        feed = min(feed, _LINEAR_MAX_FEED)
        end = self._to_steps(path(1.0))
        distance = math.dist(path(0.0), end)
        if distance > 0.0:
            self._append(path, end, distance, feed, 80.0 * (0.5 + 0.045 * feed))

    def _append(
        self, path: Callable[[float], MotorAngles], end: MotorAngles, distance: float, feed: float, acceleration: float
    ) -> None:
        begins_s = self._clock_s + DEAD_TIME_S
        if self._moves:
            begins_s = max(begins_s, self._moves[-1].profile.ends_s)
        self._moves.append(_Move(path, trapezoid(begins_s, distance, FEED_DEG_S * feed, acceleration)))
        self.planned = end

    def advance(self, dt_s: float) -> None:
        """Let ``dt_s`` pass."""
        stalled = min(self._stalled_s, dt_s)
        self._stalled_s -= stalled
        if not self.held:
            self._clock_s += dt_s - stalled
        while self._moves and self._moves[0].profile.ends_s <= self._clock_s:
            self.position = self._to_steps(self._moves.popleft().path(1.0))
        if self._moves:
            path, profile = self._moves[0]
            self.position = self._to_steps(path(profile.share(self._clock_s)))

    def stall(self, seconds: float) -> None:
        """Stand still for a moment in the middle of a move (the step buffer ran dry)."""
        self._stalled_s = max(self._stalled_s, seconds)

    def flush(self, at_deg: MotorAngles) -> None:
        """Forget every move; the motors are taken to be at ``at_deg``."""
        self._moves.clear()
        self.origin = self.position = self.planned = at_deg
        self.held = False

    def _to_steps(self, angles: MotorAngles) -> MotorAngles:
        pairs = zip(angles, self.origin, strict=True)
        b, left, right = (zero + round((angle - zero) * STEPS_PER_DEG) / STEPS_PER_DEG for angle, zero in pairs)
        return b, left, right


def _mix(start: MotorAngles, end: MotorAngles, share: float) -> MotorAngles:
    b, left, right = (a + share * (z - a) for a, z in zip(start, end, strict=True))
    return b, left, right
