"""What the simulated arms have in common, whichever engine moves them."""

from __future__ import annotations

import math
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import partial
from importlib import resources
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks
from uarm_rl.sim.cup import Bellows
from uarm_rl.sim.servo import Servo, Torque
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError, JointPositions, PhysicsError
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.obstacles import Box

#: Angles or angular velocities of joint1..joint4.
Chain = tuple[float, float, float, float]
#: x, y, z of the centre (m) and w, x, y, z of the quaternion.
ObjectPose = tuple[float, float, float, float, float, float, float]

TORQUES_NM: Final = (1.18, 1.18, 1.18, 1.18)  # the data sheet's 12 kgf cm
TABLE_CENTRE_M: Final = (0.1, 0.0, -0.05)
TABLE_HALF_EXTENTS_M: Final = (0.5, 0.8, 0.05)
TABLE_COLOUR: Final = (0.87, 0.83, 0.77, 1.0)
OBSTACLE_COLOUR: Final = (0.35, 0.45, 0.55, 1.0)
OBJECT_COLOUR: Final = (0.85, 0.25, 0.15, 1.0)
PARKED_M: Final = (0.0, 0.6)  # the object's place, on the table and out of reach, until it is placed

_SLACK_RAD = 0.1  # contact may push a joint past its limit by a little, never by this much
_EXPLODED_RAD_S = 1e3
_STOP_NM = 100.0  # with which a joint is stopped at its limit, where no controller does it
_FREE_RAD_S = 100.0  # faster than a motor turns by its torque in a physics step
_RESTING_M = 1e-3  # a position may be so far from what an object that lies on the table has
_LOST_TILT = math.cos(math.radians(30.0))


def urdf() -> Path:
    """The arm as both engines read it: joints, limits, masses, and boxes and cylinders as shapes; it needs no other file."""
    with resources.as_file(resources.files("uarm_rl.sim") / "assets") as assets:
        return assets / "uarm_swift_pro.urdf"


class Scene(NamedTuple):
    """What a picture is made of: where everything is, and no engine with it."""

    joints_rad: JointPositions
    object: ObjectPose
    compression_m: float = 0.0  # of the cup's bellows
    obstacles: tuple[Box, ...] = ()


