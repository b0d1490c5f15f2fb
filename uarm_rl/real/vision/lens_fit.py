"""The lens from pictures of a printed board that is held tilted.

Pictures from straight above fit perfectly and give a focal length that is 30 % wrong, so such sets are refused. The report
is text for the terminal.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np

from uarm_rl import checks
from uarm_rl.real.vision.camera_model import Array, CalibrationError, Intrinsics, Picture


@dataclass(frozen=True)
class Board:
    """A printed board. A chessboard has ``columns`` x ``rows`` inner corners; a ChArUco board (``marker_m`` given) squares.

    ``square_m`` and ``marker_m`` are sides, measured on the print.
    """

    columns: int = 9
    rows: int = 6
    square_m: float = 0.012
    marker_m: float | None = None
    dictionary: str = "5X5_100"

    def __post_init__(self) -> None:
        checks.integer("columns", self.columns, low=3, high=50)
        checks.integer("rows", self.rows, low=3, high=50)
        checks.number("square_m", self.square_m, low=0.0, high=1.0, open_low=True)
        if self.marker_m is not None:
            checks.number("marker_m", self.marker_m, low=0.0, high=self.square_m, open_low=True)
        if not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
            raise ValueError(f"there is no marker family {self.dictionary!r}; a name is for example 5X5_100")

    def corners(self, image: Picture) -> tuple[Array, Array] | None:
        """Corners found in a BGR picture: on the board (m, shape (n, 3)) and in the picture (px, (n, 2)); None if too few."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if self.marker_m is not None:
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
            board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, dictionary)
            corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
            if ids is None or len(ids) < _MIN_CORNERS:
                return None
            on_board, in_picture = board.matchImagePoints(corners, ids)  # type: ignore[call-overload]
            return _points(on_board, 3), _points(in_picture, 2)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        found, corners = cv2.findChessboardCornersSB(grey, (self.columns, self.rows), flags=flags)
        if not found:
            return None
        column, row = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        flat = np.stack([column.ravel(), row.ravel(), np.zeros(column.size)], axis=1).astype(np.float64)
        return self.square_m * flat, _points(corners, 2)


def _points(points: Any, width: int) -> Array:
    return np.asarray(points, dtype=np.float64).reshape(-1, width)


_MIN_CORNERS: Final = 8
MIN_PICTURES: Final = 10
_TILT_DEG: Final = 18.0
_MIN_TILTED: Final = 5
_MAX_RMS_PX: Final = 1.0
_MAX_FOCAL_ERROR: Final = 0.01


