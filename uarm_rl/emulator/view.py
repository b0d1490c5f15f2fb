"""What an ideal pinhole camera sees, and the arithmetic of its picture."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uarm_rl.task.kinematics import Vector

NEAREST_M: Final = 0.01  # what the camera can see
_FARTHEST_M: Final = 3.0


class View(NamedTuple):
    """What an ideal pinhole camera sees."""

    colours: NDArray[np.uint8]  # (h, w, 3), red, green, blue
    background: NDArray[np.bool_]  # (h, w): nothing but the table
    object: NDArray[np.bool_]  # (h, w)
    top_px: Vector | None  # (4, 2) corners of the object's upper surface, clockwise as seen; None if it faces away


def projection(camera_matrix: Vector, size: tuple[int, int]) -> Vector:
    """OpenGL's projection matrix of a pinhole camera."""
    (fx, _, cx), (_, fy, cy), _ = camera_matrix.tolist()
    width, height = size
    cy += 1.0  # the renderer is one pixel off in this direction
    near, far = NEAREST_M, _FARTHEST_M
    return np.array(
        [
            [2.0 * fx / width, 0.0, 1.0 - 2.0 * cx / width, 0.0],
            [0.0, 2.0 * fy / height, 2.0 * cy / height - 1.0, 0.0],
            [0.0, 0.0, -(far + near) / (far - near), -2.0 * far * near / (far - near)],
            [0.0, 0.0, -1.0, 0.0],
        ]
    )


def clockwise(polygon_px: Vector) -> bool:
    """Whether the corners, v pointing down, go around clockwise."""
    x, y = polygon_px.T
    return bool(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0.0)
