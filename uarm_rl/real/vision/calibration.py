"""Lens and mount of the camera: two fits, and the file that keeps what they found.

**The lens** (``calibrate_intrinsics``) is found from pictures of a printed board that is held tilted. Pictures from
straight above fit perfectly and give a focal length that is 30 % wrong, so such sets are refused.

**The mount** (``calibrate_hand_eye``) is the camera's place at the cup. Marks are touched with the cup, which makes them
known in the base frame, and photographed from several poses and heights. In the cup's frame at the moment of each
picture all of them together are one cloud of known points with known pixels: one stacked perspective-n-point problem.

The usual hand-eye methods (AX = XB: Tsai, Park, Horaud, Andreff, Daniilidis) are not offered. They need rotations about
two axes, and this arm turns its camera about the vertical alone: how high the camera sits is then not determined at
all, and implementations answer with errors of 20 degrees or of metres, without complaint. Touching closes that gap.

``collecting`` gathers the pictures and touches, from files or live. Reports are text for the terminal.
"""

from __future__ import annotations

import datetime
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks, files
from uarm_rl.real.vision import projection

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

_FORMAT: Final = "uarm-rl camera 1"


class CalibrationError(Exception):
    """A calibration that cannot be made or used; the message is a sentence with the remedy."""


# What is kept


