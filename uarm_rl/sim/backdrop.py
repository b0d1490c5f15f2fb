"""The table and the shadows on it, as pictures: PyBullet's renderer takes longer for them than for all the rest."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageChops, ImageDraw, ImageFilter

from uarm_rl.sim import looks
from uarm_rl.sim.simulated_arm import Camera
from uarm_rl.task.kinematics import Vector

Picture = NDArray[np.uint8]

_DEPTH: Final = 0.24  # how much darker a shadow is
_SMOOTH: Final = 3  # the table's edge is drawn so many times as large first


class Backdrop:
    """What is behind and below the arm, as one camera sees it in pictures of one size."""

    def __init__(self, camera: Camera, size: tuple[int, int]) -> None:
        self._camera, self._size = camera, size
        width, height = size
        large = Image.new("RGB", (_SMOOTH * width, _SMOOTH * height), _bytes((1.0, 1.0, 1.0)))
        draw = ImageDraw.Draw(large)
        angles = np.linspace(0.0, 2.0 * np.pi, 180)
        for z, colour in ((-looks.FLOOR_THICK_M, looks.EDGE), (0.0, looks.FLOOR)):
            round_m = np.column_stack([*(looks.FLOOR_RADIUS_M * np.array([np.cos(angles), np.sin(angles)])), np.full(180, z)])
            draw.polygon((_SMOOTH * camera.pixels(width, height, round_m)).ravel().tolist(), _bytes(colour))
        self._table = large.resize(size, Image.Resampling.BOX)

    def behind(self, meshes: list[looks.Mesh], picture: Picture, empty: NDArray[np.bool_]) -> Picture:
        """The picture, in which ``empty`` is where nothing was drawn, before the table with the shadows of the meshes."""
        dark = Image.new("L", self._size)
        draw = ImageDraw.Draw(dark)
        light = np.array(looks.LIGHT)
        for mesh in meshes:
            on_table = mesh.vertices - np.maximum(mesh.vertices[:, 2:], 0.0) / light[2] * light
            corners = self._camera.pixels(*self._size, on_table)[mesh.faces]
            lit = np.einsum("ij,j->i", mesh.normals[mesh.faces[:, 0]], light) > 0.0
            for triangle in corners[lit].reshape(-1, 6).tolist():
                draw.polygon(triangle, 255)
        dark = dark.filter(ImageFilter.GaussianBlur(self._size[1] / 400.0))
        shade = dark.point([round(255.0 - _DEPTH * value) for value in range(256)])
        table = ImageChops.multiply(self._table, Image.merge("RGB", (shade, shade, shade)))
        return _softened(Image.composite(table, Image.fromarray(picture), Image.fromarray(empty)))


def _bytes(colour: looks.Colour) -> tuple[int, int, int]:
    red, green, blue = (round(255.0 * value) for value in colour)
    return red, green, blue


def posed(mesh: looks.Mesh, pose: looks.Pose) -> looks.Mesh:
    """The mesh where a pose has it."""
    position, (w, x, y, z) = pose
    turn: Vector = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return looks.Mesh(mesh.vertices @ turn.T + np.asarray(position), mesh.normals @ turn.T, mesh.faces)


def _softened(image: Image.Image) -> Picture:
    """The picture with its edges a little blurred, where the renderer leaves stairs."""
    grey = image.convert("L")
    contrast = ImageChops.subtract(grey.filter(ImageFilter.MaxFilter(3)), grey.filter(ImageFilter.MinFilter(3)))
    edges = contrast.point([min(255, 8 * value) for value in range(256)])
    return np.asarray(Image.composite(image.filter(ImageFilter.GaussianBlur(0.75)), image, edges))
