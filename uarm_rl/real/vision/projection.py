"""From a pixel to the arm and back, through the paper's four coordinate systems.

1. *pixel* (u right, v down, the first pixel's centre at 0, 0)
2. *image plane* without lens distortion, at distance 1 from the lens
3. *camera* (x right, y down, z along the view; OpenCV's convention)
4. *cup* (origin at the cup's tip, x forward along the arm, z up; it turns with joint1 alone, because link4 stays level),
   and through the joints *base* (see ``kinematics``)

One pixel is a ray, not a point: a position needs the height at which the object is seen. Pure functions, metres and
radians. ``joints_rad`` is joint1..joint3 at the moment of the picture.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike

from uarm_rl import checks
from uarm_rl.real.vision.camera_model import Array, Calibration
from uarm_rl.task import kinematics


def base_from_cup(joints_rad: Sequence[float] | Array) -> Array:
    """The cup's frame in the base frame: a rigid transform, shape (4, 4)."""
    joint1 = float(joints_rad[0])
    transform = np.eye(4)
    transform[:2, :2] = [[math.cos(joint1), -math.sin(joint1)], [math.sin(joint1), math.cos(joint1)]]
    transform[:3, 3] = kinematics.cup_position(joints_rad)
    return transform


def base_from_camera(joints_rad: Sequence[float] | Array, calibration: Calibration) -> Array:
    """The camera's frame in the base frame: a rigid transform, shape (4, 4)."""
    transform: Array = base_from_cup(joints_rad) @ calibration.cup_from_camera
    return transform


def pixel_to_base(pixel: ArrayLike, joints_rad: Sequence[float] | Array, calibration: Calibration, height_m: float) -> Array:
    """Where the ray through ``pixel`` meets the plane z = ``height_m`` of the base frame, shape (3,).

    Raises :class:`ValueError` if the ray never meets it: the plane is not below the camera, or the ray does not go down.
    """
    plane = calibration.lens.image_plane(pixel)[0]
    transform = base_from_camera(joints_rad, calibration)
    origin = transform[:3, 3]
    direction = transform[:3, :3] @ np.array([plane[0], plane[1], 1.0])
    distance = (height_m - origin[2]) / direction[2] if direction[2] else math.inf
    if not (direction[2] < 0.0 < distance < math.inf):
        u, v = np.asarray(pixel, dtype=np.float64).ravel()
        raise ValueError(
            f"the ray through pixel ({u:.1f}, {v:.1f}) never meets the height {1000.0 * height_m:.1f} mm: the camera is at "
            f"{1000.0 * origin[2]:.1f} mm; check the object's height, the pose of the arm and the calibration"
        )
    point: Array = origin + distance * direction
    return point


# A box, seen from above at an angle, shows side faces too, and they pull the centre of its outline 1 to 5 mm away from
# the centre of its top. So the whole outline is explained: a box of known size is put where its outline fits best.

_DIRECTIONS: Final[Array] = np.stack(
    [np.cos(angles := np.linspace(0.0, 2.0 * math.pi, 72, endpoint=False)), np.sin(angles)], axis=1
)
_FIT_STEPS: Final = 8
_NUDGES: Final = (1e-4, 1e-4, 1e-3)  # m, m, rad: steps of the numerical derivative


@dataclass(frozen=True, eq=False)
class Box:
    """Where a box stands.

    ``misfit_px`` is the RMS distance between its outline and the one seen, an even difference all around left out. It is
    0.3 to 0.6 px for a box seen whole; with 2 px and more it is another shape, or partly hidden or in shadow, and its
    place may be wrong by millimetres. ``scale`` is that even difference: how many times as wide as a box of the told size
    what is seen is, 1 but for what thresholds add or take at its edge.
    """

    top_m: Array  # centre of the upper surface, shape (3,), base frame
    yaw_rad: float  # from the base's x to the box's; within a quarter turn if its base is square, else a half turn
    misfit_px: float
    scale: float


