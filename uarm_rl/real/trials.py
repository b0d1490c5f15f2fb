"""Trials on the real arm: find the object, bring the cup onto it with a policy, suck, lift, put it down.

Reaching is ``rollout.run_episode``, the same as in simulation. What follows it is short and classical: press down by a
few millimetres, suck, lift straight up, and look at the pump, which knows whether the cup is sealed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks
from uarm_rl.real.audit import KnownObject, Limits, ObstructedError, UnsafeCommandError
from uarm_rl.real.swift_arm import PumpState, SwiftArm
from uarm_rl.task import kinematics, positions
from uarm_rl.task.arm import Ghost
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.hold import Hold
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.layouts import Layout, Layouts, Reach
from uarm_rl.task.observation import PaperObservation
from uarm_rl.task.obstacles import Box, leaves_room
from uarm_rl.task.policy import Policy
from uarm_rl.task.reward import DistanceReward
from uarm_rl.task.rollout import run_episode

Row = dict[str, Any]  # with keys of ``columns.TRIALS``

LIFT_M: Final = 0.06  # as high as ``positions`` demands that the cup can come from
_SEEN_FROM_M: Final = 0.16  # from the base's axis to what a camera ahead of the cup sees
_PIECE_M: Final = 0.015  # a straight line in joint angles bends by 0.4 mm over so much height, by 7 mm over the lift
_MIDDLE_M: Final = (0.15, 0.32)  # radii at which the arm reaches every height up to the lift
_PRESS_STEP_M: Final = 0.001
_SEAL_S: Final = 1.0  # how long a cup may take to seal; users of the arm wait 0.2 s
_LOOK_S: Final = 0.1
_HANG_S: Final = 0.5  # how long the object must hang after the lift
_RELEASE_S: Final = 0.5  # the valve lets air in
_BESIDE_M: Final = 0.005  # more than an obstacle's clearance: it will not lie there to the millimetre
_PLACES: Final = 50  # are tried to put the object down, where obstacles are in the way

#: The environment wants a reward; on the real arm nobody looks at it.
_REWARD: Final = DistanceReward(alpha=1.0, beta=0.0, sigma=0.0, alpha_d=-1.0, beta_d=-1.0)


class ObjectNotFoundError(Exception):
    """The object is not where it was looked for; the message is a sentence."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """Where the object is, and how sure that is."""

    target_m: Vector  # centre of its upper surface, shape (3,)
    looks: int = 0  # pictures that it took
    misfit_px: float | None = None  # how badly the object's outline fits a box there
    disagreement_m: float | None = None  # between the first and the last look
    picture: NDArray[np.uint8] | None = None  # BGR, with what was found drawn into it


class Search(Protocol):
    """A way to find the object."""

    def find(self, arm: SwiftArm, guess_m: Vector | None) -> Sighting:
        """Where the object is; ``guess_m`` is where it was put down last. Raises :class:`ObjectNotFoundError`."""
        ...


@dataclass(frozen=True, eq=False)
class GivenTarget:
    """The user says where the object is."""

    target_m: Vector

    def find(self, arm: SwiftArm, guess_m: Vector | None) -> Sighting:
        return Sighting(self.target_m)


@dataclass(frozen=True, eq=False)
class RandomTargets:
    """For a dry run: somewhere in the operating range."""

    generator: np.random.Generator
    height_m: float

    def find(self, arm: SwiftArm, guess_m: Vector | None) -> Sighting:
        return Sighting(positions.draw(self.generator, self.height_m))


@dataclass(frozen=True)
class Task:
    """What the policy was trained for (its card), and how the object is picked up after it.

    The cup is pressed ``press_m`` below the object's upper surface, and deeper, up to ``max_press_m``, if it does not seal.
    """

    hold: Hold
    control_hz: int
    max_delta_rad: float
    tolerance_m: float
    dwell_s: float
    time_limit_s: float
    press_m: float
    max_press_m: float
    object_size_m: tuple[float, float, float]
    observation: PaperObservation = field(default_factory=PaperObservation)
    actions: str = "joint"
    layouts: Layouts = field(default_factory=Reach)
    obstacles: tuple[Box, ...] = ()  # that stand there, for a policy that sees some

    def __post_init__(self) -> None:
        checks.number("press_m", self.press_m, low=0.0, high=0.01)
        checks.number("max_press_m", self.max_press_m, low=self.press_m, high=0.01)

    def known(self, top_m: Vector) -> KnownObject:
        """The object as the audit has to know it."""
        x, y, z = top_m.tolist()
        return KnownObject((x, y, z), self.object_size_m, self.max_press_m)

    def options(self, target_m: Vector) -> dict[str, Any]:
        """How an attempt begins: with the arm where it is, and the obstacles told to a policy that sees some."""
        return {**Layout(target_m, self.obstacles if self.layouts.slots else ()).options(), "home": False}

    def env(self, arm: SwiftArm) -> UArmSuctionEnv:
        """The environment over ``arm``."""
        return UArmSuctionEnv(
            arm,
            Ghost(),  # the camera sees nothing while the cup is above the object
            _REWARD,
            self.hold,
            control_hz=self.control_hz,
            max_delta_rad=self.max_delta_rad,
            tolerance_m=self.tolerance_m,
            dwell_s=self.dwell_s,
            time_limit_s=self.time_limit_s,
            observation=self.observation,
            layouts=self.layouts,
            actions=self.actions,
            object_height_m=positions.OBJECT_HEIGHT_M,  # of objects that it places itself, here none
        )


@dataclass(frozen=True, eq=False)
class Trial:
    """One result: the row of the table, and the picture that the object was found in."""

    row: Row
    picture: NDArray[np.uint8] | None


def run_trials(
    arm: SwiftArm,
    policy: Policy,
    search: Search,
    task: Task,
    put_down: Callable[[Vector], Vector] | None,
    *,
    trials: int,
    first: int = 1,
) -> Iterator[Trial]:
    """Carry out the trials from number ``first`` to ``trials`` and yield each result as it comes.

    ``put_down`` tells where an object goes that was at a place (both are centres of its upper surface), so that every
    trial is another one: an object that the policy did not get is fetched by inverse kinematics and goes there too, after
    the trial has failed. ``None``: an object goes back to where it was, or stays there.

    A trial that fails (object not found, not reached, not held) is a result. What the arm or the camera raises ends
    the trials; ``arm`` is for the caller to close.
    """
    env = task.env(arm)
    at: Vector | None = None
    for number in range(first, trials + 1):
        clamps, pull_ups = arm.clamps, arm.pull_ups
        arm.known = None
        row: Row = {"trial": number, "success": False, "reached": False, "firmware": "V{}.{}.{}".format(*arm.firmware)}
        picture = None
        try:
            sighting = search.find(arm, at)
        except ObjectNotFoundError as error:
            row["reason"] = str(error)
            at = None
        else:
            picture, at = sighting.picture, sighting.target_m
            arm.known = task.known(at)
            row |= dict(zip(("target_x_m", "target_y_m", "target_z_m"), at.tolist(), strict=True))
            row |= {"looks": sighting.looks, "camera_misfit_px": sighting.misfit_px}
            row |= {"camera_disagreement_m": sighting.disagreement_m}
            row["reason"] = out_of_reach(at) or _reach(arm, env, policy, task, at, row) or _pick_up(arm, at, task)
            row["success"] = not row["reason"]
            held = row["success"] or (put_down is not None and not out_of_reach(at) and _fetch(arm, at, task))
            if held:
                arm.known = None  # it hangs from the cup
                at = _carry(arm, at, put_down)
                lost = _put_down(arm, at)
                row["reason"] = row["reason"] or lost
        row |= {"clamps": arm.clamps - clamps, "pull_ups": arm.pull_ups - pull_ups}
        yield Trial(row, picture)


def scattered(generator: np.random.Generator, within: Limits | None = None) -> Callable[[Vector], Vector]:
    """Puts each object down at a random place of the operating range that the camera sees, at the height it came from, and
    where the obstacles, if there are any, leave room for the arm."""
    within = within or Limits()
    clearance_m = within.obstacle_clearance_m + _BESIDE_M

    def put_down(target_m: Vector) -> Vector:
        while True:
            place = positions.draw(generator, float(target_m[2]))
            seen = math.hypot(place[0], place[1]) >= _SEEN_FROM_M
            if seen and leaves_room(place, within.obstacles, clearance_m, within.carried_m):
                return place

    return put_down


def out_of_reach(target_m: Vector) -> str:
    """Why the arm cannot pick something up at ``target_m`` (m), as a sentence; empty if it can."""
    if positions.in_operating_range(target_m):
        return ""
    x, y, z = (1000.0 * float(value) for value in target_m)
    return (
        f"the arm cannot come down onto ({x:.0f}, {y:.0f}, {z:.0f}) mm; put the object in front of the arm, "
        f"{1000.0 * positions.MIN_RADIUS_M:.0f} to about 350 mm from the axis of its base"
    )


def _reach(arm: SwiftArm, env: UArmSuctionEnv, policy: Policy, task: Task, target_m: Vector, row: Row) -> str:
    """Bring the cup onto the target with the policy; why it did not arrive, if it did not. Adds to ``row``."""
    arm.home()
    began_s = arm.time_s()
    reason = ""
    try:
        episode = run_episode(env, policy, options=task.options(target_m))
        row |= {"reached": episode.success, "decisions": episode.decisions}
    except UnsafeCommandError as error:  # nothing was sent, so the arm is as it was
        reason = f"the policy asked for something unsafe: {error}"
    row["time_s"] = arm.time_s() - began_s
    row["final_distance_m"] = distance_m = math.dist(_cup(arm), target_m)
    if not (row["reached"] or reason):
        reason = f"the policy did not stay within reach of the target; it ended {1000.0 * distance_m:.1f} mm away"
    if reason:
        _rise(arm, float(target_m[2]) + LIFT_M)
    return reason


def _pick_up(arm: SwiftArm, target_m: Vector, task: Task) -> str:
    """Press down, suck and lift; why the object does not hang from the cup, if it does not."""
    top_m = float(target_m[2])
    sealed = False
    press_m = task.press_m
    while True:
        _straight(arm, min(float(_cup(arm)[2]), top_m - press_m))
        if press_m == task.press_m:
            arm.pump_on()
        if sealed := _holds(arm, _SEAL_S, soon=True):
            break
        if press_m + _PRESS_STEP_M > task.max_press_m + 1e-9:
            break
        press_m += _PRESS_STEP_M
    if not sealed:
        _let_go(arm, top_m)
        return f"the cup did not seal on the object, pressed {1000.0 * press_m:.0f} mm into its upper surface"
    arm.carried_m = task.object_size_m
    _rise(arm, top_m + LIFT_M)
    if _holds(arm, _HANG_S, soon=False):
        return ""
    _straight(arm, top_m)
    _let_go(arm, top_m)
    return "the object fell off while it was lifted; check the cup, the hose and the object's weight and surface"


def _let_go(arm: SwiftArm, top_m: float) -> None:
    """Switch the pump off down there, and rise: what half hangs from the cup, or sealed late, does not fall."""
    arm.pump_off()
    arm.carried_m = None
    arm.rest(_RELEASE_S)
    _rise(arm, top_m + LIFT_M)


def _fetch(arm: SwiftArm, target_m: Vector, task: Task) -> bool:
    """Pick up what the policy left, by inverse kinematics; whether it hangs from the cup."""
    try:
        arm.move_joints(_over(target_m))
        _straight(arm, float(target_m[2]))
    except ObstructedError:
        _rise(arm, float(target_m[2]) + LIFT_M)
        return False
    return not _pick_up(arm, target_m, task)


def _carry(arm: SwiftArm, target_m: Vector, put_down: Callable[[Vector], Vector] | None) -> Vector:
    """Bring what hangs from the cup over the place where it goes, one that obstacles leave a way to; the place."""
    for places_left in reversed(range(1 if put_down is None else _PLACES)):
        place = target_m if put_down is None else put_down(target_m)
        try:
            arm.move_joints(_over(place))
            break
        except ObstructedError:
            if not places_left:
                raise
    return place


def _put_down(arm: SwiftArm, place_m: Vector) -> str:
    """Put what hangs from the cup down onto the place below it; a remark if it was lost on the way there."""
    lost = arm.pump_state() is not PumpState.HOLDING
    _straight(arm, float(place_m[2]))
    _let_go(arm, float(place_m[2]))
    return "the object was held after the lift and fell off on the way to where it goes" if lost else ""


def _over(place_m: Vector) -> list[float]:
    joints: list[float] = kinematics.inverse(place_m + np.array([0.0, 0.0, LIFT_M])).tolist()
    return joints


def _holds(arm: SwiftArm, seconds: float, *, soon: bool) -> bool:
    """Whether the cup is sealed at some time within ``seconds`` (``soon``), or all the time."""
    end_s = arm.time_s() + seconds
    while True:
        if (arm.pump_state() is PumpState.HOLDING) is soon:
            return soon
        if arm.time_s() >= end_s:
            return not soon
        arm.rest(_LOOK_S)


def _cup(arm: SwiftArm) -> Vector:
    return kinematics.cup_position(arm.read_joints())


def _straight(arm: SwiftArm, height_m: float, radius_m: float | None = None) -> None:
    """Move the cup straight up or down to ``height_m``, or slantwise to a radius too."""
    start = _cup(arm)
    stretch = 1.0 if radius_m is None else radius_m / math.hypot(start[0], start[1])
    goal = np.array([stretch * start[0], stretch * start[1], height_m])
    pieces = max(1, math.ceil(math.dist(start, goal) / _PIECE_M))
    for share in np.linspace(0.0, 1.0, pieces + 1)[1:].tolist():
        arm.move_joints(kinematics.inverse(start + share * (goal - start)).tolist())


def _rise(arm: SwiftArm, height_m: float) -> None:
    """Move the cup up to ``height_m``, and where the arm cannot go straight up, towards the middle of its range."""
    x, y, z = _cup(arm).tolist()
    if z < height_m:
        radius_m = math.hypot(x, y)
        straight = kinematics.reachable((x, y, height_m), positions.MARGIN_RAD)
        try:
            _straight(arm, height_m, None if straight else min(max(radius_m, _MIDDLE_M[0]), _MIDDLE_M[1]))
        except (kinematics.UnreachableError, UnsafeCommandError):  # in the farthest corners that line leaves the arm's range
            arm.home()
