"""The arm, a table and a box in PyBullet."""

from __future__ import annotations

import ctypes
import math
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import resources
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks
from uarm_rl.sim.servo import Servo
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError, JointPositions, PhysicsError
from uarm_rl.task.kinematics import Vector


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
        "pybullet is not installed; training and simulation need Python 3.10 or 3.11 on Linux x86-64, where pip installs it "
        "with uarm-rl",
        name="pybullet",
    ) from None

__all__ = ["Bodies", "SimArm", "bullet"]

_JOINTS = (0, 1, 2, 3)
_CUP = 4
_TORQUE_NM = (1.18, 1.18, 1.18, 1.18)  # the data sheet's 12 kgf cm
_SLACK_RAD = 0.1  # contact may push a joint past its limit by a little, never by this much
_EXPLODED_RAD_S = 1e3
_PARKED_M = (0.0, 0.6, 0.0)  # the object's place, on the table and out of reach, until it is placed
_RESTING_M = 1e-3  # a position may be so far from what an object that lies on the table has
_LOST_TILT = math.cos(math.radians(30.0))


class Bodies(NamedTuple):
    """PyBullet's numbers of the world and what is in it, for the emulator, which looks deeper than ``Arm`` allows."""

    client: int
    arm: int
    cup_link: int
    object: int
    table: int


