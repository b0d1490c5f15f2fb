"""Finds the one object in a picture, by its colour or by a printed marker. Pictures are BGR, shape (h, w, 3)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]

_MAX_HUE: Final = 179  # OpenCV halves the hue so that it fits a byte
_GRAIN_PX: Final = 3  # blobs and holes thinner than this are noise
_FRAME_BGR: Final = (0, 255, 0)


class TargetNotFoundError(Exception):
    """The picture shows no object, or several; the message is a sentence with the remedy."""


@dataclass(frozen=True, eq=False)
class Detection:
    """Where the object is in the picture, in pixels (the first pixel's centre is at 0, 0)."""

    centre_px: tuple[float, float]  # u right, v down
    outline_px: Array  # the outline, shape (n, 2)


class Detector(Protocol):
    """What finds the object."""

    def detect(self, image: Picture) -> Detection:
        """The one object in ``image``; raises :class:`TargetNotFoundError` if there is none or more than one."""
        ...


class ColourDetector:
    """The one blob of a colour, between ``hsv_low`` and ``hsv_high``: hue 0..179, saturation and value 0..255.

    A hue range whose low end is above its high end goes through red: (170, ...) to (10, ...). Blobs smaller than
    ``min_area_px`` do not count. The centre is that of the outline's area. On a box that is not below the camera the
    outline includes side faces; ``projection.locate_box`` accounts for them.
    """

    def __init__(self, hsv_low: Sequence[int], hsv_high: Sequence[int], min_area_px: float = 150.0) -> None:
        if len(hsv_low) != 3 or len(hsv_high) != 3:
            raise ValueError(f"hsv_low and hsv_high need three numbers each, got {list(hsv_low)} and {list(hsv_high)}")
        for name, values in (("hsv_low", hsv_low), ("hsv_high", hsv_high)):
            for index, top in enumerate((_MAX_HUE, 255, 255)):
                checks.integer(f"{name}[{index}]", values[index], low=0, high=top)
        for index, what in ((1, "saturation"), (2, "value")):
            if hsv_low[index] > hsv_high[index]:
                raise ValueError(
                    f"the {what} goes from {hsv_low[index]} up to {hsv_high[index]}; the low end must not be above the high "
                    "end (the hue alone may wrap around)"
                )
        self._min_area_px = checks.number("min_area_px", min_area_px, low=1.0)
        (hue_low, *low), (hue_high, *high) = hsv_low, hsv_high
        hues = [(hue_low, hue_high)] if hue_low <= hue_high else [(hue_low, _MAX_HUE), (0, hue_high)]
        self._ranges = [(np.array([first, *low]), np.array([last, *high])) for first, last in hues]

    def detect(self, image: Picture) -> Detection:
        hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
        mask = np.zeros(image.shape[:2], np.uint8)
        for low, high in self._ranges:
            mask |= cv2.inRange(hsv, low, high).astype(np.uint8)
        grain = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_GRAIN_PX, _GRAIN_PX))
        mask = cv2.morphologyEx(cv2.morphologyEx(mask, cv2.MORPH_OPEN, grain), cv2.MORPH_CLOSE, grain).astype(np.uint8)
        outlines: Sequence[Any] = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        areas = [cv2.contourArea(outline) for outline in outlines]
        large = [index for index, area in enumerate(areas) if area >= self._min_area_px]
        if not large:
            seen = f"the largest has {max(areas):.0f}" if areas else "no pixel has the colour"
            raise TargetNotFoundError(
                f"the object is not in view: no blob of its colour has {self._min_area_px:.0f} square pixels ({seen}); check "
                "where it lies, the light and the colour range"
            )
        if len(large) > 1:
            raise TargetNotFoundError(
                f"{len(large)} things in view have the object's colour ({_places(outlines[index] for index in large)}); "
                "leave one of them, or narrow the colour range"
            )
        outline = outlines[large[0]]
        corners = outline.reshape(-1, 2).astype(np.float64)
        if (corners <= 0).any() or (corners >= np.array(image.shape[1::-1]) - 1).any():
            raise TargetNotFoundError(
                f"the object at pixel ({_places([outline])}) is cut off by the edge of the picture; move it or the camera"
            )
        moments = cv2.moments(outline)
        centre = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
        return Detection(centre, corners)


