"""The audit: one pure function between a wish and the wire. What it refuses is never sent."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from numbers import Real
from typing import Final

from uarm_rl import checks
from uarm_rl.real.gcode import FEED_DEG_S, Command
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError, JointPositions
from uarm_rl.task.kinematics import ELBOW_OPENING_DEG, MOTOR_LIMITS_DEG
from uarm_rl.task.layouts import ways_between
from uarm_rl.task.obstacles import Box, Size, way_clearances_m

log = logging.getLogger(__name__)

#: A reference this close to a limit is pulled inside it by as much: one step of the motors, so that rounding on the
#: wire or in the firmware's 32-bit floats cannot turn a legal limit into a refusal.
_MICROSTEP_DEG: Final = 0.0125
_PATH_STEP_DEG: Final = 2.0  # the path is looked at every so often
_PATH_TOLERANCE_M: Final = 0.001  # a way out of a forbidden place may dip by this much first

_CLOSE_STEP_DEG: Final = 0.25  # and beside a known object so often: the cup travels a millimetre
_CLEARANCE_M: Final = 0.001  # beside it, for what happens between two looks
_ROUNDING_M: Final = 2e-5
_DRIFT_M: Final = 1e-4  # likewise beside an obstacle, where it is the whole arm that is looked at
_RISES_M: Final = tuple(0.002 * step for step in range(31))  # where a way over the object is looked for
#: And one past an obstacle: how far drawn in and how far raised, the nearest first.
_ASIDE_M: Final = (0.0, 0.005, 0.01, 0.02, 0.03)
_EVASIONS_M: Final = tuple(sorted(itertools.product(_ASIDE_M, repeat=2), key=lambda by: math.hypot(*by)))[1:]

#: The arm's own base, from the maker's CAD model: half of its square footprint and its height, with the radius of the
#: cup's lip (9.5 mm) around it. Firmware 3.2 refuses such targets, firmware 4 drives into them.
_BASE_HALF_WIDTH_M: Final = 0.066 + 0.0095
_BASE_HEIGHT_M: Final = 0.087


class UnsafeCommandError(ArmError):
    """A motion command that the audit refuses; nothing was sent and the arm is as it was."""


class ObstructedError(UnsafeCommandError):
    """A motion command that is refused for an obstacle in its way, and for nothing else."""


@dataclass(frozen=True)
class Limits:
    """Where the cup may be (m, base frame), how far one step may go, how fast the motors may turn.

    The default speed is the data sheet's 40 deg/s. ``max_step_rad`` bounds each of joint1..joint3 in one decision. No part of
    the arm comes nearer than ``obstacle_clearance_m`` to one of the ``obstacles``, nor does what hangs from the cup, of length,
    width and height ``carried_m``.
    """

    x_m: tuple[float, float] = (-0.01, 0.37)
    y_m: tuple[float, float] = (-0.37, 0.37)
    z_m: tuple[float, float] = (0.0, 0.20)
    table_clearance_m: float = 0.003
    max_step_rad: float = 0.25
    max_speed_deg_s: float = 40.0
    obstacle_clearance_m: float = 0.01
    obstacles: tuple[Box, ...] = ()
    carried_m: Size | None = None

    def carrying(self, size_m: Size | None) -> Limits:
        """These limits while something of that length, width and height (m) hangs from the cup: it too keeps clear."""
        return replace(self, carried_m=size_m)

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m", "z_m"):
            low, high = getattr(self, name)
            checks.number(f"limits.{name}[0]", low)
            checks.number(f"limits.{name}[1]", high, low=low)
        checks.number("limits.table_clearance_m", self.table_clearance_m, low=0.0, high=0.1)
        checks.number("limits.obstacle_clearance_m", self.obstacle_clearance_m, low=0.0, high=0.1)
        checks.number("limits.max_step_rad", self.max_step_rad, low=0.0, high=math.pi, open_low=True)
        checks.number("limits.max_speed_deg_s", self.max_speed_deg_s, low=0.0, high=200.0, open_low=True)


@dataclass(frozen=True)
class KnownObject:
    """A box that stands there: the cup may press its upper surface by ``max_press_m`` and not touch its sides.

    However it is turned: what counts is the cylinder around it, with the cup's lip beside it.
    """

    top_m: tuple[float, float, float]  # centre of its upper surface, base frame
    size_m: tuple[float, float, float]  # length, width, height
    max_press_m: float

    @property
    def lowest_m(self) -> float:
        """Height below which the cup may not be within ``radius_m`` of its axis."""
        return self.top_m[2] - self.max_press_m

    @property
    def radius_m(self) -> float:
        return math.hypot(self.size_m[0], self.size_m[1]) / 2.0 + kinematics.CUP_RADIUS_M + _CLEARANCE_M

    def depth_m(self, cup_m: Sequence[float]) -> float:
        """How far a cup would be inside what is not allowed; 0 outside."""
        aside_m = math.hypot(cup_m[0] - self.top_m[0], cup_m[1] - self.top_m[1])
        return max(0.0, min(self.lowest_m - cup_m[2], self.radius_m - aside_m))


@dataclass(frozen=True)
class Audited:
    """A motion command that passed. ``clamped``: the reference was pulled inside a limit, by at most two microsteps.

    ``pulled_up_m``: by how much it was raised so as to spare the known object, or raised and drawn in to keep off an obstacle.
    """

    command: Command
    joints_rad: JointPositions
    distance_deg: float  # norm of the motors' travel
    clamped: bool
    pulled_up_m: float = 0.0


def audit(
    reference_rad: Sequence[float],
    joints_rad: JointPositions,
    *,
    feed: float,
    limits: Limits,
    single_step: bool,
    known: KnownObject | None = None,
) -> Audited:
    """The command that moves from ``joints_rad`` straight to ``reference_rad`` (joint1..joint3) at F = ``feed``.

    Raises :class:`UnsafeCommandError` unless the reference is three finite numbers inside the joint limits and the coupled
    limits, the speed is allowed, no joint steps too far (``single_step``; homing and parking may), and the cup ends
    and stays on its way inside the workspace, above the table and off the arm's own base, and all of the arm clear of the
    obstacles. An arm that starts outside (sagged onto the table) may move as long as that brings it no further outside.

    A cup that would come too deep into the ``known`` object, or into its side, there or on its way, goes to the lowest place
    above that spares it. A single step that would bring the arm too near an obstacle goes to the nearest of a few places that
    are drawn in and higher, if the arm keeps clear there and on its way.
    """
    reference = _three_numbers(reference_rad)
    if not kinematics.within_limits(reference, tolerance_rad=math.radians(_MICROSTEP_DEG)):
        raise UnsafeCommandError(f"joint angles {_degrees(reference)} are outside the joint limits; {_joint_limits()}")
    if not 0.0 < FEED_DEG_S * feed <= limits.max_speed_deg_s:
        raise UnsafeCommandError(
            f"F {feed:g} asks for {FEED_DEG_S * feed:.1f} deg/s; allowed is up to {limits.max_speed_deg_s:g} deg/s, "
            f"F {limits.max_speed_deg_s / FEED_DEG_S:.1f}"
        )
    wanted = reference
    reference, pulled_up_m = _spared(reference, joints_rad, known, limits.max_step_rad if single_step else math.inf)
    if pulled_up_m:
        log.info("the cup was to go %.1f mm too deep into the object, to %s", 1000.0 * pulled_up_m, _degrees(wanted))
    step_rad = max(abs(b - a) for a, b in zip(joints_rad, reference, strict=True))
    if single_step and not step_rad <= limits.max_step_rad:
        raise UnsafeCommandError(
            f"a step from {_degrees(joints_rad)} to {_degrees(reference)} turns a joint by "
            f"{math.degrees(step_rad):.1f} degrees; allowed are {math.degrees(limits.max_step_rad):.1f} in one step"
        )
    if single_step and limits.obstacles:
        reference, aside_m = _clear(reference, joints_rad, limits, known)
        pulled_up_m = pulled_up_m or aside_m
    start, end = kinematics.to_motor_deg(joints_rad), kinematics.to_motor_deg(reference)
    legal = _pull_inside(*end)
    if clamped := max(abs(a - b) for a, b in zip(legal, end, strict=True)) > 1e-9:
        log.info("motor angles B %.4f, L %.4f, R %.4f clamped to the limits: B %.4f, L %.4f, R %.4f", *end, *legal)
    reached = _check_way(joints_rad, legal, limits)
    return Audited(Command("G2206", *legal, feed), reached, math.dist(start, legal), clamped, pulled_up_m)


def way(
    reference_rad: Sequence[float], joints_rad: JointPositions, *, feed: float, limits: Limits, known: KnownObject | None = None
) -> list[Sequence[float]]:
    """What to command one after the other to come to ``reference_rad``: it alone, or with an obstacle in the way others first.

    :func:`audit` lets all of it pass. Where it lets none pass that was tried, this raises what it raises for the straight way.
    """
    passes = partial(audit, feed=feed, limits=limits, single_step=False, known=known)
    try:
        passes(reference_rad, joints_rad)
    except ObstructedError:
        for legs in ways_between(joints_rad, reference_rad):
            at = joints_rad
            with suppress(UnsafeCommandError):
                for leg in legs:
                    at = passes(leg.tolist(), at).joints_rad
                return [leg.tolist() for leg in legs]
        raise
    return [reference_rad]


def _spared(
    reference: JointPositions, joints_rad: JointPositions, known: KnownObject | None, most_rad: float
) -> tuple[JointPositions, float]:
    """The reference, or the lowest one above it whose whole way spares the known object; and how much higher that is.

    Where there is none the cup goes up from where it is: from there the next command sees further.
    """
    if known is None or _spares(joints_rad, reference, known):
        return reference, 0.0
    (x, y, z), (at_x, at_y, at_z) = _cup_of(reference), _cup_of(joints_rad)
    above = [(x, y, max(z, known.lowest_m) + rise_m) for rise_m in _RISES_M]
    up = [(at_x, at_y, at_z + rise_m) for rise_m in reversed(_RISES_M)]
    for place in above + up:
        with suppress(kinematics.UnreachableError):
            one, two, three = kinematics.inverse(place).tolist()
            near = max(abs(b - a) for a, b in zip(joints_rad, (one, two, three), strict=True)) <= most_rad
            if near and _spares(joints_rad, (one, two, three), known):
                return (one, two, three), place[2] - z
    raise UnsafeCommandError(
        f"the way to ({1000.0 * x:.1f}, {1000.0 * y:.1f}, {1000.0 * z:.1f}) mm leads through the object, and none over it; "
        "lift the arm by hand"
    )


def _clear(
    reference: JointPositions, joints_rad: JointPositions, limits: Limits, known: KnownObject | None
) -> tuple[JointPositions, float]:
    """The reference, or the nearest place to which the arm keeps clear of the obstacles; and how far away that is.

    Where there is none about the reference, the cup draws in and rises where it is: from there the next command has more
    room. Where there is none at all it is the reference, which is refused then.
    """
    try:
        _check_way(joints_rad, _pull_inside(*kinematics.to_motor_deg(reference)), limits)
    except ObstructedError:
        wanted = _cup_of(reference)
        for x, y, z in (wanted, _cup_of(joints_rad)):
            for inwards_m, rise_m in _EVASIONS_M:
                stretch = 1.0 - inwards_m / math.hypot(x, y)
                place = (stretch * x, stretch * y, z + rise_m)
                with suppress(kinematics.UnreachableError, UnsafeCommandError):
                    one, two, three = kinematics.inverse(place).tolist()
                    near = max(abs(b - a) for a, b in zip(joints_rad, (one, two, three), strict=True)) <= limits.max_step_rad
                    if near and (known is None or _spares(joints_rad, (one, two, three), known)):
                        _check_way(joints_rad, _pull_inside(*kinematics.to_motor_deg((one, two, three))), limits)
                        return (one, two, three), math.dist(place, wanted)
    except UnsafeCommandError:
        pass  # of another kind: refused as it is
    return reference, 0.0


def _spares(start_rad: JointPositions, end_rad: JointPositions, known: KnownObject) -> bool:
    """Whether the cup comes no deeper into the object, on a straight way in angles, than it is or may be."""
    allowed_m = known.depth_m(_cup_of(start_rad)) + _ROUNDING_M
    widest_deg = math.degrees(max(abs(b - a) for a, b in zip(start_rad, end_rad, strict=True)))
    pieces = math.ceil(widest_deg / _CLOSE_STEP_DEG) + 1
    for piece in range(1, pieces + 1):
        share = piece / pieces
        q1, q2, q3 = (a + share * (b - a) for a, b in zip(start_rad, end_rad, strict=True))
        if known.depth_m(_cup_of((q1, q2, q3))) > allowed_m:
            return False
    return True


def _cup_of(joints_rad: JointPositions) -> tuple[float, float, float]:
    x, y, z = kinematics.cup_position(joints_rad).tolist()
    return x, y, z


def _three_numbers(reference_rad: Sequence[float]) -> JointPositions:
    try:
        values = list(itertools.islice(reference_rad, 4))
    except TypeError:
        values = []
    numbers = [float(value) for value in values if isinstance(value, Real) and abs(value) < 1e3]  # NaN compares false
    if len(values) != 3 or len(numbers) != 3:
        raise UnsafeCommandError(f"a reference is three finite joint angles in radians, got {repr(reference_rad)[:80]}")
    return numbers[0], numbers[1], numbers[2]


def _pull_inside(base: float, left: float, right: float) -> tuple[float, float, float]:
    margin = _MICROSTEP_DEG
    (b_low, b_high), (l_low, l_high), (r_low, r_high) = (MOTOR_LIMITS_DEG[name] for name in "BLR")
    opening_low, opening_high = ELBOW_OPENING_DEG
    base = min(max(base, b_low + margin), b_high - margin)
    left = min(max(left, l_low + margin), l_high - margin)
    low = max(r_low, 180.0 - opening_high - left) + margin
    high = min(r_high, 180.0 - opening_low - left) - margin
    return base, left, min(max(right, low), high)


def _check_way(joints_rad: JointPositions, legal_deg: tuple[float, float, float], limits: Limits) -> tuple[float, float, float]:
    """Look at cup and arm all along the way to these motor angles; the joint positions at its end."""
    _check_path(kinematics.to_motor_deg(joints_rad), legal_deg, limits)
    one, two, three = kinematics.from_motor_deg(*legal_deg).tolist()
    _check_obstacles(joints_rad, (one, two, three), limits)
    return one, two, three


def _check_path(start_deg: tuple[float, float, float], end_deg: tuple[float, float, float], limits: Limits) -> None:
    """The firmware moves all motors along one straight line in angles; look at the cup all along it."""
    allowed_m = _outside(_cup(start_deg), limits)[0] + _PATH_TOLERANCE_M
    pieces = math.ceil(max(abs(b - a) for a, b in zip(start_deg, end_deg, strict=True)) / _PATH_STEP_DEG) + 1
    for piece in range(1, pieces + 1):
        at_end = piece == pieces
        share = piece / pieces
        b, left, right = (a + share * (z - a) for a, z in zip(start_deg, end_deg, strict=True))
        cup = _cup((b, left, right))
        excess_m, why = _outside(cup, limits)
        if excess_m > (0.0 if at_end else allowed_m):
            x, y, z = (1000.0 * value for value in cup)
            raise UnsafeCommandError(
                f"the cup would {'end' if at_end else 'pass'} at ({x:.1f}, {y:.1f}, {z:.1f}) mm, {why}; "
                "choose a target inside, or lift the arm by hand if it hangs low"
            )


def _check_obstacles(start_rad: JointPositions, end_rad: JointPositions, limits: Limits) -> None:
    """Look at the whole arm all along its way: no part of it may come nearer to an obstacle than it may, or is."""
    if not limits.obstacles:
        return
    step_rad = math.radians(_CLOSE_STEP_DEG)
    begins_m, *on_its_way_m = way_clearances_m(start_rad, end_rad, limits.obstacles, step_rad, limits.carried_m).tolist()
    nearest_m, allowed_m = min(on_its_way_m), limits.obstacle_clearance_m
    least_m, at_end_m = allowed_m, allowed_m
    if begins_m < allowed_m:  # it may leave, straight up for instance, which in joint angles is not quite straight
        least_m, at_end_m = begins_m - _PATH_TOLERANCE_M, begins_m - _DRIFT_M
    if nearest_m < least_m or on_its_way_m[-1] < at_end_m:
        raise ObstructedError(
            f"on its way to {_degrees(end_rad)} the arm would be within {1000.0 * max(0.0, nearest_m):.0f} mm of an obstacle, "
            f"and {1000.0 * allowed_m:g} mm are to be kept; choose another target, or move the obstacle"
        )


def _cup(motor_deg: tuple[float, float, float]) -> tuple[float, float, float]:
    first, second, third = kinematics.from_motor_deg(*motor_deg).tolist()
    return _cup_of((first, second, third))


def _outside(cup_m: tuple[float, float, float], limits: Limits) -> tuple[float, str]:
    """By how many metres the cup is outside of what is allowed (0 inside), and what forbids it."""
    x, y, z = cup_m
    excesses = [
        (limits.table_clearance_m - z, f"closer to the table than {1000.0 * limits.table_clearance_m:g} mm"),
        (
            min(_BASE_HALF_WIDTH_M - abs(x), _BASE_HALF_WIDTH_M - abs(y), _BASE_HEIGHT_M - z),
            "where it would touch the arm's own base",
        ),
    ]
    for axis, value, (low, high) in zip("xyz", cup_m, (limits.x_m, limits.y_m, limits.z_m), strict=True):
        allowed = f"outside the workspace, {1000.0 * low:g} to {1000.0 * high:g} mm in {axis}"
        excesses += [(low - value, allowed), (value - high, allowed)]
    excess_m, why = max(excesses)
    return max(0.0, excess_m), why


def _degrees(joints_rad: JointPositions) -> str:
    return "(" + ", ".join(f"{math.degrees(joint):.1f}" for joint in joints_rad) + ") degrees"


def _joint_limits() -> str:
    rows = [f"joint{i}: {low:g} to {high:g}" for i, (low, high) in enumerate(_limits_deg(), start=1)]
    low, high = MOTOR_LIMITS_DEG["R"]
    return f"allowed are {', '.join(rows)}, joint2 + joint3: {low:g} to {high:g}"


def _limits_deg() -> list[list[float]]:
    limits: list[list[float]] = [[math.degrees(limit) for limit in row] for row in kinematics.JOINT_LIMITS_RAD.tolist()]
    return limits
