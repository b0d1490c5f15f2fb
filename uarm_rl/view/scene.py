"""The arm, its object and its target in a viser scene: drawn once, then posed by joint angles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from uarm_rl.checks import how_to_add
from uarm_rl.sim import looks

try:
    import viser
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"{error.name} is not installed, which shows the arm in a browser; {how_to_add('view')}", name=error.name
    ) from None

__all__ = ["TABLE_M", "ArmView", "colour", "viser"]

if TYPE_CHECKING:
    from uarm_rl.task.kinematics import Vector
    from uarm_rl.task.obstacles import Box

#: The arm's place on the table: front to back, and side to side (m). The base stands on its left edge, in the middle.
TABLE_M: Final = (0.52, 0.56)
_TABLE_THICK_M: Final = 0.01
_BEHIND_M: Final = 0.1  # of the table, behind the base's axis
_MARK_M: Final = 0.014  # across
_MARK_COLOUR: Final = (20, 20, 20)


def colour(rgba: Sequence[float]) -> tuple[int, int, int]:
    """A colour of the simulation, in numbers from 0 to 1, as viser has it."""
    red, green, blue = (round(255.0 * value) for value in rgba[:3])
    return red, green, blue


class ArmView:
    """One arm on its piece of table, with an object and a mark where the cup is to go.

    ``name`` is that of the scene's node, as in ``/arm``; ``place_m`` (x, y, z) is where the base stands, ``title`` floats
    above it. A scene may have several. ``hose``: it is drawn too, in 52 pieces that move, too many for a recording.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str = "/arm",
        *,
        place_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
        object_size_m: float = 0.03,
        title: str = "",
        hose: bool = False,
    ) -> None:
        scene = server.scene
        self._scene, self._name, self._height_m = scene, name, object_size_m
        scene.add_frame(name, show_axes=False, position=place_m)
        deep, wide = TABLE_M
        scene.add_box(
            f"{name}/table",
            colour(looks.FLOOR),
            (deep, wide, _TABLE_THICK_M),
            position=(deep / 2.0 - _BEHIND_M, 0.0, -_TABLE_THICK_M / 2.0),
        )
        if title:
            scene.add_label(f"{name}/title", title, position=(0.0, 0.0, 0.36), anchor="bottom-center", font_screen_scale=1.5)
        self._cup_m: Vector = np.zeros(3)
        self._frames: dict[str, viser.FrameHandle] = {}
        paths: dict[str, str] = {}
        shown = [part for part in looks.parts() if hose or not part.frame.startswith("hose")]
        for frame in dict.fromkeys(("base", "turret", *looks.PARENTS, *(part.frame for part in shown))):
            paths[frame] = f"{paths.get(looks.PARENTS.get(frame, ''), name)}/{frame}"
            self._frames[frame] = scene.add_frame(paths[frame], show_axes=False)
        for number, part in enumerate(shown):
            self._add_mesh(f"{paths[part.frame]}/mesh{number}", part.mesh, part.colour)
        self._object = scene.add_frame(f"{name}/object", show_axes=False, visible=False)
        self._obstacles: tuple[Box, ...] = ()
        self._standing: list[viser.MeshHandle] = []
        self._box_m = object_size_m
        self._box = self._add_mesh(f"{name}/object/box", looks.box(object_size_m), looks.OBJECT)
        self._mark = scene.add_cylinder(f"{name}/target", _MARK_M / 2.0, 0.001, color=_MARK_COLOUR, visible=False)

    def _add_mesh(self, name: str, mesh: looks.Mesh, rgb: looks.Colour) -> viser.MeshHandle:
        vertices = mesh.vertices.astype(np.float32)
        return self._scene.add_mesh_simple(name, vertices, mesh.faces, color=colour(rgb), flat_shading=False)

    def pose(self, joints_rad: Sequence[float] | Vector, compression_m: float = 0.0) -> None:
        """Set joint1 to joint3 (rad; further ones are ignored): the rest follows, as the rods have it."""
        poses = looks.poses(joints_rad, compression_m)  # type: ignore[arg-type]
        for name, frame in self._frames.items():
            parent = looks.PARENTS.get(name)
            frame.position, frame.wxyz = looks.seen_from(poses[parent], poses[name]) if parent else poses[name]
        self._cup_m = np.array(poses["cup"][0])

    def cup_m(self) -> Vector:
        """Where the drawn cup's tip is, shape (3,), from the base."""
        return self._cup_m

    def size_object(self, sides_m: Sequence[float]) -> None:
        """Give the object these sides (m): along x, along y, and its height."""
        length, width, height = (float(side) for side in sides_m)
        self._height_m = height
        self._box.scale = (length / self._box_m, width / self._box_m, height / self._box_m)

    def put_object(self, top_m: Sequence[float] | Vector | None) -> None:
        """Show the object with the centre of its upper surface there (x, y, z from the base); ``None`` hides it."""
        self._object.visible = top_m is not None
        if top_m is not None:
            x, y, z = (float(value) for value in top_m)
            self._object.position = (x, y, z - self._height_m / 2.0)

    def put_object_at(self, pose: looks.Pose) -> None:
        """Show the object with its centre there, turned so."""
        self._object.visible = True
        self._object.position, self._object.wxyz = pose

    def put_obstacles(self, obstacles: Sequence[Box]) -> None:
        """Show these obstacles, and no others."""
        if tuple(obstacles) != self._obstacles:
            for mesh in self._standing:
                mesh.remove()
            self._obstacles = tuple(obstacles)
            meshes = list(map(looks.obstacle, obstacles))
            names = [f"{self._name}/obstacle{number}" for number in range(len(meshes))]
            self._standing = [self._add_mesh(name, mesh, looks.OBSTACLE) for name, mesh in zip(names, meshes, strict=True)]

    def mark_target(self, point_m: Sequence[float] | Vector | None) -> None:
        """Mark where the cup's tip is to go (x, y, z from the base); ``None`` hides the mark."""
        self._mark.visible = point_m is not None
        if point_m is not None:
            x, y, z = (float(value) for value in point_m)
            self._mark.position = (x, y, z)

    def draw_path(self, points_m: Vector, rgb: tuple[int, int, int] = (0, 90, 180)) -> None:
        """Draw the way of the cup's tip, shape (n, 3); it replaces the one before."""
        ends = np.stack([points_m[:-1], points_m[1:]], axis=1)
        self._scene.add_line_segments(
            f"{self._name}/path", ends.astype(np.float32), rgb, thickness=2.0, thickness_units="screen"
        )