def locate_box(
    outline_px: ArrayLike,
    joints_rad: Sequence[float] | Array,
    calibration: Calibration,
    size_m: Sequence[float] = (0.03, 0.03, 0.03),
    table_m: float = 0.0,
) -> Box:
    """The box (length, width, height) standing at height ``table_m`` whose outline is ``outline_px``, shape (n >= 3, 2).

    The outline is either that of everything seen of the box or that of its upper surface alone (a coloured top, or
    sides too dark for the colour's range); what fits better is taken. It may be a little too wide or too narrow all
    around, as thresholds make it. Raises :class:`ValueError` if no such box can be in view.
    """
    length, width, height = (checks.number("size_m", float(side), low=0.0, open_low=True) for side in size_m)
    focal_px = float(calibration.lens.camera_matrix[0, 0])
    seen = focal_px * calibration.lens.image_plane(outline_px)
    if len(seen) < 3:
        raise ValueError(f"an outline needs at least 3 points, got {len(seen)}")
    seen_reach = (seen @ _DIRECTIONS.T).max(axis=0)
    middle = _middle_px(np.asarray(outline_px, dtype=np.float64).reshape(-1, 2))
    start = pixel_to_base(middle, joints_rad, calibration, table_m + height)
    square = length == width
    top = 0.5 * np.array([[x * length, y * width, 0.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    whole = np.concatenate([top, top - [0.0, 0.0, height]])
    transform = base_from_camera(joints_rad, calibration)

    def reach(corners: Array, place: Array) -> Array:
        """How far the outline of the placed corners reaches into each direction, in pixels."""
        cos, sin = math.cos(place[2]), math.sin(place[2])
        x, y, z = corners.T
        placed = np.stack([place[0] + cos * x - sin * y, place[1] + sin * x + cos * y, z + table_m + height], axis=1)
        camera = (placed - transform[:3, 3]) @ transform[:3, :3]
        if not (camera[:, 2] > 0.0).all():
            return np.full(len(_DIRECTIONS), np.inf)
        reaches: Array = (focal_px * camera[:, :2] / camera[:, 2:] @ _DIRECTIONS.T).max(axis=0)
        return reaches

    def misfit(corners: Array, place: Array) -> tuple[float, Array]:
        off = seen_reach - reach(corners, place)
        off -= off.mean() if np.isfinite(off).all() else 0.0
        return float(np.sqrt(np.mean(off**2))), off

    best, best_misfit, scale = None, math.inf, math.nan
    for corners in (whole, top):
        for yaw in np.arange(0.0, math.pi / 2.0 if square else math.pi, math.pi / 8.0):
            place = np.array([start[0], start[1], yaw])
            error, off = misfit(corners, place)
            for _ in range(_FIT_STEPS):  # Gauss-Newton
                slopes = np.stack([(misfit(corners, place + nudge)[1] - off) / nudge.sum() for nudge in np.diag(_NUDGES)], 1)
                if not np.isfinite(slopes).all():
                    break
                step = np.linalg.lstsq(slopes, -off, rcond=None)[0]
                nearer = misfit(corners, place + step)
                if not nearer[0] < error - 1e-9:
                    break
                place, (error, off) = place + step, nearer
            if error < best_misfit:
                best, best_misfit, scale = place, error, float(seen_reach.mean() / reach(corners, place).mean())
    if best is None:
        raise ValueError(
            f"a box of {_sizes_mm(size_m)} mm on a table at {1000.0 * table_m:.1f} mm cannot be in view of the camera at "
            f"{1000.0 * transform[2, 3]:.1f} mm; check the object's size and the pose of the arm"
        )
    x_m, y_m, yaw_rad = best.tolist()
    return Box(np.array([x_m, y_m, table_m + height]), yaw_rad % (math.pi / 2.0 if square else math.pi), best_misfit, scale)


def _sizes_mm(size_m: Sequence[float]) -> str:
    return " x ".join(f"{1000.0 * side:g}" for side in size_m)


def _middle_px(outline_px: Array) -> Array:
    moments: dict[str, Any] = dict(cv2.moments(cv2.convexHull(outline_px.astype(np.float32))))
    if moments["m00"] > 0.0:
        return np.array([moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]])
    middle: Array = outline_px.mean(axis=0)
    return middle


_RADII_M: Final = np.arange(0.12, kinematics.REACH_M, 0.002)
_LIMIT_MARGIN_RAD: Final = 0.02


def look_at(
    point_m: Sequence[float] | Array, calibration: Calibration, cup_height_m: float, pixel: ArrayLike | None = None
) -> Array:
    """Joints (shape (3,)) with the cup at ``cup_height_m`` that bring ``point_m`` to ``pixel`` (default: the middle), or near.

    The camera sits ahead of the cup, so a point close to the base comes only as near to the pixel as the arm can draw
    the cup back. Raises :class:`kinematics.UnreachableError` if the cup cannot be at that height at all, or not turned so,
    and :class:`ValueError` if the point is not below the camera there.
    """
    x, y, z = (float(value) for value in point_m)
    to_cup = calibration.cup_from_camera
    aim = (np.array(calibration.lens.image_size) - 1.0) / 2.0 if pixel is None else pixel
    direction = to_cup[:3, :3] @ [*calibration.lens.image_plane(aim)[0], 1.0]
    drop = (z - cup_height_m - to_cup[2, 3]) / direction[2]
    if not 0.0 < drop < math.inf:
        raise ValueError(
            f"a point at {1000.0 * z:.0f} mm is not below the camera when the cup is at {1000.0 * cup_height_m:.0f} mm"
        )
    ahead, aside = (to_cup[:3, 3] + drop * direction)[:2].tolist()  # where the ray ends, seen from the cup
    distance = max(math.hypot(x, y), abs(aside))
    wanted = math.sqrt(distance**2 - aside**2) - ahead
    turn = math.atan2(y, x) - (math.asin(aside / distance) if distance else 0.0)
    for radius in sorted(_RADII_M.tolist(), key=lambda radius: abs(radius - wanted)):
        cup = (radius * math.cos(turn), radius * math.sin(turn), cup_height_m)
        if kinematics.reachable(cup, _LIMIT_MARGIN_RAD):
            return kinematics.inverse(cup)
    raise kinematics.UnreachableError(
        f"no pose with the cup at {1000.0 * cup_height_m:.0f} mm looks at ({1000.0 * x:.0f}, {1000.0 * y:.0f}, "
        f"{1000.0 * z:.0f}) mm; choose another height, or put the object in front of the arm"
    )
