"""What the emulated camera sees: the world through a pinhole, then lens, light, blur and noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from uarm_rl.emulator.physics import World
from uarm_rl.emulator.realism import Realism
from uarm_rl.real.vision.camera_model import Calibration
from uarm_rl.task.kinematics import Vector

Picture = NDArray[np.uint8]

TAG_FAMILY: Final = cv2.aruco.DICT_APRILTAG_36h11
_TABLE_GREY: Final = 150
_FINE: Final = 2  # the picture is drawn so many times as fine, against jagged edges
_TAG_PX, _QUIET_PX = 80, 10  # of the tag's texture: the tag, and the white around it that detectors need


class Optics:
    """A camera on the cup's frame. ``calibration`` is the truth about its lens and, apart from an error drawn once from
    ``generator``, about its mount. ``top``: a picture (RGB) that lies on the object's upper surface.
    """

    def __init__(
        self, calibration: Calibration, realism: Realism, generator: np.random.Generator, *, top: Picture | None = None
    ) -> None:
        self.cup_from_camera: Vector = calibration.cup_from_camera @ realism.draw_mount_error(generator)
        self._size = calibration.lens.image_size
        self._realism = realism
        self._generator = generator
        self._top = top
        self._set_lens(calibration)
        width, height = self._size
        across = np.linspace(-0.5, 0.5, width, dtype=np.float32)
        self._light = realism.light * (1.0 + realism.light_gradient * np.tile(across, (height, 1)))[:, :, np.newaxis]

    def _set_lens(self, calibration: Calibration) -> None:
        """Find, for every pixel of the fine picture, where a pinhole camera would see the same thing."""
        width, height = self._size
        fine = (np.arange(_FINE * max(self._size)) + 0.5) / _FINE - 0.5  # in pixels of the picture
        u, v = np.meshgrid(fine[: _FINE * width], fine[: _FINE * height])
        pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
        matrix, distortion = calibration.lens.camera_matrix, calibration.lens.distortion
        rays = cv2.undistortPointsIter(pixels, matrix, distortion, np.eye(3), np.eye(3), criteria)
        plane = rays.reshape(_FINE * height, _FINE * width, 2)
        focal = _FINE * calibration.lens.camera_matrix[[0, 1], [0, 1]]
        low, high = plane.min(axis=(0, 1)), plane.max(axis=(0, 1))
        middle = 1.0 - focal * low
        self._pinhole = np.array([[focal[0], 0.0, middle[0]], [0.0, focal[1], middle[1]], [0.0, 0.0, 1.0]])
        across, down = np.ceil(focal * (high - low)).astype(int) + 3
        self._pinhole_size = int(across), int(down)
        across_px, down_px = np.moveaxis((plane * focal + middle).astype(np.float32), 2, 0)
        self._map = np.ascontiguousarray(across_px), np.ascontiguousarray(down_px)

    def picture(self, world: World) -> Picture:
        """What the camera sees now: BGR, shape (h, w, 3)."""
        view = world.view(self._pinhole, self._pinhole_size, self.cup_from_camera)
        drawn = view.colours.copy()
        drawn[view.background] = _TABLE_GREY
        if self._top is not None and view.top_px is not None:
            self._lay_on(drawn, self._top, view.top_px, view.object)
        fine = cv2.remap(drawn, *self._map, cv2.INTER_LINEAR)
        seen = cv2.resize(fine, self._size, interpolation=cv2.INTER_AREA)
        if self._realism.blur_px:
            seen = cv2.GaussianBlur(seen, (0, 0), self._realism.blur_px)
        exposed = seen * self._light
        if self._realism.noise:
            exposed += self._realism.noise * self._generator.standard_normal(seen.shape, dtype=np.float32)
        return np.ascontiguousarray(np.clip(np.rint(exposed), 0, 255).astype(np.uint8)[:, :, ::-1])

    def _lay_on(self, drawn: Picture, top: Picture, corners_px: Vector, visible: NDArray[np.bool_]) -> None:
        height, width = top.shape[:2]
        edges = np.array([(0, 0), (width, 0), (width, height), (0, height)], np.float32) - np.float32(0.5)
        warp = cv2.getPerspectiveTransform(edges, corners_px.astype(np.float32))
        laid = cv2.warpPerspective(top, warp, self._pinhole_size, borderMode=cv2.BORDER_REPLICATE)
        inside = np.zeros(visible.shape, np.uint8)
        # Four more bits per coordinate; a pixel belongs to the surface if its middle does.
        cv2.fillConvexPoly(inside, np.rint(16.0 * corners_px).astype(np.int32), 1, shift=4)
        mask = visible & (inside > 0)
        drawn[mask] = laid[mask]


def tag_texture(number: int) -> Picture:
    """AprilTag 36h11 ``number`` with a white margin, RGB."""
    tag = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(TAG_FAMILY), number, _TAG_PX)
    return cv2.cvtColor(np.pad(tag, _QUIET_PX, constant_values=255), cv2.COLOR_GRAY2RGB).astype(np.uint8)


def plain_texture(colour: Sequence[int]) -> Picture:
    """One colour: red, green, blue."""
    return np.full((16, 16, 3), colour, np.uint8)