@dataclass(frozen=True)
class Observation:
    """A mark that the cup touched, seen in a picture."""

    pixel_px: tuple[float, float]  # (u, v)
    joints_rad: tuple[float, float, float]  # joint1..joint3 at the moment of the picture
    touch_m: tuple[float, float, float]  # where the cup's tip was when it touched the mark, base frame


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """The lens, for pictures of one size. Constructing one checks that it can be that of a camera."""

    camera: str  # which camera this is, for people
    created: str  # ISO date
    image_size: tuple[int, int]  # width, height in pixels
    camera_matrix: Array  # (3, 3), OpenCV's convention: the first pixel's centre is at 0, 0
    distortion: Array  # (5,): k1, k2, p1, p2, k3 of OpenCV
    intrinsics_rms_px: float  # how well the lens explains the pictures of the board

    def __post_init__(self) -> None:
        self._check_date()
        width, height = self.image_size
        if not (8 <= width <= 20000 and 8 <= height <= 20000):
            raise CalibrationError(f"the calibration is for pictures of {width} x {height} pixels, which no camera takes")
        for name, shape in (("camera_matrix", (3, 3)), ("distortion", (5,))):
            _check_array(name, getattr(self, name), shape)
        (fx, skew, cx), (zero, fy, cy), last = self.camera_matrix.tolist()
        if not (fx > 0.0 and fy > 0.0 and skew == zero == 0.0 and last == [0.0, 0.0, 1.0]):
            raise CalibrationError(f"camera_matrix {self.camera_matrix.tolist()} is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        if not (0.0 <= cx < width and 0.0 <= cy < height):
            raise CalibrationError(f"camera_matrix puts the middle of the lens at ({cx:g}, {cy:g}), outside the picture")
        _check_error("intrinsics_rms_px", self.intrinsics_rms_px)
        self._check_distortion()

    def _check_date(self) -> None:
        try:
            datetime.date.fromisoformat(self.created)
        except (TypeError, ValueError) as error:
            raise CalibrationError(f"created must be a date like 2025-01-31, got {self.created!r}") from error

    def _check_distortion(self) -> None:
        """Refuse a lens that folds the picture over itself: there a pixel would have no ray of its own."""
        width, height = self.image_size
        u, v = np.meshgrid(np.linspace(0.0, width - 1.0, 17), np.linspace(0.0, height - 1.0, 13))
        pixels = np.stack([u.ravel(), v.ravel()], axis=1)
        with np.errstate(all="ignore"):
            plane = projection.image_plane_from_pixel(pixels, self)
            rays = np.column_stack([plane, np.ones(len(plane))])
            back = projection.pixel_from_camera(rays, self) if np.isfinite(rays).all() else np.full_like(pixels, np.inf)
        if not np.abs(back - pixels).max() < 0.01:
            raise CalibrationError(
                "the lens distortion folds the edge of the picture over itself; calibrate the lens again, with the board also "
                "in the corners of the pictures"
            )

    def check_size(self, image: Picture) -> None:
        """Raise :class:`CalibrationError` unless the picture (h, w, 3) has the size that the calibration is for."""
        height, width = image.shape[:2]
        if (width, height) != self.image_size:
            raise CalibrationError(
                f"the picture has {width} x {height} pixels but the calibration of {self.camera!r} is for "
                f"{self.image_size[0]} x {self.image_size[1]}; set the camera to that size, or calibrate at the new one"
            )

    def age_days(self, today: datetime.date | None = None) -> int:
        """Days since the calibration was made."""
        return ((today or datetime.date.today()) - datetime.date.fromisoformat(self.created)).days

    def save(self, path: Path) -> None:
        """Write a JSON file, replacing an old one whole."""
        content = {"format": _FORMAT, "kind": type(self).__name__.lower()}
        content |= {field.name: _plain(getattr(self, field.name)) for field in fields(self)}
        text = json.dumps(content, indent=1)
        text = re.sub(r"\[[^][]*\]", lambda row: re.sub(r"\s+", " ", row[0]), text)  # one line per row of numbers
        path.parent.mkdir(parents=True, exist_ok=True)
        files.replace(path, text.encode() + b"\n")

    @classmethod
    def load(cls: type[_Kind], path: Path) -> _Kind:
        """Read a file that ``save`` wrote; :class:`CalibrationError` if it is missing, damaged or of the other kind."""
        content = _read(path, cls.__name__.lower())
        try:
            return cls(**_parse(content))
        except CalibrationError as error:
            raise CalibrationError(f"{path} cannot be used: {error}") from error
        except (TypeError, ValueError, KeyError) as error:
            raise CalibrationError(
                f"{path} is damaged ({error}); put back a copy, or run uarm-rl calibrate-camera and calibrate-hand-eye again"
            ) from error


_Kind = TypeVar("_Kind", bound=Intrinsics)


@dataclass(frozen=True, eq=False)
class Calibration(Intrinsics):
    """Lens and mount. ``created`` is the mount's date; the residuals are horizontal distances at the marks' height."""

    cup_from_camera: Array  # (4, 4): the camera's frame in the cup's (see ``projection``)
    intrinsics_created: str  # ISO date
    residual_mm: float  # RMS over all observations, 0 if the mount is not measured
    held_out_mm: float  # RMS where every mark is predicted by a fit without it
    observations: tuple[Observation, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_array("cup_from_camera", self.cup_from_camera, (4, 4))
        rotation = self.cup_from_camera[:3, :3]
        if (
            not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
            or np.linalg.det(rotation) < 0.0
            or self.cup_from_camera[3].tolist() != [0.0, 0.0, 0.0, 1.0]
        ):
            raise CalibrationError("cup_from_camera is not a rotation with a translation")
        _check_error("residual_mm", self.residual_mm)
        _check_error("held_out_mm", self.held_out_mm)
        if np.linalg.norm(self.cup_from_camera[:3, 3]) > _MAX_MOUNT_M:
            raise CalibrationError(
                f"cup_from_camera puts the camera {1000.0 * np.linalg.norm(self.cup_from_camera[:3, 3]):.0f} mm from the cup; "
                f"it is mounted within {1000.0 * _MAX_MOUNT_M:.0f} mm"
            )
        if self.cup_from_camera[2, 2] > _MIN_DOWN:
            raise CalibrationError("cup_from_camera has the camera look sideways or up; it must look down at the table")


_MAX_MOUNT_M: Final = 0.3
_MIN_DOWN: Final = -math.cos(math.radians(60.0))


def _check_array(name: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape or not np.isfinite(array).all():
        raise CalibrationError(f"{name} must be finite numbers of shape {shape}, got {array.tolist()}")


def _check_error(name: str, value: float) -> None:
    try:
        checks.number(name, value, low=0.0)
    except ValueError as error:
        raise CalibrationError(str(error)) from error


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Observation):
        return [*value.pixel_px, *value.joints_rad, *value.touch_m]
    return value


def _parse(content: dict[str, Any]) -> dict[str, Any]:
    for name in ("camera_matrix", "distortion", "cup_from_camera"):
        if name in content:
            content[name] = np.array(content[name], dtype=np.float64)
    width, height = content["image_size"]
    content["image_size"] = checks.integer("image_size", width, low=1), checks.integer("image_size", height, low=1)
    if "observations" in content:
        rows = np.array(content["observations"], dtype=np.float64).reshape(-1, 8).tolist()
        content["observations"] = tuple(
            Observation((u, v), (first, second, third), (x, y, z)) for u, v, first, second, third, x, y, z in rows
        )
    return content


def _read(path: Path, kind: str) -> dict[str, Any]:
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise CalibrationError(
            f"the calibration file {path} cannot be read ({error.strerror}); make one with uarm-rl calibrate-camera and "
            "uarm-rl calibrate-hand-eye, or name another"
        ) from error
    except ValueError as error:
        raise CalibrationError(f"{path} is damaged or no calibration file ({error}); calibrate again") from error
    if not isinstance(content, dict) or content.pop("format", None) != _FORMAT:
        raise CalibrationError(f"{path} is no calibration file of this version ({_FORMAT}); calibrate again")
    found = content.pop("kind", None)
    if found != kind:
        missing = "the lens alone; run uarm-rl calibrate-hand-eye with it and use the file that this writes"
        whole = f"{found!r} where {kind!r} is needed; name the file that uarm-rl calibrate-camera wrote"
        raise CalibrationError(f"{path} holds {missing if (found, kind) == ('intrinsics', 'calibration') else whole}")
    return content


# What is known without a measurement

#: OV7725 of the OpenMV M7 and H7 behind the 2.8 mm lens: pixels of 6 um at 640 x 480.
_FOCAL_PER_WIDTH: Final = 2.8 / (0.006 * 640)
#: Assumed: the order of magnitude for such a wide lens. No published calibration of this lens was found.
_DISTORTION: Final = (-0.33, 0.11, 0.0, 0.0, 0.0)
#: UFACTORY's mount: ahead of the cup, to its left, above its tip. From the constants of UFACTORY's vision demo and a
#: third party's measurement, which agree within 0.6 mm.
_MOUNT_M: Final = (0.0695, 0.015, 0.037)
#: The picture's top is forward and its left is left: x of the camera is -y of the cup, y is -x, z is down.
_LOOKING_DOWN: Final = ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
_NOMINAL_DATE: Final = "1970-01-01"  # very old, as it is not a calibration


def nominal_intrinsics(image_size: tuple[int, int] = (320, 240)) -> Intrinsics:
    """What the data sheets say about the OpenMV's lens, with an assumed distortion."""
    width, height = image_size
    focal = _FOCAL_PER_WIDTH * width
    matrix = np.array([[focal, 0.0, (width - 1) / 2.0], [0.0, focal, (height - 1) / 2.0], [0.0, 0.0, 1.0]])
    return Intrinsics("nominal", _NOMINAL_DATE, (width, height), matrix, np.array(_DISTORTION), 0.0)


def nominal(image_size: tuple[int, int] = (320, 240)) -> Calibration:
    """The OpenMV on UFACTORY's mount as drawn: good to a centimetre or so, a first guess for a calibration."""
    mount = np.eye(4)
    mount[:3, :3] = _LOOKING_DOWN
    mount[:3, 3] = _MOUNT_M
    return _mounted(nominal_intrinsics(image_size), mount, _NOMINAL_DATE)


def _mounted(
    intrinsics: Intrinsics,
    cup_from_camera: Array,
    created: str,
    residual_mm: float = 0.0,
    held_out_mm: float = 0.0,
    observations: tuple[Observation, ...] = (),
) -> Calibration:
    return Calibration(
        camera=intrinsics.camera,
        created=created,
        image_size=intrinsics.image_size,
        camera_matrix=intrinsics.camera_matrix,
        distortion=intrinsics.distortion,
        intrinsics_rms_px=intrinsics.intrinsics_rms_px,
        cup_from_camera=cup_from_camera,
        intrinsics_created=intrinsics.created,
        residual_mm=residual_mm,
        held_out_mm=held_out_mm,
        observations=observations,
    )


# The lens


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


# The mount

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
    plane = projection.image_plane_from_pixel(pixels, intrinsics)
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
    calibration = _mounted(intrinsics, mount, today, residual_mm, held_out_rms_mm, observations)
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
    plane = projection.image_plane_from_pixel(mirrored, intrinsics)
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
    test_plane = projection.image_plane_from_pixel(corners, intrinsics)

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
