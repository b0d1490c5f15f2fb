"""The world behind the emulated firmware: the simulated arm, table and box, with suction, play and sagging motors.

Arm, table, box and solver settings are those of ``sim``; here the motors follow the firmware's step pulses, and the
cup can hold the box.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator, Sequence
from itertools import islice
from types import TracebackType
from typing import Any, Final

import numpy as np

from uarm_rl import checks
from uarm_rl.emulator.firmware import PARKED_DEG
from uarm_rl.emulator.motion import MotorAngles, with_play
from uarm_rl.emulator.view import NEAREST_M, View, clockwise, projection
from uarm_rl.sim.cup import Bellows
from uarm_rl.sim.pybullet_arm import SimArm, bullet
from uarm_rl.task import kinematics, positions
from uarm_rl.task.arm import JointPositions
from uarm_rl.task.kinematics import CUP_RADIUS_M, Vector
from uarm_rl.task.obstacles import Box

log = logging.getLogger(__name__)

#: Centre of the object's upper surface (m) and how far the object is turned about the vertical (rad).
Place = tuple[Sequence[float] | Vector, float]

_NEAR_M: Final = 0.002  # a gap that the lip closes: the real one is 1.4 mm softer, PyBullet stops a rigid one 1.1 mm off
_TOUCHES_M: Final = 0.0005  # bellows touch where their lip is
_FULL_STEP_DEG: Final = 1.8 / 4.5  # of a motor, at the joint behind its gear: 32 microsteps of 0.0125 degrees
_HARD_N: Final = 5.0  # more than it takes to flatten the bellows twice over
_HARD_S: Final = 0.05  # for so long: a blow is no press
_SQUEEZED_M: Final = 0.005
_UPRIGHT: Final = math.cos(math.radians(8.0))
_OVERLOAD_S: Final = 0.02  # of pulling too hard, until the seal breaks
_PRESSED_N: Final = 0.5  # that close the contact at the hand; not documented
# A motor without current brakes a little, through its gear; less than it takes to hold the stretched arm up.
_LIMP_NM: Final = (0.05, 0.05, 0.05, 1.18)  # joint4 is a linkage, not a motor
_LIFTED_M: Final = 0.01
_CLEAR_M: Final = 0.06  # between cup and object, for a hand that takes the object away
_CLEAR_S: Final = 0.5
_LOOK_S: Final = 0.1  # how often that hand looks
_MOVED_M: Final = 0.005
_TABLE_TOP: Final = (0.5, 0.8)  # m from its centre to its edges
_HOLDS_AT_MOST: Final = 10.0  # times the suction; more than the seal is ever asked to bear before it breaks


class World:
    """The ``Joints`` of an emulated firmware, over PyBullet; a context manager.

    Physics advances with the firmware's clock, in steps of ``1 / physics_hz``. The object starts at the first of
    ``places``; with ``replace_object`` somebody puts it at the next one after it was lifted and let go, fell over, or was
    pushed out of reach or nearer than ``nearest_m`` to the base's axis, as soon as the cup is clear of it. All methods may
    be called from any thread.

    ``obstacles`` stand there for good. ``backlash_deg``: play of each joint. ``suction_n``: what the seal bears, less in
    shear (friction). ``grip_s``: how long the cup must be sealed before it holds. ``paint``: red, green, blue of the box, 0
    to 1.
    """

    def __init__(
        self,
        places: Iterator[Place],
        *,
        physics_hz: int,
        object_size_m: float,
        object_mass_kg: float,
        friction: float,
        exact_cup: bool = False,
        cup: Bellows | None = None,
        gui: bool = False,
        obstacles: Sequence[Box] = (),
        replace_object: bool = False,
        nearest_m: float = 0.0,
        backlash_deg: float = 0.0,
        suction_n: float = 9.4,
        grip_s: float = 0.0,
        paint: Sequence[float] = (0.85, 0.15, 0.1),
    ) -> None:
        self._motors = _Motors()
        self._replace_object = checks.boolean("replace_object", replace_object)
        self._nearest_m = nearest_m
        self._arm = SimArm(
            self._motors,
            control_hz=physics_hz,
            physics_hz=physics_hz,
            object_size_m=object_size_m,
            object_mass_kg=object_mass_kg,
            friction=friction,
            exact_cup=exact_cup,
            cup=cup,
            gui=gui,
        )
        #: Degrees by which the joints B, L, R stand behind the step pulses, and how often the cup pressed something too hard.
        self.lost_deg = [0.0, 0.0, 0.0]
        self.hard_presses = 0
        self._slipping = False
        self._hard_s = 0.0
        self._near_m = _TOUCHES_M if cup else _NEAR_M
        self._powered_nm = self._arm.torques_nm
        self._dt_s = 1.0 / physics_hz
        self._half_m = 0.5 * object_size_m
        self._friction = max(friction, 1e-3)
        self._backlash_deg = backlash_deg
        self._suction_n = suction_n
        self._grip_s = grip_s
        self._places = places
        self._lock = threading.RLock()
        self._due_s = 0.0  # time that is still to be simulated
        self._reference_deg: MotorAngles | None = None  # what the gears ask of the joints; None: the motors are limp
        self._sucking = False
        self._sealed_on: str | None = None
        self._sealed_s = self._overload_s = self._clear_s = self._looked_s = 0.0
        self._constraint: int | None = None  # PyBullet's number of what joins cup and object
        self._lifted = self._pressed = False
        self._start(gui, paint, obstacles)
        self._put_object(next(places))

    def _start(self, gui: bool, paint: Sequence[float], obstacles: Sequence[Box]) -> None:
        client, arm, _, box, table = self._arm.bodies
        joints = kinematics.from_motor_deg(*PARKED_DEG).tolist()
        for joint, angle in enumerate((*joints, kinematics.level(joints[1], joints[2]))):
            bullet.resetJointState(arm, joint, angle, physicsClientId=client)
        self._arm.place_obstacles(obstacles)
        bullet.changeVisualShape(box, -1, rgbaColor=(*paint, 1.0), physicsClientId=client)
        if not gui:  # a plain that fills the picture costs more to draw than all the rest
            bullet.changeVisualShape(table, -1, rgbaColor=(0.0, 0.0, 0.0, 0.0), physicsClientId=client)

    # The firmware's side

    def drive(self, motor_deg: MotorAngles | None, dt_s: float) -> None:
        """Let ``dt_s`` pass while the motors ask for ``motor_deg``, or are limp (``None``)."""
        with self._lock:
            if motor_deg is None:
                self._reference_deg = self._motors.target = None
            else:
                b, left, right = (angle - lost for angle, lost in zip(motor_deg, self.lost_deg, strict=True))
                self._reference_deg = with_play(self._reference_deg or self.motor_deg(), (b, left, right), self._backlash_deg)
                joint1, joint2, joint3 = kinematics.from_motor_deg(*self._reference_deg).tolist()
                self._motors.target = joint1, joint2, joint3
            self._arm.torques_nm = _LIMP_NM if motor_deg is None else self._powered_nm
            self._due_s += dt_s
            while self._due_s >= self._dt_s:
                self._due_s -= self._dt_s
                self._step()
                if self._reference_deg is not None:
                    self._slip(self._reference_deg)

    def _slip(self, wanted_deg: MotorAngles) -> None:
        """A stepper that is held back by more than a full step loses what is beyond it, and nobody tells the firmware."""
        beyond = []
        for wanted, at in zip(wanted_deg, self.motor_deg(), strict=True):
            beyond.append(math.copysign(max(0.0, abs(wanted - at) - _FULL_STEP_DEG), wanted - at))
        self.lost_deg = [lost + more for lost, more in zip(self.lost_deg, beyond, strict=True)]
        slipping = any(beyond)
        if slipping and not self._slipping:
            log.warning("the motors lose steps: something holds the arm back")
        self._slipping = slipping

    def resynchronise(self) -> None:
        """The firmware takes the encoders' word for where the motors are."""
        with self._lock:
            self.lost_deg = [0.0, 0.0, 0.0]

    def motor_deg(self) -> MotorAngles:
        """Where the joints really are."""
        with self._lock:
            return kinematics.to_motor_deg(self._arm.read_joints())

    def suck(self, on: bool) -> None:
        """Switch the pump."""
        with self._lock:
            self._sucking = on
            if not on:
                self._let_go()

    def holding(self) -> bool:
        """Whether something seals the cup while the pump runs: the object, or the table."""
        return self.held or (self._sucking and self._sealed_on == "table" and self._sealed_s >= self._grip_s)

    def tip_pressed(self) -> bool:
        """Whether the contact at the hand is closed."""
        return self._pressed

    # The bystander's side

    @property
    def held(self) -> bool:
        """Whether the object hangs on the cup."""
        return self._constraint is not None

    def object_position(self) -> tuple[float, float, float] | None:
        """Centre of the object's upper surface (m), or ``None`` if it has fallen over or off the table."""
        with self._lock:
            return self._arm.object_position()

    def place_object(self, top_m: Sequence[float] | Vector, yaw_rad: float = 0.0) -> None:
        """Put the object so that the centre of its upper surface is at ``top_m``, at rest."""
        with self._lock:
            self._put_object((top_m, yaw_rad))

    def cup_pose(self) -> Vector:
        """The cup's frame in the base's, (4, 4): origin at its tip when nothing presses it, x forward along the arm, z up."""
        with self._lock:
            state, compressed_m = self._cup_state(), self._arm.compression_m()
        pose = np.eye(4)
        pose[:3, :3] = np.reshape(bullet.getMatrixFromQuaternion(state[5]), (3, 3))
        pose[:3, 3] = state[4] - compressed_m * pose[:3, 2]
        return pose

    def view(self, camera_matrix: Vector, size: tuple[int, int], cup_from_camera: Vector) -> View:
        """What a pinhole camera (3, 3) on the cup's frame sees; ``size`` is (w, h), z of the camera points ahead."""
        client, _, _, box, table = self._arm.bodies
        width, height = size
        with self._lock:
            base_from_camera = self.cup_pose() @ cup_from_camera
            # From x right, y down, z ahead to OpenGL's x right, y up, z back.
            seen_from = np.linalg.inv(base_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0]))
            picture = bullet.getCameraImage(
                width,
                height,
                seen_from.T.ravel().tolist(),
                projection(camera_matrix, size).T.ravel().tolist(),
                lightDirection=(0.5, -0.7, 1.5),
                lightColor=(1.0, 1.0, 1.0),
                lightAmbientCoeff=0.55,
                lightDiffuseCoeff=0.45,
                lightSpecularCoeff=0.0,
                shadow=0,
                renderer=bullet.ER_TINY_RENDERER,
                physicsClientId=client,
            )
            corners = self._top_corners()
        bodies = np.asarray(picture[4]).reshape(height, width)
        colours = np.asarray(picture[2], np.uint8).reshape(height, width, 4)[:, :, :3]
        from_camera = (np.linalg.inv(base_from_camera) @ np.c_[corners, np.ones(4)].T)[:3]
        seen_px = camera_matrix @ from_camera
        top_px = (seen_px[:2] / seen_px[2]).T
        in_front = bool(np.all(from_camera[2] > NEAREST_M)) and clockwise(top_px)
        return View(colours, (bodies == -1) | (bodies == table), bodies == box, top_px if in_front else None)

    def close(self) -> None:
        """End the world; closing twice is fine."""
        with self._lock:
            self._arm.close()

    def __enter__(self) -> World:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    # Physics

    def _step(self) -> None:
        self._arm.advance()
        cup = self._cup_state()[4]
        before_s = self._hard_s
        self._hard_s = before_s + self._dt_s if self._arm.contact_n() > _HARD_N else 0.0
        if before_s < _HARD_S <= self._hard_s:
            self.hard_presses += 1
            log.warning("the cup presses the object with more than %g N", _HARD_N)
        self._sealed_on = self._seal(cup)
        self._sealed_s = self._sealed_s + self._dt_s if self._sealed_on and self._sucking else 0.0
        if self._constraint is None:
            self._pressed = self._contact_n() >= _PRESSED_N
            if self._sealed_on == "object" and self._sucking and self._sealed_s >= self._grip_s:
                self._take_hold()
        else:
            self._bear()
        if self._replace_object:
            self._looked_s += self._dt_s
            if self._looked_s >= _LOOK_S:
                self._look(cup)

    def _cup_state(self) -> Any:
        client, arm, link, *_ = self._arm.bodies
        return bullet.getLinkState(arm, link, computeForwardKinematics=True, physicsClientId=client)

    def _object_pose(self) -> Any:
        bodies = self._arm.bodies
        return bullet.getBasePositionAndOrientation(bodies.object, physicsClientId=bodies.client)

    def _seal(self, cup_m: Sequence[float]) -> str | None:
        """What closes the lip all around."""
        half, (position, orientation) = self._half_m, self._object_pose()
        (x, y, z), _ = bullet.multiplyTransforms(*bullet.invertTransform(position, orientation), cup_m, (0, 0, 0, 1))
        upright = bullet.getMatrixFromQuaternion(orientation)[8]
        inside = half - CUP_RADIUS_M
        if upright >= _UPRIGHT and abs(x) <= inside and abs(y) <= inside and -_SQUEEZED_M <= z - half <= self._near_m:
            return "object"
        beside = max(abs(x), abs(y)) > half + CUP_RADIUS_M
        on_table = abs(cup_m[0] - 0.1) <= _TABLE_TOP[0] - CUP_RADIUS_M and abs(cup_m[1]) <= _TABLE_TOP[1] - CUP_RADIUS_M
        return "table" if cup_m[2] <= self._near_m and beside and on_table else None

    def _contact_n(self) -> float:
        client, arm, link, *_ = self._arm.bodies
        contacts = bullet.getContactPoints(bodyA=arm, linkIndexA=link, physicsClientId=client)
        return float(sum(contact[9] for contact in contacts))

    def _take_hold(self) -> None:
        client, arm, link, box, _ = self._arm.bodies
        centre_of_mass = self._cup_state()[:2]
        position, orientation = bullet.multiplyTransforms(*bullet.invertTransform(*centre_of_mass), *self._object_pose())
        bullet.setCollisionFilterPair(arm, box, link, -1, 0, physicsClientId=client)  # the constraint takes over
        self._constraint = bullet.createConstraint(
            arm, link, box, -1, bullet.JOINT_FIXED, (0, 0, 0), position, (0, 0, 0), orientation, physicsClientId=client
        )
        bullet.changeConstraint(self._constraint, maxForce=_HOLDS_AT_MOST * self._suction_n, physicsClientId=client)
        self._overload_s, self._lifted = 0.0, False

    def _bear(self) -> None:
        """Feel what the seal has to bear; it breaks when that is too much."""
        x, y, z = bullet.getConstraintState(self._constraint, physicsClientId=self._arm.bodies.client)[:3]
        self._pressed = z >= _PRESSED_N
        (_, _, height), _ = self._object_pose()
        self._lifted |= height > self._half_m + _LIFTED_M
        overload = math.hypot(x, y) / self._friction - z > self._suction_n
        self._overload_s = self._overload_s + self._dt_s if overload else 0.0
        if self._overload_s >= _OVERLOAD_S:
            log.info("the object is torn off the cup")
            self._let_go()

    def _let_go(self) -> None:
        if self._constraint is None:
            return
        client, arm, link, box, _ = self._arm.bodies
        bullet.removeConstraint(self._constraint, physicsClientId=client)
        bullet.setCollisionFilterPair(arm, box, link, -1, 1, physicsClientId=client)
        self._constraint = None
        self._sealed_s = 0.0

    # Somebody who puts the object elsewhere

    def _look(self, cup_m: Sequence[float]) -> None:
        elapsed_s, self._looked_s = self._looked_s, 0.0
        clear = not self.held and math.dist(cup_m, self._object_pose()[0]) > _CLEAR_M
        self._clear_s = self._clear_s + elapsed_s if clear else 0.0
        if self._clear_s >= _CLEAR_S and (self._lifted or self._out_of_reach()):
            away = (place for place in islice(self._places, 100) if math.dist(place[0][:2], cup_m[:2]) > _CLEAR_M)
            if (place := next(away, None)) is not None:
                self._put_object(place)

    def _out_of_reach(self) -> bool:
        top_m = self._arm.object_position()
        if top_m is None:
            return True
        near = math.hypot(*top_m[:2]) < self._nearest_m
        return math.dist(top_m, self._placed_m) > _MOVED_M and (near or not positions.in_operating_range(np.array(top_m)))

    def _put_object(self, place: Place) -> None:
        (x, y, z), yaw_rad = place
        self._let_go()
        client, box = self._arm.bodies.client, self._arm.bodies.object
        turn = bullet.getQuaternionFromEuler((0.0, 0.0, yaw_rad))
        bullet.resetBasePositionAndOrientation(box, (x, y, z - self._half_m), turn, physicsClientId=client)
        bullet.resetBaseVelocity(box, (0, 0, 0), (0, 0, 0), physicsClientId=client)
        self._placed_m = float(x), float(y), float(z)
        self._lifted, self._clear_s = False, 0.0
        log.info("the object lies at (%.1f, %.1f, %.1f) mm", 1000.0 * x, 1000.0 * y, 1000.0 * z)

    def _top_corners(self) -> Vector:
        """Corners of the object's upper surface, (4, 3): clockwise as seen from above."""
        half, (position, orientation) = self._half_m, self._object_pose()
        corners = np.array([(half, half, half), (half, -half, half), (-half, -half, half), (-half, half, half)])
        rotation = np.reshape(bullet.getMatrixFromQuaternion(orientation), (3, 3))
        top: Vector = corners @ rotation.T + position
        return top


class _Motors:
    """The servo of the simulated arm: joints that follow the step pulses, or only brake."""

    def __init__(self) -> None:
        self.target: JointPositions | None = None

    def reset(self, joints: JointPositions) -> None:
        self.target = joints

    def command(self, reference: JointPositions, joints: JointPositions) -> None:
        self.target = reference

    def velocity(self, joints: JointPositions, velocity: JointPositions, dt: float) -> JointPositions:
        if self.target is None:
            return 0.0, 0.0, 0.0
        (r1, r2, r3), (q1, q2, q3) = self.target, joints
        return (r1 - q1) / dt, (r2 - q2) / dt, (r3 - q3) / dt
