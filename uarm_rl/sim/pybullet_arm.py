"""The arm, a table and a box in PyBullet."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks
from uarm_rl.sim import looks
from uarm_rl.sim.backdrop import Backdrop, posed
from uarm_rl.sim.cup import Bellows
from uarm_rl.sim.servo import Servo, Torque
from uarm_rl.sim.simulated_arm import (
    CAMERA,
    OBJECT_COLOUR,
    OBSTACLE_COLOUR,
    PARKED_M,
    TABLE_CENTRE_M,
    TABLE_COLOUR,
    TABLE_HALF_EXTENTS_M,
    Camera,
    Chain,
    ObjectPose,
    Scene,
    SimulatedArm,
    urdf,
)
from uarm_rl.task.arm import JointPositions
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.obstacles import Box


@contextmanager
def _silent(descriptor: int) -> Iterator[None]:
    """Keep what PyBullet's C code prints, unasked, to a file descriptor out of a command's output."""
    flush = ctypes.CDLL(None).fflush  # C has a buffer of its own
    sys.stdout.flush()
    flush(None)
    saved, null = os.dup(descriptor), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, descriptor)
        yield
        flush(None)
    finally:
        os.dup2(saved, descriptor)
        os.close(saved)
        os.close(null)


try:
    with _silent(2):
        import pybullet as bullet
except ModuleNotFoundError:
    raise ModuleNotFoundError(
        "pybullet is not installed, and has wheels for Python 3.10 and 3.11 on Linux x86-64 alone; elsewhere sim=mujoco "
        "trains, evaluates and renders, but the emulator needs PyBullet",
        name="pybullet",
    ) from None

__all__ = ["Bodies", "SimArm", "bullet"]

_JOINTS = (0, 1, 2, 3)
_CUP = 4


class Bodies(NamedTuple):
    """PyBullet's numbers of the world and what is in it, for the emulator, which looks deeper than ``Arm`` allows."""

    client: int
    arm: int
    cup_link: int
    object: int
    table: int


