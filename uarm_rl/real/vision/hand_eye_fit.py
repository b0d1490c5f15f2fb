"""The camera's place at the cup, from marks that the cup touched and the camera saw.

Touching makes the marks known in the base frame; they are photographed from several poses and heights. In the cup's frame
at the moment of each picture all of them together are one cloud of known points with known pixels: one stacked
perspective-n-point problem. The report is text for the terminal.

The usual hand-eye methods (AX = XB: Tsai, Park, Horaud, Andreff, Daniilidis) are not offered. They need rotations about
two axes, and this arm turns its camera about the vertical alone: how high the camera sits is then not determined at
all, and implementations answer with errors of 20 degrees or of metres, without complaint. Touching closes that gap.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from uarm_rl.real.vision import projection
from uarm_rl.real.vision.camera_model import Array, Calibration, CalibrationError, Intrinsics, Observation, nominal

MIN_OBSERVATIONS: Final = 12
MIN_MARKS: Final = 4
_MIN_HEIGHTS_M: Final = 0.03  # between the lowest and the highest view of a mark
_MIN_WIDTH_M: Final = 0.01  # RMS distance of the points from the line that comes nearest to them all
_MAX_EXPECTED_MM: Final = 4.0
_MAX_HELD_OUT_MM: Final = 5.0  # more misses the object
_OUTLIER_MM: Final = 4.0
_TOUCH_NOISE_MM: Final = 0.7  # per axis; not believed to be less, however well few touches fit
_TEST_DEPTHS_M: Final = (0.08, 0.2)  # below the cup: where objects will be


def calibrate_hand_eye(observations: Sequence[Observation], intrinsics: Intrinsics) -> tuple[Calibration, str]:
    """The camera's place at the cup from touched marks in pictures; and a report with residuals in millimetres.

    Take 6 or more marks, each seen from several poses at 3 heights: 40 to 80 observations. With touches good to 1 mm,
    positions are then right to about 1 mm in any pose. The *held-out* error predicts each mark by a fit that does not
    know it. Raises :class:`CalibrationError` if the observations cannot determine the mount or do not fit together.
    """
    observations = tuple(observations)
    points_m, pixels, marks = _cloud(observations, intrinsics)
    _check_cloud(observations, points_m, marks)
    plane = intrinsics.image_plane(pixels)
    mount = _solve(points_m, pixels, intrinsics)
    residuals_mm = _residuals_mm(plane, points_m, mount)
    held_out_mm = np.empty(len(observations))
    for mark in range(marks.max() + 1):
        kept = marks != mark
        without = _solve(points_m[kept], pixels[kept], intrinsics, mount)
        held_out_mm[~kept] = _residuals_mm(plane[~kept], points_m[~kept], without)
    residual_mm, held_out_rms_mm = _rms(residuals_mm), _rms(held_out_mm)
    outliers = [index for index, off in enumerate(held_out_mm) if not off <= max(_OUTLIER_MM, 3.0 * np.median(held_out_mm))]
    worst = ", ".join(f"{index + 1} ({held_out_mm[index]:.1f} mm)" for index in outliers)
    if not held_out_rms_mm <= _MAX_HELD_OUT_MM:
        raise CalibrationError(
            f"the observations do not fit together: a mark is predicted {held_out_rms_mm:.1f} mm off (RMS, held out; allowed "
            f"{_MAX_HELD_OUT_MM:g}); {_what_is_wrong(points_m, pixels, intrinsics, worst)}"
        )
    expected_mm = _expected_mm(plane, points_m, mount, marks, held_out_rms_mm, intrinsics)
    if not expected_mm <= _MAX_EXPECTED_MM:
        more = "add marks, poses near and far, and marks near the edges of the picture"
        raise CalibrationError(
            f"the observations leave positions uncertain by {expected_mm:.1f} mm (allowed {_MAX_EXPECTED_MM:g}); "
            + (f"repeat or take out the observations {worst}" if outliers else more)
        )
    today = datetime.date.today().isoformat()
    calibration = Calibration(intrinsics, today, mount, residual_mm, held_out_rms_mm, observations)
    forward, left, up = (1000.0 * mount[:3, 3]).tolist()
    report = [
        f"{len(observations)} observations of {marks.max() + 1} marks",
        f"camera {forward:.1f} mm ahead of the cup, {left:.1f} mm to its left, {up:.1f} mm above its tip, tilted by "
        f"{math.degrees(math.acos(min(1.0, -mount[2, 2]))):.1f} degrees",
        f"residual {residual_mm:.2f} mm RMS, {residuals_mm.max():.2f} mm at most",
        f"held out {held_out_rms_mm:.2f} mm RMS, {held_out_mm.max():.2f} mm at most (touching errors included)",
        f"expected error of a position: {expected_mm:.1f} mm or less over the picture",
    ]
    if outliers:
        report.append(f"observations to repeat or take out: {worst}")
    return calibration, "\n".join(report)


def _what_is_wrong(points_m: Array, pixels: Array, intrinsics: Intrinsics, worst: str) -> str:
    mirrored = np.column_stack([intrinsics.image_size[0] - 1 - pixels[:, 0], pixels[:, 1]])
    plane = intrinsics.image_plane(mirrored)
    if _rms(_residuals_mm(plane, points_m, _solve(points_m, mirrored, intrinsics))) <= _MAX_HELD_OUT_MM:
        return "the pictures are mirrored: switch that off in the camera"
    return (
        f"repeat or take out the observations {worst or 'that are wrong'}; if all are off, check the units, the lens's file "
        "and that the same mark was touched and seen"
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _cloud(observations: Sequence[Observation], intrinsics: Intrinsics) -> tuple[Array, Array, NDArray[np.int64]]:
    """Touched points in the cup's frame (n, 3), their pixels (n, 2), and the number of each one's mark (n,)."""
    width, height = intrinsics.image_size
    points, pixels = [], []
    for number, seen in enumerate(observations, start=1):
        values = np.array([*seen.pixel_px, *seen.joints_rad, *seen.touch_m])
        if not np.isfinite(values).all():
            raise CalibrationError(f"observation {number} has values that are not finite: {values.tolist()}; take it out")
        u, v = seen.pixel_px
        if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
            raise CalibrationError(
                f"observation {number} is at pixel ({u:g}, {v:g}), outside the {width} x {height} picture that the lens was "
                "calibrated for; use pictures of that size"
            )
        base_from_cup = projection.base_from_cup(seen.joints_rad)
        points.append(base_from_cup[:3, :3].T @ (np.array(seen.touch_m) - base_from_cup[:3, 3]))
        pixels.append(seen.pixel_px)
    touches = {touch: number for number, touch in enumerate(dict.fromkeys(seen.touch_m for seen in observations))}
    marks = np.array([touches[seen.touch_m] for seen in observations], dtype=np.int64)
    return np.array(points).reshape(-1, 3), np.array(pixels, dtype=np.float64).reshape(-1, 2), marks


def _check_cloud(observations: Sequence[Observation], points_m: Array, marks: NDArray[np.int64]) -> None:
    number = len(set(marks.tolist()))
    if len(observations) < MIN_OBSERVATIONS or number < MIN_MARKS:
        raise CalibrationError(
            f"{len(observations)} observations of {number} marks are too few; at least {MIN_OBSERVATIONS} of {MIN_MARKS} are "
            "needed, and 40 of 6 are better"
        )
    heights_m = float(np.ptp(points_m[:, 2]))
    if heights_m < _MIN_HEIGHTS_M:
        raise CalibrationError(
            f"all marks are seen from nearly the same height (they differ by {1000.0 * heights_m:.0f} mm, at least "
            f"{1000.0 * _MIN_HEIGHTS_M:.0f} mm are needed): the camera's height and tilt cannot be told apart; take pictures "
            "with the cup at 3 heights"
        )
    spread = points_m - points_m.mean(axis=0)
    widths_m = np.linalg.svd(spread, compute_uv=False) / math.sqrt(len(spread))
    if widths_m[1] < _MIN_WIDTH_M:
        raise CalibrationError(
            "all marks lie on one line as the camera sees them; take marks, or poses, that spread over the whole picture"
        )


def _solve(points_m: Array, pixels: Array, intrinsics: Intrinsics, guess: Array | None = None) -> Array:
    """The camera's frame in the cup's that projects the points onto their pixels best, shape (4, 4)."""
    best, best_off = None, math.inf
    for quarter in range(4) if guess is None else [0]:  # however the camera was screwed on
        start = nominal().cup_from_camera.copy() if guess is None else guess
        turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, quarter * math.pi / 2.0]))
        rotation = (start[:3, :3] @ turn).T
        vector, _ = cv2.Rodrigues(rotation)
        _, vector, shift = cv2.solvePnP(
            points_m,
            pixels,
            intrinsics.camera_matrix,
            intrinsics.distortion,
            vector,
            (-rotation @ start[:3, 3]).reshape(3, 1),
            useExtrinsicGuess=True,
            flags=cv2.SOLVEPNP_ITERATIVE,
        )
        rotation, _ = cv2.Rodrigues(vector)
        if not ((points_m @ rotation.T + shift.ravel())[:, 2] > 0.0).all():
            continue
        seen, _ = cv2.projectPoints(points_m, vector, shift, intrinsics.camera_matrix, intrinsics.distortion)
        off = _rms(np.asarray(seen).reshape(-1, 2) - pixels)
        if off < best_off:
            best, best_off = np.eye(4), off
            best[:3, :3] = rotation.T
            best[:3, 3] = -rotation.T @ shift.ravel()
    if best is None:
        raise CalibrationError(
            "no place of the camera explains the observations; check the order of marks and touches, and the units (metres, "
            "radians)"
        )
    return best


def _picks(plane: Array, heights_m: Array, mount: Array) -> Array:
    """Where rays through the image plane (n, 2) meet heights (n,) in the cup's frame: x and y, shape (n, 2)."""
    rays = np.column_stack([plane, np.ones(len(plane))]) @ mount[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (heights_m - mount[2, 3]) / rays[:, 2]
        picks: Array = mount[:2, 3] + along[:, None] * rays[:, :2]
    return np.where(along[:, None] > 0.0, picks, np.inf)


def _residuals_mm(plane: Array, points_m: Array, mount: Array) -> Array:
    off: Array = 1000.0 * np.linalg.norm(_picks(plane, points_m[:, 2], mount) - points_m[:, :2], axis=1)
    return off


def _expected_mm(
    plane: Array, points_m: Array, mount: Array, marks: NDArray[np.int64], error_mm: float, intrinsics: Intrinsics
) -> float:
    """RMS error of positions at the worst place of the picture's inner 80 %, by linear propagation of touching errors."""
    width, height = intrinsics.image_size
    corners = np.array([[x * (width - 1), y * (height - 1)] for x in (0.1, 0.5, 0.9) for y in (0.1, 0.5, 0.9)])
    test_plane = intrinsics.image_plane(corners)

    def slopes(plane: Array, heights_m: Array) -> Array:
        """How picks move with the mount's six coordinates, shape (n, 2, 6); m per m and m per rad."""
        columns = []
        for axis in range(6):
            moved = [_picks(plane, heights_m, _moved(mount, axis, step)) for step in (1e-5, -1e-5)]
            columns.append((moved[0] - moved[1]) / 2e-5)
        return np.stack(columns, axis=2)

    seen = slopes(plane, points_m[:, 2]).reshape(-1, 6)
    # One touch is an error of all observations of its mark, sideways and in height; the arm and the pixel add their own.
    higher = _picks(plane, points_m[:, 2] + 1e-5, mount) - _picks(plane, points_m[:, 2], mount)
    touch = np.concatenate([np.broadcast_to(-np.eye(2), (len(plane), 2, 2)), 1e5 * higher[:, :, None]], axis=2)
    solve = np.linalg.pinv(seen, rcond=1e-9)
    covariance = solve @ solve.T
    for mark in range(marks.max() + 1):
        effect = solve[:, np.repeat(marks == mark, 2)] @ touch[marks == mark].reshape(-1, 3)
        covariance += effect @ effect.T
    covariance *= max(error_mm / math.sqrt(2.0), _TOUCH_NOISE_MM) ** 2 / 2.0
    worst = 0.0
    for depth in _TEST_DEPTHS_M:
        test = slopes(test_plane, np.full(len(test_plane), -depth))
        worst = max(worst, float(np.einsum("nij,jk,nik->n", test, covariance, test).max()))
    return math.sqrt(worst)


def _moved(mount: Array, axis: int, step: float) -> Array:
    moved: Array = mount.copy()
    if axis < 3:
        moved[axis, 3] += step
    else:
        turn = np.zeros(3)
        turn[axis - 3] = step
        moved[:3, :3] = cv2.Rodrigues(turn)[0] @ mount[:3, :3]
    return moved
