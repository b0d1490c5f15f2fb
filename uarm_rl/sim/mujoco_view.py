"""Pictures and a window of MuJoCo: a world of its own to draw in, of shapes that nothing collides with."""

from __future__ import annotations

import ctypes
import logging
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uarm_rl.checks import how_to_add
from uarm_rl.sim import looks
from uarm_rl.sim.simulated_arm import CAMERA, Camera, Scene
from uarm_rl.task.arm import ArmError
from uarm_rl.task.obstacles import Box

__all__ = ["View", "Window", "mujoco"]

# Read by MuJoCo when it is imported; without it a picture needs a screen, and without the library the import would fail.
if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
    with suppress(OSError):
        ctypes.CDLL("libEGL.so.1")
        os.environ.setdefault("MUJOCO_GL", "egl")

try:
    import mujoco
except ModuleNotFoundError as error:
    if error.name != "mujoco":
        raise
    raise ModuleNotFoundError(f"mujoco is not installed; {how_to_add('mujoco')}", name="mujoco") from None

if mujoco.get_mju_user_warning() is None:
    # What it would write to a file in the current folder, an explosion, is an exception here.
    mujoco.set_mju_user_warning(logging.getLogger(__name__).debug)

_OBJECT: Final = "object"


class _Stage:
    """The arm's looks, an object and a floor; every frame is a body that is put where it belongs."""

    def __init__(self, object_size_m: float, size: tuple[int, int] | None = None) -> None:
        spec = mujoco.MjSpec()
        if size is not None:
            spec.visual.global_.offwidth, spec.visual.global_.offheight = size
        spec.visual.global_.fovy = CAMERA.view_deg
        spec.visual.quality.shadowsize = 4096
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = (0.62,) * 3, (0.12,) * 3
        spec.visual.headlight.specular = (0.0,) * 3
        spec.visual.map.znear, spec.visual.map.zfar = 0.05, 10.0
        spec.stat.extent, spec.stat.center = 1.0, CAMERA.target_m
        away = tuple(-value for value in looks.LIGHT)
        spec.worldbody.add_light(
            pos=looks.LIGHT, dir=away, type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, diffuse=(0.36,) * 3, specular=(0.05,) * 3
        )
        sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_FLAT}
        spec.add_texture(name="sky", **sky, rgb1=(1.0, 1.0, 1.0), width=8, height=48)
        self._spec, self._meshes = spec, 0
        self._draw(spec.worldbody, looks.floor(), looks.FLOOR)
        bodies: dict[str, Any] = {}
        for part in looks.parts():
            if part.frame not in bodies:
                bodies[part.frame] = spec.worldbody.add_body(name=part.frame, mocap=True)
            self._draw(bodies[part.frame], part.mesh, part.colour)
        self._draw(spec.worldbody.add_body(name=_OBJECT, mocap=True), looks.box(object_size_m), looks.OBJECT)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._places = {name: int(self.model.body(name).mocapid[0]) for name in (*bodies, _OBJECT)}

    def _draw(self, body: Any, mesh: looks.Mesh, colour: looks.Colour) -> None:
        self._meshes += 1
        name = f"mesh{self._meshes}"
        made = self._spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        made.uservert, made.userface = mesh.vertices.ravel(), mesh.faces.ravel()
        made.usernormal = mesh.normals.ravel()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=(*colour, 1.0), contype=0, conaffinity=0, mass=0.0)

    def put(self, scene: Scene) -> None:
        """Everything where the scene has it."""
        poses = looks.poses(scene.joints_rad, scene.compression_m)
        poses[_OBJECT] = scene.object[:3], scene.object[3:]
        for name, place in self._places.items():
            self.data.mocap_pos[place], self.data.mocap_quat[place] = poses[name]
        mujoco.mj_forward(self.model, self.data)


def _stand(seen: mujoco.MjvScene, obstacles: Sequence[Box]) -> None:
    """Add obstacles to what is drawn: each attempt may have others, and what was compiled stays as it is."""
    for box in obstacles:
        shape = seen.geoms[seen.ngeom]
        sides, turned = np.array(box.size_m) / 2.0, np.eye(3).ravel()
        mujoco.mjv_initGeom(shape, mujoco.mjtGeom.mjGEOM_BOX, sides, box.centre_m, turned, (*looks.OBSTACLE, 1.0))
        shape.category = mujoco.mjtCatBit.mjCAT_STATIC  # which throws a shadow
        seen.ngeom += 1


def _point(at: Any, camera: Camera) -> None:
    """Set one of MuJoCo's cameras up."""
    at.lookat[:] = camera.target_m
    at.distance, at.azimuth, at.elevation = camera.distance_m, camera.azimuth_deg, camera.elevation_deg


class View:
    """Pictures of one size. Raises :class:`ArmError` where there is no way to draw."""

    def __init__(self, object_size_m: float, size: tuple[int, int]) -> None:
        self.size = size
        self._stage = _Stage(object_size_m, size)
        self._camera = mujoco.MjvCamera()
        try:
            self._renderer = mujoco.Renderer(self._stage.model, height=size[1], width=size[0])
        except Exception as error:  # of whatever kind, as the many ways to OpenGL have it
            raise ArmError(
                "MuJoCo cannot draw here: it needs a screen, or EGL (on Debian and Ubuntu: apt-get install libegl1 "
                "libgl1-mesa-dri); sim=pybullet draws without either, where it is installed"
            ) from error

    def picture(self, scene: Scene, camera: Camera) -> NDArray[np.uint8]:
        self._stage.put(scene)
        _point(self._camera, camera)
        self._renderer.update_scene(self._stage.data, self._camera)
        _stand(self._renderer.scene, scene.obstacles)
        picture: NDArray[np.uint8] = self._renderer.render()
        return picture

    def close(self) -> None:
        self._renderer.close()


class Window:
    """MuJoCo's own viewer."""

    def __init__(self, object_size_m: float) -> None:
        import mujoco.viewer as viewer

        self._stage = _Stage(object_size_m)
        self._handle = viewer.launch_passive(self._stage.model, self._stage.data, show_left_ui=False, show_right_ui=False)
        with self._handle.lock():
            _point(self._handle.cam, CAMERA)

    def show(self, scene: Scene) -> None:
        with self._handle.lock():
            self._stage.put(scene)
            self._handle.user_scn.ngeom = 0
            _stand(self._handle.user_scn, scene.obstacles)
        self._handle.sync()

    def close(self) -> None:
        self._handle.close()