def calibrate_intrinsics(
    pictures: Sequence[Picture], board: Board, camera: str, names: Sequence[str] = ()
) -> tuple[Intrinsics, str]:
    """The lens from pictures (BGR, all of one size) of a board held at different tilts; and a report.

    ``camera`` and ``names`` (of the pictures) are for people. Tangential distortion and k3 stay zero: from so few points
    they would fit noise. Raises :class:`CalibrationError` if the pictures differ in size, if fewer than ten show the
    board, if they are not tilted enough to tell the focal length, or if the fit is bad.
    """
    names = list(names) or [f"picture {number}" for number in range(1, len(pictures) + 1)]
    sizes = {(image.shape[1], image.shape[0]) for image in pictures}
    if len(sizes) > 1:
        raise CalibrationError(f"the pictures have different sizes ({_sizes(sizes)}); take all with one setting of the camera")
    seen = [(name, corners) for name, image in zip(names, pictures, strict=True) if (corners := board.corners(image))]
    without = [name for name in names if name not in {name for name, _ in seen}]
    if len(seen) < MIN_PICTURES:
        raise CalibrationError(
            f"the whole board was found in {len(seen)} of {len(pictures)} pictures; at least {MIN_PICTURES} are needed (15 are "
            "better), sharp, evenly lit and with the white margin around the board; check the board's columns and rows too"
        )
    size = sizes.pop()
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    rms, matrix, distortion, turns, _, deviations, _, errors = cv2.calibrateCameraExtended(  # type: ignore[call-overload]
        [on_board.astype(np.float32) for _, (on_board, _) in seen],
        [in_picture.astype(np.float32) for _, (_, in_picture) in seen],
        size,
        None,
        None,
        flags=flags,
    )
    tilts_deg = np.degrees([math.acos(min(1.0, abs(cv2.Rodrigues(turn)[0][2, 2]))) for turn in turns])
    focal_error = float(np.max(deviations.ravel()[:2] / matrix[[0, 1], [0, 1]]))
    corners_px = np.concatenate([in_picture for _, (_, in_picture) in seen])
    covered = np.ptp(corners_px, axis=0) / np.array(size)
    report = _lens_report(seen, without, errors.ravel(), tilts_deg, rms, matrix, distortion.ravel(), focal_error, covered)
    tilted = int((tilts_deg >= _TILT_DEG).sum())
    if tilted < _MIN_TILTED:
        raise CalibrationError(
            f"the board is tilted by {_TILT_DEG:g} degrees or more in {tilted} pictures and at least {_MIN_TILTED} are needed: "
            "pictures from straight above fit well and tell a wrong focal length; hold the board tilted by 20 to 40 degrees "
            "to all sides"
        )
    if not focal_error <= _MAX_FOCAL_ERROR:
        raise CalibrationError(
            f"the pictures tell the focal length to {100.0 * focal_error:.1f} % only (needed: {100.0 * _MAX_FOCAL_ERROR:g} %); "
            "hold the board tilted by 20 to 40 degrees to all sides, also in the corners of the picture"
        )
    if not rms <= _MAX_RMS_PX:
        raise CalibrationError(
            f"the pictures do not fit one lens: the corners are off by {rms:.2f} px (RMS, allowed {_MAX_RMS_PX:g}); check the "
            f"board's columns and rows, that it is flat, and take blurred pictures out (worst: {seen[int(errors.argmax())][0]})"
        )
    today = datetime.date.today().isoformat()
    return Intrinsics(camera, today, size, np.asarray(matrix, np.float64), distortion.ravel()[:5], float(rms)), report


def _lens_report(
    seen: Sequence[tuple[str, tuple[Array, Array]]],
    without: Sequence[str],
    errors_px: Array,
    tilts_deg: Array,
    rms_px: float,
    matrix: Array,
    distortion: Array,
    focal_error: float,
    covered: Array,
) -> str:
    lines = [f"board found in {len(seen)} pictures" + (f", not found in {', '.join(without)}" if without else "")]
    for (name, (corners, _)), error_px, tilt_deg in zip(seen, errors_px.tolist(), tilts_deg.tolist(), strict=True):
        mark = "  <- worse than the others: take it again" if error_px > 3.0 * np.median(errors_px) else ""
        lines.append(f"  {name}: {len(corners)} corners, {error_px:.2f} px, tilted by {tilt_deg:.0f} degrees{mark}")
    lines += [
        f"RMS {rms_px:.2f} px",
        f"focal length {matrix[0, 0]:.1f}, {matrix[1, 1]:.1f} px, known to {100.0 * focal_error:.2f} %",
        f"middle {matrix[0, 2]:.1f}, {matrix[1, 2]:.1f} px; distortion k1 {distortion[0]:.3f}, k2 {distortion[1]:.3f}",
        f"the corners cover {100.0 * covered[0]:.0f} % of the width and {100.0 * covered[1]:.0f} % of the height",
    ]
    if covered.min() < _MIN_COVERED:
        lines.append("  <- the edges of the picture are not covered, where distortion is largest: bring the board there too")
    return "\n".join(lines)


_MIN_COVERED: Final = 0.8


def _sizes(sizes: set[tuple[int, int]]) -> str:
    return ", ".join(f"{width} x {height}" for width, height in sorted(sizes))
