"""What a calibrated camera is: its lens, its mount at the cup, and the file that keeps them.

``lens_fit`` and ``hand_eye_fit`` find them, ``projection`` uses them.
"""

from __future__ import annotations

import datetime
import json
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from uarm_rl import checks, files

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

_FORMAT: Final = "uarm-rl camera 1"
_MAX_MOUNT_M: Final = 0.3
_MIN_DOWN: Final = -math.cos(math.radians(60.0))
# Enough for 1e-9 px at the corner of a picture with the distortion of a wide lens; five, the default, leave 0.06 px.
_UNDISTORT: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
_STRAIGHT: Final = np.zeros(3)


class CalibrationError(Exception):
    """A calibration that cannot be made or used; the message is a sentence with the remedy."""


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
        _check_date(self.created)
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

    def _check_distortion(self) -> None:
        """Refuse a lens that folds the picture over itself: there a pixel would have no ray of its own."""
        width, height = self.image_size
        u, v = np.meshgrid(np.linspace(0.0, width - 1.0, 17), np.linspace(0.0, height - 1.0, 13))
        pixels = np.stack([u.ravel(), v.ravel()], axis=1)
        with np.errstate(all="ignore"):
            plane = self.image_plane(pixels)
            rays = np.column_stack([plane, np.ones(len(plane))])
            back = self.pixels(rays) if np.isfinite(rays).all() else np.full_like(pixels, np.inf)
        if not np.abs(back - pixels).max() < 0.01:
            raise CalibrationError(
                "the lens distortion folds the edge of the picture over itself; calibrate the lens again, with the board also "
                "in the corners of the pictures"
            )

    def image_plane(self, pixels: ArrayLike) -> Array:
        """Pixels, shape (n, 2), in the image plane at distance 1 without distortion, shape (n, 2)."""
        points = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        if not np.isfinite(points).all():
            raise ValueError(f"pixels must be finite numbers, got {points.reshape(-1, 2).tolist()}")
        undistorted = cv2.undistortPointsIter(points, self.camera_matrix, self.distortion, None, None, _UNDISTORT)  # type: ignore[call-overload]
        return np.asarray(undistorted, dtype=np.float64).reshape(-1, 2)

    def pixels(self, points_m: ArrayLike) -> Array:
        """Pixels, shape (n, 2), of points in the camera's frame, shape (n, 3); they must lie in front of the camera."""
        points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
        if not (points[:, 2] > 0.0).all():  # NaN fails
            raise ValueError("a point that is not in front of the camera has no pixel")
        pixels, _ = cv2.projectPoints(points, _STRAIGHT, _STRAIGHT, self.camera_matrix, self.distortion)
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)

    def check_size(self, image: Picture) -> None:
        """Raise :class:`CalibrationError` unless the picture (h, w, 3) has the size that the calibration is for."""
        height, width = image.shape[:2]
        if (width, height) != self.image_size:
            raise CalibrationError(
                f"the picture has {width} x {height} pixels but the calibration of {self.camera!r} is for "
                f"{self.image_size[0]} x {self.image_size[1]}; set the camera to that size, or calibrate at the new one"
            )

    def content(self) -> dict[str, Any]:
        """As plain values, to be written."""
        return {field.name: _plain(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Intrinsics:
        """From plain values. Raises :class:`CalibrationError`, or what Python raises for values of another kind."""
        values = {field.name: content[field.name] for field in fields(cls)}
        values |= {name: np.array(values[name], dtype=np.float64) for name in ("camera_matrix", "distortion")}
        width, height = values["image_size"]
        values["image_size"] = checks.integer("image_size", width, low=1), checks.integer("image_size", height, low=1)
        return cls(**values)

    def save(self, path: Path) -> None:
        """Write a JSON file, replacing an old one whole."""
        _save(path, "intrinsics", self.content())

    @classmethod
    def load(cls, path: Path) -> Intrinsics:
        """Read a file that ``save`` wrote; :class:`CalibrationError` if it is missing, damaged or of the other kind."""
        content = _read(path, "intrinsics")
        with _named(path):
            return cls.of(content)


@dataclass(frozen=True)
class Observation:
    """A mark that the cup touched, seen in a picture."""

    pixel_px: tuple[float, float]  # (u, v)
    joints_rad: tuple[float, float, float]  # joint1..joint3 at the moment of the picture
    touch_m: tuple[float, float, float]  # where the cup's tip was when it touched the mark, base frame


@dataclass(frozen=True, eq=False)
class Calibration:
    """A lens and where it is mounted. The residuals are horizontal distances at the marks' height."""

    lens: Intrinsics
    created: str  # ISO date of the mount
    cup_from_camera: Array  # (4, 4): the camera's frame in the cup's (see ``projection``)
    residual_mm: float = 0.0  # RMS over all observations, 0 if the mount is not measured
    held_out_mm: float = 0.0  # RMS where every mark is predicted by a fit without it
    observations: tuple[Observation, ...] = ()

    def __post_init__(self) -> None:
        _check_date(self.created)
        _check_array("cup_from_camera", self.cup_from_camera, (4, 4))
        rotation, place_m = self.cup_from_camera[:3, :3], self.cup_from_camera[:3, 3]
        if (
            not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
            or np.linalg.det(rotation) < 0.0
            or self.cup_from_camera[3].tolist() != [0.0, 0.0, 0.0, 1.0]
        ):
            raise CalibrationError("cup_from_camera is not a rotation with a translation")
        _check_error("residual_mm", self.residual_mm)
        _check_error("held_out_mm", self.held_out_mm)
        if np.linalg.norm(place_m) > _MAX_MOUNT_M:
            raise CalibrationError(
                f"cup_from_camera puts the camera {1000.0 * np.linalg.norm(place_m):.0f} mm from the cup; "
                f"it is mounted within {1000.0 * _MAX_MOUNT_M:.0f} mm"
            )
        if rotation[2, 2] > _MIN_DOWN:
            raise CalibrationError("cup_from_camera has the camera look sideways or up; it must look down at the table")

    def age_days(self, today: datetime.date | None = None) -> int:
        """Days since the mount was measured."""
        return ((today or datetime.date.today()) - datetime.date.fromisoformat(self.created)).days

    def save(self, path: Path) -> None:
        """Write a JSON file, replacing an old one whole."""
        mount = {
            "created": self.created,
            "cup_from_camera": self.cup_from_camera.tolist(),
            "intrinsics_created": self.lens.created,
            "residual_mm": self.residual_mm,
            "held_out_mm": self.held_out_mm,
            "observations": [[*seen.pixel_px, *seen.joints_rad, *seen.touch_m] for seen in self.observations],
        }
        _save(path, "calibration", self.lens.content() | mount)

    @classmethod
    def load(cls, path: Path) -> Calibration:
        """Read a file that ``save`` wrote; :class:`CalibrationError` if it is missing, damaged or of the other kind."""
        content = _read(path, "calibration")
        with _named(path):
            rows = np.array(content["observations"], dtype=np.float64).reshape(-1, 8).tolist()
            return cls(
                lens=Intrinsics.of(content | {"created": content["intrinsics_created"]}),
                created=content["created"],
                cup_from_camera=np.array(content["cup_from_camera"], dtype=np.float64),
                residual_mm=content["residual_mm"],
                held_out_mm=content["held_out_mm"],
                observations=tuple(Observation((u, v), (j1, j2, j3), (x, y, z)) for u, v, j1, j2, j3, x, y, z in rows),
            )


def _check_date(created: str) -> None:
    try:
        datetime.date.fromisoformat(created)
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"created must be a date like 2025-01-31, got {created!r}") from error


def _check_array(name: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape or not np.isfinite(array).all():
        raise CalibrationError(f"{name} must be finite numbers of shape {shape}, got {array.tolist()}")


def _check_error(name: str, value: float) -> None:
    try:
        checks.number(name, value, low=0.0)
    except ValueError as error:
        raise CalibrationError(str(error)) from error


# The file


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else list(value) if isinstance(value, tuple) else value


def _save(path: Path, kind: str, content: Mapping[str, Any]) -> None:
    text = json.dumps({"format": _FORMAT, "kind": kind, **content}, indent=1)
    text = re.sub(r"\[[^][]*\]", lambda row: re.sub(r"\s+", " ", row[0]), text)  # one line per row of numbers
    path.parent.mkdir(parents=True, exist_ok=True)
    files.replace(path, text.encode() + b"\n")


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """What goes wrong with the values of a file is a :class:`CalibrationError` that names it."""
    try:
        yield
    except CalibrationError as error:
        raise CalibrationError(f"{path} cannot be used: {error}") from error
    except (TypeError, ValueError, KeyError) as error:
        raise CalibrationError(
            f"{path} is damaged ({error}); put back a copy, or run uarm-rl calibrate-camera and calibrate-hand-eye again"
        ) from error


def _read(path: Path, kind: str) -> dict[str, Any]:
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise CalibrationError(
            f"the calibration file {path} cannot be read ({error.strerror}); make one with uarm-rl calibrate-camera"
            f"{'' if kind == 'intrinsics' else ' and uarm-rl calibrate-hand-eye'}, or name another"
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
    return Calibration(nominal_intrinsics(image_size), _NOMINAL_DATE, mount)
