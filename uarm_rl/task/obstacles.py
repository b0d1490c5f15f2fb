"""Boxes that stand in the way, and how near the arm comes to them: all of it, not only the cup.

The arm is a few capsules around the axes of its links, wide enough for what moves with them: rods, motors, hand, camera. The
suction hose, which hangs free and gives, is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from uarm_rl import checks
from uarm_rl.task import kinematics
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.positions import APPROACH_HEIGHT_M

_BASE_M: Final = 0.094  # radius: half the diagonal of the base's square footprint; the turret's motors are nearer
_BASE_TOP_M: Final = 0.075  # of the axis, so that the motors are in the dome above it
_LIMB_M: Final = 0.058  # the lower arm with the rods behind it, the forearm with the one above it
_HAND_M: Final = 0.055
_CUP_M: Final = 0.012
_CAMERA_M: Final = 0.03
_CAMERA_AHEAD_M: Final = 0.075  # of the cup, on UFACTORY's mount
_CAMERA_BELOW_M: Final = 0.03  # the wrist
_RADII: Final[Vector] = np.array([_BASE_M, _LIMB_M, _LIMB_M, _HAND_M, _CUP_M, _CAMERA_M])
_CUP_END: Final = 4  # the axis that ends in the cup's lip
_NOTHING: Final = 1e-12
#: No part of the arm moves farther than so much (m) while joint1, joint2 or joint3 turns by a radian.
_LEVERS_M: Final[Vector] = np.array([0.48, 0.43, 0.29])


Size = tuple[float, float, float]


class Box(NamedTuple):
    """A box whose sides are parallel to the axes of the base frame; metres."""

    centre_m: tuple[float, float, float]
    size_m: tuple[float, float, float]

    def __str__(self) -> str:
        place, size = (", ".join(f"{1000.0 * value:g}" for value in values) for values in self)
        return f"the obstacle of ({size}) mm at ({place}) mm"


def boxes(name: str, value: object) -> tuple[Box, ...]:
    """Boxes as a user gives them: six numbers (x, y, z of the centre and the three sides, m), or a list of such.

    Raises :class:`ValueError`, with the box, for what is none and for one that the arm's base stands in.
    """
    rows = [] if value is None else value
    if not isinstance(rows, Sequence) or isinstance(rows, str):
        raise ValueError(f"{name} must be six numbers, x y z and the three sides in metres, or a list of such; got {value!r}")
    if rows and not isinstance(rows[0], Sequence):
        rows = [rows]
    return tuple(_box(f"{name}[{number}]" if len(rows) > 1 else name, row) for number, row in enumerate(rows))


def _box(name: str, row: object) -> Box:
    x, y, z, *size = checks.numbers(name, row, (0.2, 0.1, 0.05, 0.03, 0.03, 0.1), "x y z and the three sides, in metres")
    for side in size:
        checks.number(f"each side of {name}", side, low=0.0, high=2.0, open_low=True)
    box = Box((x, y, z), (size[0], size[1], size[2]))
    aside = [max(0.0, abs(at) - side / 2.0) for at, side in zip(box.centre_m[:2], box.size_m[:2], strict=True)]
    if math.hypot(*aside) < _BASE_M and z - size[2] / 2.0 < _BASE_TOP_M + _BASE_M:
        raise ValueError(f"{name}: {box} stands where the arm's base is; keep {1000.0 * _BASE_M:g} mm from its axis")
    return box


def clearances_m(joints_rad: Vector, obstacles: Sequence[Box], carried_m: Size | None = None) -> Vector:
    """How near the arm is to the nearest obstacle in each of the poses, shape (n, 3); shape (n,), below 0 inside it.

    ``carried_m``: length, width and height of what hangs from the cup, as the sphere around it, and is a part of the arm.
    """
    starts, ends = _axes(joints_rad)
    radii = _RADII
    if carried_m:
        below = (ends[:, _CUP_END] - (0.0, 0.0, carried_m[2] / 2.0))[:, np.newaxis]
        starts, ends = np.concatenate([starts, below], axis=1), np.concatenate([ends, below], axis=1)
        radii = np.append(radii, math.hypot(*carried_m) / 2.0)
    centres, sizes = (np.array(each) for each in zip(*obstacles, strict=True))
    low, high = centres - sizes / 2.0, centres + sizes / 2.0
    start, along = starts[:, :, np.newaxis], (ends - starts)[:, :, np.newaxis]
    # The squared distance to a box is convex along a straight line, and between the planes of its sides a parabola.
    steady = np.where(np.abs(along) < _NOTHING, _NOTHING, along)
    cuts = np.zeros((*starts.shape[:2], len(obstacles), 8))
    cuts[..., 1:4], cuts[..., 4:7], cuts[..., 7] = (low - start) / steady, (high - start) / steady, 1.0
    cuts = np.sort(np.minimum(np.maximum(cuts, 0.0), 1.0), axis=-1)

    def outside(share: Vector) -> Any:
        """How far points are beyond the sides, with signs, where each axis is gone along by a share of it."""
        point = start[..., np.newaxis, :] + share[..., np.newaxis] * along[..., np.newaxis, :]
        return np.maximum(0.0, point - high[:, np.newaxis]) - np.maximum(0.0, low[:, np.newaxis] - point)

    slopes = np.einsum("...ki,...i", outside(cuts), along)
    last = np.minimum(np.maximum((slopes <= 0.0).sum(axis=-1) - 1, 0), 6)
    at = np.arange(last.size).reshape(last.shape) * 8 + last
    left, right, falls, rises = cuts.flat[at], cuts.flat[at + 1], slopes.flat[at], slopes.flat[at + 1]
    share = falls / (falls - rises - _NOTHING)  # where the slope is nought between the two
    lowest = left + np.minimum(np.maximum(share, 0.0), 1.0) * (right - left)
    apart = outside(lowest[..., np.newaxis])[..., 0, :]
    nearest: Vector = (np.sqrt(np.einsum("...i,...i", apart, apart)) - radii[:, np.newaxis]).min(axis=(1, 2))
    return nearest


def leaves_room(
    top_m: Sequence[float] | Vector, obstacles: Sequence[Box], clearance_m: float, carried_m: Size | None = None
) -> bool:
    """Whether the cup can come straight down onto an upper surface there, from ``APPROACH_HEIGHT_M`` above, past the obstacles,
    and with ``carried_m`` (see :func:`clearances_m`) what hangs from it.

    Raises ``UnreachableError`` for a place that it cannot reach at all.
    """
    if not obstacles:
        return True
    x, y, z = (float(value) for value in top_m)
    way = [kinematics.inverse((x, y, z + rise_m)) for rise_m in (0.0, APPROACH_HEIGHT_M / 2.0, APPROACH_HEIGHT_M)]
    return bool(clearances_m(np.array(way), obstacles, carried_m).min() >= clearance_m)


def way_clearances_m(
    start_rad: Sequence[float],
    end_rad: Sequence[float],
    obstacles: Sequence[Box],
    step_rad: float,
    carried_m: Size | None = None,
) -> Vector:
    """How near the arm comes to an obstacle on a straight way in angles: where it starts, and in each of the pieces behind.

    Nothing in between comes nearer: what the arm can move within half a piece, of at most ``step_rad``, is taken off of all.
    """
    start, turn = np.array(start_rad), np.subtract(end_rad, start_rad)
    pieces = math.ceil(np.abs(turn).max() / step_rad) + 1
    poses = start + np.linspace(0.0, 1.0, pieces + 1)[:, np.newaxis] * turn
    near = clearances_m(poses, obstacles, carried_m)
    near[1:] = np.minimum(near[:-1], near[1:])
    within: Vector = near - float(np.abs(turn) @ _LEVERS_M) / pieces / 2.0
    return within


def _axes(joints_rad: Vector) -> tuple[Vector, Vector]:
    """Where the axes of the capsules begin and end, shape (n, 6, 3) each."""
    shoulder, elbow, wrist, cup = np.moveaxis(kinematics.forward_all(joints_rad), 1, 0)
    turn = joints_rad[:, 0]
    ahead = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))])
    hand = cup + (0.0, 0.0, kinematics.CUP_DOWN_M)
    under = hand - (0.0, 0.0, _CAMERA_BELOW_M)
    foot = np.zeros_like(cup)
    return (
        np.stack([foot, shoulder, elbow, wrist, hand, under], axis=1),
        np.stack([foot + (0.0, 0.0, _BASE_TOP_M), elbow, wrist, hand, cup, under + _CAMERA_AHEAD_M * ahead], axis=1),
    )