class Camera(NamedTuple):
    """Where pictures are taken from. As it is, the whole arm is in a picture that is wider than high, wherever the arm is."""

    target_m: tuple[float, float, float] = (0.14, 0.0, 0.11)
    distance_m: float = 1.15
    azimuth_deg: float = 145.0  # of the direction of sight, from x to y
    elevation_deg: float = -27.0
    view_deg: float = 30.0  # from the lower to the upper edge

    def pixel(self, width: int, height: int, point_m: Sequence[float]) -> tuple[float, float]:
        """Column and row at which a picture of that size shows a point."""
        column, row = self.pixels(width, height, np.asarray(point_m)[np.newaxis])[0].tolist()
        return column, row

    def pixels(self, width: int, height: int, points_m: Vector) -> Vector:
        """Columns and rows, shape (n, 2), at which a picture of that size shows points, shape (n, 3)."""
        right, up, ahead = self._axes() @ (points_m - np.asarray(self.target_m)).T
        scale = 0.5 * height / self._slope() / (self.distance_m + ahead)
        return np.column_stack([width / 2.0 + scale * right, height / 2.0 - scale * up])

    def fitted(self, points_m: Vector, width: int, height: int, margin: float = 0.1) -> Camera:
        """A camera that looks the same way, as near as pictures of that size show all the points, shape (n, 3)."""
        axes = self._axes()
        right, up, ahead = axes @ (points_m - np.asarray(self.target_m)).T
        slope = (1.0 - margin) * self._slope()
        edges = [
            ((across - steep * ahead).max(), (across + steep * ahead).min(), steep)
            for across, steep in ((right, slope * width / height), (up, slope))
        ]
        distance = max((high - low) / (2.0 * steep) for high, low, steep in edges)
        shift = np.array([(high + low) / 2.0 for high, low, _ in edges])
        x, y, z = (np.asarray(self.target_m) + shift @ axes[:2]).tolist()
        return self._replace(target_m=(x, y, z), distance_m=float(distance))

    def _slope(self) -> float:
        return math.tan(math.radians(self.view_deg / 2.0))

    def _axes(self) -> Vector:
        """To the right in a picture, up in it, and the direction of sight: the rows, shape (3, 3)."""
        azimuth, elevation = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        ahead = np.array(
            [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
        )
        right = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
        return np.array([right, np.cross(right, ahead), ahead])


CAMERA: Final = Camera()


class SimulatedArm(ABC):
    """``Arm`` and ``Target`` in one simulated world: arm, table and a box that lies on it.

    ``stand_at``, and with it ``home``, makes the world as if it were new, so that every episode is the same whatever ran
    before it. A copy, by ``copy.deepcopy`` or ``pickle``, has a world of its own, made anew.

    Raises :class:`ValueError` with a sentence for values out of range, :class:`ArmError` where no window can be opened.
    """

    at_rest: Final = False  # it is looked at in motion

    def __init__(
        self,
        servo: Servo | Torque,
        *,
        control_hz: int,
        physics_hz: int,
        object_size_m: float,
        object_mass_kg: float,
        friction: float,
        cup: Bellows | None = None,
        gui: bool = False,
    ) -> None:
        self._arguments: dict[str, Any] = {
            "control_hz": checks.integer("control_hz", control_hz, low=1, high=1000),
            "physics_hz": checks.integer("sim.physics_hz", physics_hz, low=120, high=10_000),
            "object_size_m": checks.number("sim.object_size_m", object_size_m, low=0.005, high=0.1),
            "object_mass_kg": checks.number("sim.object_mass_kg", object_mass_kg, low=0.0, high=1.0, open_low=True),
            "friction": checks.number("sim.friction", friction, low=0.0, high=2.0),
            "cup": cup,
            "gui": checks.boolean("sim.gui", gui),
        }
        if physics_hz % control_hz:
            raise ValueError(f"sim.physics_hz must be a multiple of control_hz ({control_hz}), got {physics_hz}")
        if gui and not self.has_screen():
            raise ArmError("sim.gui=true needs a screen, and DISPLAY names none; leave it false or start an X server")
        self._servo = servo
        self._steps_per_control = physics_hz // control_hz
        self._dt_s = 1.0 / physics_hz
        self._object_size_m = object_size_m
        self._object_mass_kg = object_mass_kg
        self._friction = friction
        self._bellows = cup
        self._obstacles: tuple[Box, ...] = ()
        self.torques_nm = TORQUES_NM  # what the motors of joint1..joint4 can give

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), **self._arguments), (self._servo,)

    @staticmethod
    def has_screen() -> bool:
        """Whether a window can be opened."""
        if not sys.platform.startswith("linux"):
            return True
        host, _, number = os.environ.get("DISPLAY", "").partition(":")
        # The engines wait for ever for a server that is named and not there; one elsewhere is taken on trust.
        return bool(number) and (host not in ("", "unix") or os.path.exists(f"/tmp/.X11-unix/X{number.split('.')[0]}"))

    # What an engine answers

    @abstractmethod
    def stand_at(self, joints_rad: Sequence[float]) -> None:
        """Make the world anew: arm at rest in that pose, object parked out of reach, no obstacles."""

    @abstractmethod
    def read_joints(self) -> JointPositions: ...

    @abstractmethod
    def advance(self) -> int: ...

    @abstractmethod
    def _put_object(self, centre_m: tuple[float, float, float]) -> None:
        """Put the object there, upright and at rest."""

    @abstractmethod
    def _object_pose(self) -> ObjectPose:
        """Where the object is and how it is turned."""

    @abstractmethod
    def contact_n(self) -> float: ...

    @abstractmethod
    def place_obstacles(self, obstacles: Sequence[Box]) -> None: ...

    @abstractmethod
    def touch_n(self) -> float: ...

    @abstractmethod
    def link_ends(self) -> Vector:
        """Ends of link1, link2, link3 and the cup as the engine has them, shape (4, 3), m."""

    @abstractmethod
    def _held_nm(self, joints: Chain) -> JointPositions:
        """The torques of joint1..joint3 that hold the arm's weight in a pose."""

    @abstractmethod
    def compression_m(self) -> float:
        """How far the bellows are pressed together; 0 for a rigid cup."""

    @abstractmethod
    def draw(self, scene: Scene, width: int, height: int, camera: Camera = CAMERA) -> NDArray[np.uint8]:
        """An RGB picture, shape (height, width, 3), of a scene, which may be of another time or arm; nothing moves for it."""

    @abstractmethod
    def close(self) -> None: ...

    # What is the same in all of them

    def scene(self) -> Scene:
        """Where everything is now."""
        return Scene(self.read_joints(), self._object_pose(), self.compression_m(), self._obstacles)

    def render(self, width: int, height: int) -> NDArray[np.uint8]:
        """An RGB picture, shape (height, width, 3), of arm and object from the side and above, as they are now."""
        return self.draw(self.scene(), width, height)

    def home(self) -> None:
        """As :meth:`stand_at`, in the home pose."""
        self.stand_at(kinematics.HOME_JOINTS_RAD.tolist())

    def _start(self, joints_rad: Sequence[float]) -> Chain:
        """The pose in which an episode begins; the servo is at rest in it."""
        joint1, joint2, joint3 = joints_rad
        self._servo.reset((joint1, joint2, joint3))
        return joint1, joint2, joint3, kinematics.level(joint2, joint3)

    def command_joints(self, reference_rad: Sequence[float]) -> None:
        if isinstance(self._servo, Torque):
            raise ArmError("this arm is told torques (servo=torque), not where to go")
        joint1, joint2, joint3 = reference_rad
        self._servo.command((joint1, joint2, joint3), self.read_joints())

    def command_torques(self, shares: Sequence[float]) -> None:
        if not isinstance(self._servo, Torque):
            raise ArmError("this arm is told where to go, not with what torque; servo=torque makes one that is")
        one, two, three = shares
        self._servo.command((one, two, three), self.read_joints())

    def _drive(self, joints: Chain, velocities: Chain) -> tuple[Chain, Chain]:
        """What the motors are asked for over the next physics step, rad/s, and the torque that each has for it, N m."""
        if isinstance(self._servo, Torque):
            return self._push(self._servo, joints, velocities)
        return self._motor_velocities(self._servo, joints, velocities), self.torques_nm

    def _push(self, servo: Torque, joints: Chain, velocities: Chain) -> tuple[Chain, Chain]:
        """As :meth:`_drive`, of motors that have a torque and no controller: any speed will do that this torque comes to.

        A joint that would leave its limits in this step is stopped there, and joint4 keeps the cup upright, as the rods do.
        """
        dt = self._dt_s
        torques = servo.torques_nm(velocities[:3], self._held_nm(joints) if servo.gravity_compensation else (0.0, 0.0, 0.0))
        one, two, three = (joint + speed * dt for joint, speed in zip(joints[:3], velocities[:3], strict=True))
        stops = kinematics.clip_to_limits(one, two, three)
        asked, force = [], []
        for joint, going, stop, torque in zip(joints[:3], (one, two, three), stops, torques, strict=True):
            free = going == stop
            asked.append(math.copysign(_FREE_RAD_S, torque) if free else (stop - joint) / dt)
            force.append(abs(torque) if free else _STOP_NM)
        a1, a2, a3 = asked
        f1, f2, f3 = force
        return (a1, a2, a3, (kinematics.level(stops[1], stops[2]) - joints[3]) / dt), (f1, f2, f3, self.torques_nm[3])

    def _motor_velocities(self, servo: Servo, joints: Chain, velocities: Chain) -> Chain:
        """What a servo asks the motors for over the next physics step, rad/s."""
        dt = self._dt_s
        q1, q2, q3, q4 = joints
        v1, v2, v3 = servo.velocity((q1, q2, q3), velocities[:3], dt)
        # The limits act as mechanical stops: no joint is driven past them, the coupled one included.
        n1, n2, n3 = kinematics.clip_to_limits(q1 + v1 * dt, q2 + v2 * dt, q3 + v3 * dt)
        return (n1 - q1) / dt, (n2 - q2) / dt, (n3 - q3) / dt, (kinematics.level(n2, n3) - q4) / dt

    def _check_motion(self, joints: JointPositions, asked: Chain) -> None:
        """Raises :class:`PhysicsError` for joints that are where no arm can be, or a servo that asks for the impossible."""
        if not (
            abs(asked[0]) + abs(asked[1]) + abs(asked[2]) < _EXPLODED_RAD_S and kinematics.within_limits(joints, _SLACK_RAD)
        ):
            places, speeds = (", ".join(f"{value:g}" for value in values[:3]) for values in (joints, asked))
            raise PhysicsError(f"the joints are at ({places}) rad, asked for ({speeds}) rad/s")

    def place_object(self, top_m: Sequence[float] | Vector) -> None:
        x, y, z = (float(value) for value in top_m)
        if not abs(z - self._object_size_m) <= _RESTING_M:
            raise ValueError(
                f"an object of {1000 * self._object_size_m:g} mm rests on the table, so its upper surface is at "
                f"{self._object_size_m:g} m, and not at {z:g} m; give that as z, or another sim.object_size_m"
            )
        self._put_object((x, y, z - self._object_size_m / 2.0))

    def object_position(self) -> tuple[float, float, float] | None:
        x, y, z, d, a, b, c = self._object_pose()
        # Third column of the rotation matrix: the direction of the box's upward normal.
        up_x, up_y, up_z = 2.0 * (a * c + b * d), 2.0 * (b * c - a * d), 1.0 - 2.0 * (a * a + b * b)
        if not (up_z >= _LOST_TILT and z >= 0.0):  # fallen over, off the table, or no number
            return None
        half = self._object_size_m / 2.0
        return x + half * up_x, y + half * up_y, z + half * up_z

    def __enter__(self) -> SimulatedArm:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