class SimArm(SimulatedArm):
    """``Arm`` and ``Target`` in one PyBullet world.

    ``stand_at`` builds the world anew (about 4 ms): PyBullet repeats itself to the last bit after the same commands
    from an empty world, which it does not promise after ``restoreState``.
    """

    def __init__(
        self,
        servo: Servo | Torque,
        *,
        control_hz: int,
        physics_hz: int,
        object_size_m: float,
        object_mass_kg: float,
        friction: float,
        exact_cup: bool = False,
        cup: Bellows | None = None,
        gui: bool = False,
    ) -> None:
        super().__init__(
            servo,
            control_hz=control_hz,
            physics_hz=physics_hz,
            object_size_m=object_size_m,
            object_mass_kg=object_mass_kg,
            friction=friction,
            cup=cup,
            gui=gui,
        )
        self._arguments["exact_cup"] = checks.boolean("sim.exact_cup", exact_cup)
        # PyBullet makes a hull of a cylinder, which stands 1 mm proud of it; the published runs have the hull.
        self._cup_flags = bullet.URDF_USE_IMPLICIT_CYLINDER if exact_cup or cup else 0
        self._driven = (*_JOINTS, _CUP) if cup else _JOINTS
        self._client = self._connect(gui)
        self._urdf = urdf()
        self._folder: TemporaryDirectory[str] | None = None
        if cup is not None:  # PyBullet reads files alone
            self._folder = TemporaryDirectory(prefix="uarm-rl-")
            text, self._urdf = cup.joined(self._urdf.read_text()), Path(self._folder.name, "arm.urdf")
            self._urdf.write_text(text)
        self._arm = self._object = self._table = -1
        self._in_the_way: list[int] = []
        self._studio: _Studio | None = None
        self.home()

    @staticmethod
    def _connect(gui: bool) -> int:
        if not gui:
            return int(bullet.connect(bullet.DIRECT))
        client = int(bullet.connect(bullet.GUI, options="--width=1024 --height=768"))
        bullet.configureDebugVisualizer(bullet.COV_ENABLE_GUI, 0, physicsClientId=client)
        bullet.resetDebugVisualizerCamera(0.6, 50, -30, (0.2, 0, 0.08), physicsClientId=client)
        return client

    @property
    def bodies(self) -> Bodies:
        """PyBullet's numbers, valid until ``close``."""
        return Bodies(self._client, self._arm, _CUP, self._object, self._table)

    def stand_at(self, joints_rad: Sequence[float]) -> None:
        client = {"physicsClientId": self._client}
        bullet.resetSimulation(**client)
        self._obstacles, self._in_the_way = (), []
        # A direct solver: with the default, 50 iterations let the outstretched arm sag by 1.5 degrees under its own
        # weight and a resting box creep by 13 um/s. It is also the faster one here.
        with _silent(1):
            bullet.setPhysicsEngineParameter(
                fixedTimeStep=self._dt_s,
                constraintSolverType=bullet.CONSTRAINT_SOLVER_LCP_DANTZIG,
                globalCFM=1e-6,
                deterministicOverlappingPairs=1,
                **client,
            )
        bullet.setGravity(0, 0, -9.81, **client)
        self._table = table = self._box(TABLE_HALF_EXTENTS_M, 0.0, TABLE_CENTRE_M, TABLE_COLOUR)
        half = self._object_size_m / 2.0
        self._object = self._box((half, half, half), self._object_mass_kg, (*PARKED_M, half), OBJECT_COLOUR)
        self._arm = bullet.loadURDF(str(self._urdf), useFixedBase=True, flags=self._cup_flags, **client)
        for body in (table, self._object):
            bullet.changeDynamics(body, -1, lateralFriction=self._friction, **client)
        for link in range(-1, _CUP + 1):
            bullet.changeDynamics(
                self._arm, link, linearDamping=0, angularDamping=0, jointDamping=0, lateralFriction=self._friction, **client
            )
        # The direct solver takes every stiffness from 150 to 100,000 N/m as rigid, but not to the last bit as without one.
        bullet.changeDynamics(self._arm, _CUP, contactStiffness=1500.0, contactDamping=20.0, **client)
        # Base and turret stand above the table for good, so those pairs need no collision test.
        for link in (-1, 0):
            bullet.setCollisionFilterPair(self._arm, table, link, -1, 0, **client)
        for joint, angle in zip(_JOINTS, self._start(joints_rad), strict=True):
            bullet.resetJointState(self._arm, joint, angle, **client)

    def _box(
        self,
        half_extents: tuple[float, float, float],
        mass: float,
        centre: tuple[float, float, float],
        colour: tuple[float, float, float, float],
    ) -> int:
        client = {"physicsClientId": self._client}
        collision = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half_extents, **client)
        visual = bullet.createVisualShape(bullet.GEOM_BOX, halfExtents=half_extents, rgbaColor=colour, **client)
        return int(bullet.createMultiBody(mass, collision, visual, centre, **client))

    def read_joints(self) -> JointPositions:
        states = bullet.getJointStates(self._arm, _JOINTS, physicsClientId=self._client)
        return states[0][0], states[1][0], states[2][0]

    def advance(self) -> int:
        client, arm, drive = self._client, self._arm, self._drive
        driven, bellows = self._driven, self._bellows
        for _ in range(self._steps_per_control):
            one, two, three, four, *lip = bullet.getJointStates(arm, driven, physicsClientId=client)
            joints, velocities = (one[0], two[0], three[0], four[0]), (one[1], two[1], three[1], four[1])
            asked, torques_nm = drive(joints, velocities)
            speeds: tuple[float, ...] = asked
            forces: tuple[float, ...] = torques_nm
            if bellows is not None:
                velocity, force = bellows.push(lip[0][0])
                speeds, forces = (*asked, velocity), (*forces, force)
            bullet.setJointMotorControlArray(
                arm, driven, bullet.VELOCITY_CONTROL, targetVelocities=speeds, forces=forces, physicsClientId=client
            )
            bullet.stepSimulation(physicsClientId=client)
        self._check_motion(self.read_joints(), asked)
        return 1

    def place_obstacles(self, obstacles: Sequence[Box]) -> None:
        for body in self._in_the_way:
            bullet.removeBody(body, physicsClientId=self._client)
        self._obstacles, self._in_the_way = tuple(obstacles), []
        for box in obstacles:
            length, width, height = (side / 2.0 for side in box.size_m)
            body = self._box((length, width, height), 0.0, box.centre_m, OBSTACLE_COLOUR)
            bullet.changeDynamics(body, -1, lateralFriction=self._friction, physicsClientId=self._client)
            self._in_the_way.append(body)

    def touch_n(self) -> float:
        points = [bullet.getContactPoints(self._arm, body, physicsClientId=self._client) for body in self._in_the_way]
        return float(sum(point[9] for several in points for point in several))

    def _put_object(self, centre_m: tuple[float, float, float]) -> None:
        bullet.resetBasePositionAndOrientation(self._object, centre_m, (0, 0, 0, 1), physicsClientId=self._client)
        bullet.resetBaseVelocity(self._object, (0, 0, 0), (0, 0, 0), physicsClientId=self._client)

    def _object_pose(self) -> ObjectPose:
        position, (x, y, z, w) = bullet.getBasePositionAndOrientation(self._object, physicsClientId=self._client)
        return *position, w, x, y, z

    def compression_m(self) -> float:
        return float(bullet.getJointState(self._arm, _CUP, physicsClientId=self._client)[0]) if self._bellows else 0.0

    def contact_n(self) -> float:
        contacts = bullet.getContactPoints(self._arm, self._object, _CUP, physicsClientId=self._client)
        return float(sum(contact[9] for contact in contacts))

    def _held_nm(self, joints: Chain) -> JointPositions:
        at = [*joints, self.compression_m()] if self._bellows else [*joints]
        still = [0.0] * len(at)
        held = bullet.calculateInverseDynamics(self._arm, at, still, still, physicsClientId=self._client)
        return held[0], held[1], held[2]

    def link_ends(self) -> Vector:
        states = bullet.getLinkStates(self._arm, (1, 2, 3, _CUP), computeForwardKinematics=True, physicsClientId=self._client)
        return np.array([state[4] for state in states])

    def draw(self, scene: Scene, width: int, height: int, camera: Camera = CAMERA) -> NDArray[np.uint8]:
        self._studio = self._studio or _Studio(self._object_size_m)
        return self._studio.picture(scene, width, height, camera)

    def close(self) -> None:
        if self._client >= 0 and bullet.isConnected(self._client):
            bullet.disconnect(self._client)
        self._client = -1
        if self._studio:
            self._studio.close()
            self._studio = None
        if self._folder:
            self._folder.cleanup()