def _places(outlines: Iterable[Any]) -> str:
    middles = (outline.reshape(-1, 2).mean(axis=0) for outline in outlines)
    return "; ".join(f"{u:.0f}, {v:.0f}" for u, v in middles)


_PREFIX: Final = "DICT_"
#: Names of the marker families that OpenCV knows, such as APRILTAG_36h11 and 4X4_50.
MARKER_FAMILIES: Final = tuple(
    sorted(
        name.removeprefix(_PREFIX)
        for name in dir(cv2.aruco)
        if name.startswith(_PREFIX) and not re.search(r"H\d+$", name)  # second spellings
    )
)


class MarkerDetector:
    """The one AprilTag or ArUco marker of a family; ``id`` names which, ``None`` takes any as long as it is alone.

    The marker is printed with a white margin and lies flat on top of the object, its middle on the object's middle.
    """

    def __init__(self, family: str = "APRILTAG_36h11", id: int | None = None) -> None:
        if not hasattr(cv2.aruco, _PREFIX + family):
            raise ValueError(f"there is no marker family {family!r}; choose one of {', '.join(MARKER_FAMILIES)}")
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, _PREFIX + family))
        if id is not None:
            checks.integer("id", id, low=0, high=len(dictionary.bytesList) - 1)
        self._family, self._id = family, id
        parameters = cv2.aruco.DetectorParameters()
        # Symmetric about the marker; the "AprilTag" refinement is half a pixel off.
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def detect(self, image: Picture) -> Detection:
        corners, ids, _ = self._detector.detectMarkers(image)
        found = [] if ids is None else [int(number) for number in ids.ravel()]
        wanted = [index for index, number in enumerate(found) if self._id in (None, number)]
        name = f"{self._family} marker" + ("" if self._id is None else f" {self._id}")
        if not wanted:
            others = f" (markers in view: {', '.join(map(str, sorted(found)))})" if found else ""
            raise TargetNotFoundError(
                f"the object is not in view: no {name} was found{others}; check that the whole marker with its white margin "
                "is visible, sharp and lit evenly"
            )
        if len(wanted) > 1:
            numbers = ", ".join(str(number) for number in sorted(found[index] for index in wanted))
            raise TargetNotFoundError(f"{len(wanted)} times {name} is in view (ids {numbers}); leave one, or name its id")
        square = np.asarray(corners[wanted[0]], dtype=np.float64).reshape(4, 2)
        return Detection(_crossing(square), square)


def _crossing(square: Array) -> tuple[float, float]:
    """Where the diagonals meet: the middle of the marker in any perspective, which the mean of the corners is not."""
    first, second = square[2] - square[0], square[3] - square[1]
    along = np.linalg.solve(np.stack([first, -second], axis=1), square[1] - square[0])[0]
    u, v = square[0] + along * first
    return float(u), float(v)


def annotate(image: Picture, detection: Detection | None, text: str = "") -> Picture:
    """A copy of the picture with the outline, a cross at the centre, and lines of text."""
    drawn: Picture = image.copy()
    if detection is not None:
        cv2.polylines(drawn, [np.round(detection.outline_px).astype(np.int32)], True, _FRAME_BGR, 1)
        centre = (round(detection.centre_px[0]), round(detection.centre_px[1]))
        cv2.drawMarker(drawn, centre, _FRAME_BGR, cv2.MARKER_CROSS, 11, 1)
    for number, line in enumerate(text.splitlines(), start=1):
        place = (4, 14 * number)
        cv2.putText(drawn, line, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 3, cv2.LINE_AA)  # readable on anything
        cv2.putText(drawn, line, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
    return drawn