class SimArm:
    """``Arm`` and ``Target`` in one PyBullet world.

    ``home`` builds the world anew (about 4 ms): PyBullet repeats itself to the last bit after the same commands
    from an empty world, which it does not promise after ``restoreState``. Every episode is therefore the same
    whatever ran before it.
    """

    def __init__(
        self,
        servo: Servo,
        *,
        control_hz: int,
        physics_hz: int,
        object_size_m: float,
        object_mass_kg: float,
        friction: float,
        exact_cup: bool = False,
        gui: bool = False,
    ) -> None:
        self._servo = servo
        checks.integer("control_hz", control_hz, low=1, high=1000)
        checks.integer("sim.physics_hz", physics_hz, low=120, high=10_000)
        if physics_hz % control_hz:
            raise ValueError(f"sim.physics_hz must be a multiple of control_hz ({control_hz}), got {physics_hz}")
        self._steps_per_control = physics_hz // control_hz
        self._dt_s = 1.0 / physics_hz
        self._object_size_m = checks.number("sim.object_size_m", object_size_m, low=0.005, high=0.1)
        self._object_mass_kg = checks.number("sim.object_mass_kg", object_mass_kg, low=0.0, high=1.0, open_low=True)
        self._friction = checks.number("sim.friction", friction, low=0.0, high=2.0)
        # PyBullet makes a hull of a cylinder, which stands 1 mm proud of it; the published runs have the hull.
        self._cup_flags = bullet.URDF_USE_IMPLICIT_CYLINDER if checks.boolean("sim.exact_cup", exact_cup) else 0
        self._arguments: dict[str, Any] = {
            "control_hz": control_hz,
            "physics_hz": physics_hz,
            "object_size_m": object_size_m,
            "object_mass_kg": object_mass_kg,
            "friction": friction,
            "exact_cup": exact_cup,
            "gui": gui,
        }
        self._client = self._connect(checks.boolean("sim.gui", gui))
        with resources.as_file(resources.files("uarm_rl.sim") / "assets") as assets:
            self._urdf = str(assets / "uarm_swift_pro.urdf")
        self.torques_nm = _TORQUE_NM  # what the motors of joint1..joint4 can give
        self._arm = self._object = self._table = -1
        self.home()

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is another world, built anew; two must not share one client."""
        return partial(SimArm, **self._arguments), (self._servo,)

    @staticmethod
    def has_screen() -> bool:
        """Whether a window can be opened."""
        return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))

    @staticmethod
    def _connect(gui: bool) -> int:
        if not gui:
            return int(bullet.connect(bullet.DIRECT))
        if not SimArm.has_screen():
            raise ArmError("sim.gui=true needs a screen, and DISPLAY is not set; leave it false or start an X server")
        client = int(bullet.connect(bullet.GUI, options="--width=1024 --height=768"))
        bullet.configureDebugVisualizer(bullet.COV_ENABLE_GUI, 0, physicsClientId=client)
        bullet.resetDebugVisualizerCamera(0.6, 50, -30, (0.2, 0, 0.08), physicsClientId=client)
        return client

    @property
    def bodies(self) -> Bodies:
        """PyBullet's numbers, valid until ``close``."""
        return Bodies(self._client, self._arm, _CUP, self._object, self._table)

    def home(self) -> None:
        """Build the world anew: arm at rest in the home pose, object parked out of reach."""
        client = {"physicsClientId": self._client}
        bullet.resetSimulation(**client)
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
        table = self._box(half_extents=(0.5, 0.8, 0.05), mass=0.0, centre=(0.1, 0.0, -0.05), colour=(0.87, 0.83, 0.77, 1))
        self._table = table
        half = self._object_size_m / 2.0
        x, y, z = _PARKED_M
        self._object = self._box((half, half, half), self._object_mass_kg, (x, y, z + half), (0.85, 0.25, 0.15, 1))
        self._arm = bullet.loadURDF(self._urdf, useFixedBase=True, flags=self._cup_flags, **client)
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
        joint1, joint2, joint3 = kinematics.HOME_JOINTS_RAD.tolist()
        for joint, angle in zip(_JOINTS, (joint1, joint2, joint3, kinematics.level(joint2, joint3)), strict=True):
            bullet.resetJointState(self._arm, joint, angle, **client)
        self._servo.reset((joint1, joint2, joint3))

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

    def command_joints(self, reference_rad: Sequence[float]) -> None:
        joint1, joint2, joint3 = reference_rad
        self._servo.command((joint1, joint2, joint3), self.read_joints())

    def advance(self) -> int:
        client, arm, dt = self._client, self._arm, self._dt_s
        for _ in range(self._steps_per_control):
            one, two, three, four = bullet.getJointStates(arm, _JOINTS, physicsClientId=client)
            q1, q2, q3 = one[0], two[0], three[0]
            v1, v2, v3 = self._servo.velocity((q1, q2, q3), (one[1], two[1], three[1]), dt)
            # The limits act as mechanical stops: no joint is driven past them, the coupled one included.
            n1, n2, n3 = kinematics.clip_to_limits(q1 + v1 * dt, q2 + v2 * dt, q3 + v3 * dt)
            velocities = (n1 - q1) / dt, (n2 - q2) / dt, (n3 - q3) / dt, (kinematics.level(n2, n3) - four[0]) / dt
            forces = self.torques_nm
            bullet.setJointMotorControlArray(
                arm, _JOINTS, bullet.VELOCITY_CONTROL, targetVelocities=velocities, forces=forces, physicsClientId=client
            )
            bullet.stepSimulation(physicsClientId=client)
        q1, q2, q3 = joints = self.read_joints()
        if not (abs(v1) + abs(v2) + abs(v3) < _EXPLODED_RAD_S and kinematics.within_limits(joints, _SLACK_RAD)):  # NaN too
            raise PhysicsError(f"the joints are at ({q1:g}, {q2:g}, {q3:g}) rad, asked for ({v1:g}, {v2:g}, {v3:g}) rad/s")
        return 1

    def place_object(self, top_m: Sequence[float] | Vector) -> None:
        x, y, z = (float(value) for value in top_m)
        if not abs(z - self._object_size_m) <= _RESTING_M:
            raise ValueError(
                f"an object of {1000 * self._object_size_m:g} mm rests on the table, so its upper surface is at "
                f"{self._object_size_m:g} m, and not at {z:g} m; give that as z, or another sim.object_size_m"
            )
        bullet.resetBasePositionAndOrientation(
            self._object, (x, y, z - self._object_size_m / 2.0), (0, 0, 0, 1), physicsClientId=self._client
        )
        bullet.resetBaseVelocity(self._object, (0, 0, 0), (0, 0, 0), physicsClientId=self._client)

    def object_position(self) -> tuple[float, float, float] | None:
        (x, y, z), (a, b, c, d) = bullet.getBasePositionAndOrientation(self._object, physicsClientId=self._client)
        # Third column of the rotation matrix: the direction of the box's upward normal.
        up_x, up_y, up_z = 2.0 * (a * c + b * d), 2.0 * (b * c - a * d), 1.0 - 2.0 * (a * a + b * b)
        if not (up_z >= _LOST_TILT and z >= 0.0):  # fallen over, off the table, or no number
            return None
        half = self._object_size_m / 2.0
        return x + half * up_x, y + half * up_y, z + half * up_z

    def link_ends(self) -> Vector:
        """Ends of link1, link2, link3 and the cup as PyBullet has them, shape (4, 3), m."""
        states = bullet.getLinkStates(self._arm, (1, 2, 3, _CUP), computeForwardKinematics=True, physicsClientId=self._client)
        return np.array([state[4] for state in states])

    def render(self, width: int, height: int) -> NDArray[np.uint8]:
        """An RGB picture, shape (height, width, 3), of arm and object from the side and above."""
        client = {"physicsClientId": self._client}
        view, projection = self._camera(width, height)
        picture = bullet.getCameraImage(
            width,
            height,
            view,
            projection,
            lightDirection=(0.6, -0.5, 1.2),
            shadow=1,
            renderer=bullet.ER_TINY_RENDERER,
            **client,
        )
        rgba = np.asarray(picture[2], np.uint8).reshape(height, width, 4)
        return np.ascontiguousarray(rgba[:, :, :3])

    def pixel(self, width: int, height: int, point_m: Sequence[float]) -> tuple[float, float]:
        """Column and row at which ``render`` shows a point."""
        view, projection = (np.reshape(matrix, (4, 4)).T for matrix in self._camera(width, height))
        x, y, _, w = projection @ view @ (*point_m, 1.0)
        return (0.5 + 0.5 * x / w) * width, (0.5 - 0.5 * y / w) * height

    def _camera(self, width: int, height: int) -> tuple[Sequence[float], Sequence[float]]:
        """View and projection, each a matrix in OpenGL's order; the whole arm is in the picture wherever it is."""
        client = {"physicsClientId": self._client}
        view = bullet.computeViewMatrixFromYawPitchRoll((0.14, 0.0, 0.11), 0.75, 60, -30, 0, 2, **client)
        return view, bullet.computeProjectionMatrixFOV(45, width / height, 0.05, 3.0, **client)

    def close(self) -> None:
        if self._client >= 0 and bullet.isConnected(self._client):
            bullet.disconnect(self._client)
        self._client = -1

    def __enter__(self) -> SimArm:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