class _Studio:
    """A world of its own to draw in, of shapes that nothing collides with; PyBullet's own renderer needs no screen."""

    def __init__(self, object_size_m: float) -> None:
        self._client = int(bullet.connect(bullet.DIRECT))
        self._parts = [(part.frame, part.mesh, self._body(part.mesh, part.colour)) for part in looks.parts()]
        box = looks.box(object_size_m)
        self._parts.append(("object", box, self._body(box, looks.OBJECT)))
        self._obstacles: dict[Box, tuple[looks.Mesh, int]] = {}
        self._backdrop: tuple[Any, Backdrop] | None = None

    def _body(self, mesh: looks.Mesh, colour: looks.Colour) -> int:
        client = {"physicsClientId": self._client}
        shape = bullet.createVisualShape(
            bullet.GEOM_MESH,
            vertices=mesh.vertices.tolist(),
            normals=mesh.normals.tolist(),
            indices=mesh.faces.ravel().tolist(),
            rgbaColor=(*colour, 1.0),
            **client,
        )
        return int(bullet.createMultiBody(0.0, -1, shape, **client))

    def _stand(self, obstacles: Sequence[Box]) -> Iterator[looks.Mesh]:
        """Show these obstacles and no others; what they look like, in their places."""
        for gone in self._obstacles.keys() - set(obstacles):
            bullet.removeBody(self._obstacles.pop(gone)[1], physicsClientId=self._client)
        for box in obstacles:
            if box not in self._obstacles:
                mesh = looks.obstacle(box)
                self._obstacles[box] = mesh, self._body(mesh, looks.OBSTACLE)
            yield self._obstacles[box][0]

    def picture(self, scene: Scene, width: int, height: int, camera: Camera) -> NDArray[np.uint8]:
        client = {"physicsClientId": self._client}
        standing = list(self._stand(scene.obstacles))
        poses = looks.poses(scene.joints_rad, scene.compression_m) | {"object": (scene.object[:3], scene.object[3:])}
        for frame, _, body in self._parts:
            position, (w, x, y, z) = poses[frame]
            bullet.resetBasePositionAndOrientation(body, position, (x, y, z, w), **client)
        view = bullet.computeViewMatrixFromYawPitchRoll(
            camera.target_m, camera.distance_m, camera.azimuth_deg - 90.0, camera.elevation_deg, 0, 2, **client
        )
        projection = bullet.computeProjectionMatrixFOV(camera.view_deg, width / height, 0.05, 5.0, **client)
        picture = bullet.getCameraImage(
            width,
            height,
            view,
            projection,
            lightDirection=looks.LIGHT,
            lightAmbientCoeff=0.60,
            lightDiffuseCoeff=0.50,
            lightSpecularCoeff=0.02,
            shadow=0,
            renderer=bullet.ER_TINY_RENDERER,
            flags=bullet.ER_NO_SEGMENTATION_MASK,
            **client,
        )
        rgba = np.asarray(picture[2], np.uint8).reshape(height, width, 4)
        empty = np.asarray(picture[3], np.float32).reshape(height, width) >= 1.0
        seen_by = camera, (width, height)
        if self._backdrop is None or self._backdrop[0] != seen_by:
            self._backdrop = seen_by, Backdrop(*seen_by)
        meshes = [*(posed(mesh, poses[frame]) for frame, mesh, _ in self._parts), *standing]
        return self._backdrop[1].behind(meshes, np.ascontiguousarray(rgba[:, :, :3]), empty)

    def close(self) -> None:
        if bullet.isConnected(self._client):
            bullet.disconnect(self._client)
