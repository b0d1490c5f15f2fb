"""The arm, a table and a box in MuJoCo."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uarm_rl.sim.cup import Bellows
from uarm_rl.sim.mujoco_view import View, Window, mujoco
from uarm_rl.sim.servo import Servo, Torque
from uarm_rl.sim.simulated_arm import (
    CAMERA,
    PARKED_M,
    TABLE_CENTRE_M,
    TABLE_HALF_EXTENTS_M,
    TORQUES_NM,
    Camera,
    Chain,
    ObjectPose,
    Scene,
    SimulatedArm,
    urdf,
)
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError, JointPositions
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.obstacles import Box

__all__ = ["MujocoArm", "mjcf"]

_OLDEST: Final = (3, 8)
_JOINTS: Final = ("joint1", "joint2", "joint3", "joint4")
_LIP: Final = "lip"
_SLACK_N: Final = 1e-6  # what a lip or a motor that has nothing to push with has: a row of the solver must not come and go
_ARM, _TABLE, _OBJECT, _OBSTACLE = 1, 2, 4, 8  # bits of what a shape is, and of what it touches
_TOUCHES_TABLE: Final = ("link4", "cup")  # the others stand or hang above it whatever the joints do
_CONTACT_IMPEDANCE: Final = (0.999, 0.999, 0.001, 0.5, 2.0)  # MuJoCo's usual 0.95 lets the cup 4 mm into the box
_MOTOR_IMPEDANCE: Final = (0.9999, 0.9999, 0.001, 0.5, 2.0)  # MuJoCo's highest
_MOTOR_SOFTNESS: Final = 0.01  # of what this leaves, with which the arm sags by 0.2 mm; much harder ones the solver cannot do


def read_model() -> Any:
    """The arm as MuJoCo reads it from its URDF, an ``MjSpec``; a site ``cup`` is the tip of the lip."""
    spec = mujoco.MjSpec.from_file(str(urdf()))
    spec.body("cup").add_site(name="cup")
    return spec


def mjcf() -> str:
    """The arm of :func:`read_model` as MJCF, with what a URDF cannot say.

    Motors give torques (N m) to joint1, joint2 and joint3. joint4 has none, because the arm's rods keep the cup upright: the
    tendon ``level``, joint2 + joint3 + joint4, is held at zero. The tendon ``forearm``, joint2 + joint3, has the coupled limit.
    The key ``home`` is the vendor's reset pose. Shapes of the arm touch others, not each other.
    """
    spec = read_model()
    named: Counter[str] = Counter()
    for geom in spec.geoms:
        name = f"{geom.parent.name.replace('world', 'base')}_{'collision' if geom.contype else 'visual'}"
        named[name] += 1
        geom.name, geom.conaffinity = f"{name}{named[name]}", 0
    for name, torque_nm in zip(_JOINTS[:3], TORQUES_NM[:3], strict=True):
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrlrange=(-torque_nm, torque_nm))
        motor.set_to_motor()
    forearm, level = spec.add_tendon(name="forearm", range=kinematics.FOREARM_LIMITS_RAD), spec.add_tendon(name="level")
    for tendon, joints in ((forearm, ("joint2", "joint3")), (level, ("joint2", "joint3", "joint4"))):
        for joint in joints:
            tendon.wrap_joint(joint, 1.0)
    spec.add_equality(name="level", name1="level", type=mujoco.mjtEq.mjEQ_TENDON)
    joint1, joint2, joint3 = kinematics.HOME_JOINTS_RAD.tolist()
    spec.add_key(name="home", qpos=(joint1, joint2, joint3, kinematics.level(joint2, joint3)))
    spec.compile()
    text: str = spec.to_xml()
    return text


def _name(number: int) -> str:
    """What an obstacle's shape is called."""
    return f"obstacle{number}"


def _touches(geom: Any) -> tuple[int, int]:
    """What a shape is and what it touches, as MuJoCo's bits: arm and box, box and table, hand and table; obstacles both."""
    if geom.name.startswith("obstacle"):
        return _OBSTACLE, _ARM | _OBJECT
    if geom.name == "table":
        return _TABLE, 0
    if geom.name == "object":
        return _OBJECT, _TABLE
    return _ARM, _OBJECT | (_TABLE if geom.parent.name in _TOUCHES_TABLE else 0)


class MujocoArm(SimulatedArm):
    """``Arm`` and ``Target`` in one MuJoCo world.

    *Motors.* PyBullet drives a joint by a row of its constraint solver: this velocity at the end of the step, with no more
    than this torque. The row is solved together with those of the contacts, so that a free arm follows the servo exactly and
    a blocked one pushes with its motors' whole torque and no more. MuJoCo's own servos are forces from before the contacts
    are known: stiff enough to follow exactly they shake, and softer ones are another arm. But its friction loss of a joint
    is such a row: velocity zero, with no more than this torque. So each joint has its motor's torque as friction loss, and
    between the halves of a step (``mj_step1``, ``mj_step2``) the velocity that the servo asks for takes the place of zero.
    The servo looks at the joints before every physics step, which is why a control step is not one ``mj_step`` of many.

    *Contacts* are as stiff as the time step allows (a time constant of two steps). Shapes of the arm do not touch each other,
    nor the table where they never could. A box that lies still sleeps until something comes to it.
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
        cup: Bellows | None = None,
        gui: bool = False,
    ) -> None:
        if tuple(map(int, mujoco.__version__.split(".")[:2])) < _OLDEST:
            raise ArmError(
                f"MuJoCo {mujoco.__version__} is too old: {'.'.join(map(str, _OLDEST))} is the oldest that works; "
                "pip install --upgrade mujoco"
            )
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
        self._driven = 5 if cup else 4  # the joints, and the lip
        self._build()
        self._view: View | None = None
        self._window = Window(object_size_m) if gui else None
        self.home()

    def _build(self) -> None:
        """Make a world with the obstacles that there are."""
        model, driven = self._spec().compile(), self._driven
        # Friction loss comes first among the constraints, in the order of the joints; nothing may stand before it.
        assert model.neq == 0
        assert model.jnt_dofadr[:driven].tolist() == list(range(driven))
        model.dof_invweight0[:driven] *= _MOTOR_SOFTNESS
        self._model, self._data = model, mujoco.MjData(model)
        data = self._data
        self._angles, self._speeds, self._first_guess = data.qpos[:driven], data.qvel[:driven], data.qacc_warmstart[:driven]
        self._joined = model.jnt_bodyid[:3]
        self._links = [model.body(name).id for name in ("link2", "link3", "link4")]
        self._cup = model.site("cup").id
        self._touching = {model.geom("cup").id, model.geom("object").id}
        self._in_the_way = {model.geom(_name(number)).id for number in range(len(self._obstacles))}
        self._parts = {number for number in range(model.ngeom) if model.geom_contype[number] == _ARM}

    def _spec(self) -> Any:
        """Arm, table, box and obstacles, without the shapes that are only looked at."""
        spec = read_model()
        if self._bellows is not None:
            lip = spec.body("cup")
            lip.mass = self._bellows.mass_kg
            lip.add_joint(name=_LIP, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0, 0, 1))
        for geom in spec.geoms:
            if not geom.contype:
                spec.delete(geom)
        option, dt, half = spec.option, self._dt_s, self._object_size_m / 2.0
        option.timestep = dt
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_SENSOR
        option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        spec.body("link1").sleep = mujoco.mjtSleepPolicy.mjSLEEP_NEVER
        box, table = mujoco.mjtGeom.mjGEOM_BOX, spec.worldbody
        table.add_geom(name="table", type=box, pos=TABLE_CENTRE_M, size=TABLE_HALF_EXTENTS_M)
        thing = spec.worldbody.add_body(name="object", pos=(*PARKED_M, half))
        thing.add_freejoint()
        thing.add_geom(name="object", type=box, size=(half, half, half), mass=self._object_mass_kg)
        for number, obstacle in enumerate(self._obstacles):
            sides = [side / 2.0 for side in obstacle.size_m]
            spec.worldbody.add_geom(name=_name(number), type=box, pos=obstacle.centre_m, size=sides)
        for geom in spec.geoms:
            if geom.contype:
                geom.name = geom.name or geom.parent.name
                geom.contype, geom.conaffinity = _touches(geom)
                geom.friction[0] = self._friction
                geom.solref, geom.solimp = (2.0 * dt, 1.0), _CONTACT_IMPEDANCE
        effort = dict(zip(_JOINTS, self.torques_nm, strict=True)) | ({_LIP: _SLACK_N} if self._bellows else {})
        for name, torque_nm in effort.items():
            joint = spec.joint(name)
            joint.frictionloss = torque_nm
            joint.solimp_friction = _MOTOR_IMPEDANCE
            joint.solref_limit, joint.solimp_limit = (2.0 * dt, 1.0), _CONTACT_IMPEDANCE
        return spec

    def stand_at(self, joints_rad: Sequence[float]) -> None:
        if self._obstacles:
            self._obstacles = ()
            self._build()
        model, data = self._model, self._data
        mujoco.mj_resetData(model, data)
        self._angles[:4] = self._start(joints_rad)
        self._look()

    def read_joints(self) -> JointPositions:
        q1, q2, q3 = self._angles[:3].tolist()
        return q1, q2, q3

    def advance(self) -> int:
        model, data, dt = self._model, self._data, self._dt_s
        angles, speeds, first_guess, drive = self._angles, self._speeds, self._first_guess, self._drive
        bellows, told = self._bellows, isinstance(self._servo, Torque)
        for _ in range(self._steps_per_control):
            v1, v2, v3, v4, *lip_speed = speeds.tolist()
            q1, q2, q3, q4, *lip = angles.tolist()
            asked, torques_nm = drive((q1, q2, q3, q4), (v1, v2, v3, v4))
            w1, w2, w3, w4 = asked
            if told:
                model.dof_frictionloss[:4] = [max(torque, _SLACK_N) for torque in torques_nm]
            if bellows is not None:
                velocity, force = bellows.push(lip[0])
                model.dof_frictionloss[4] = max(force, _SLACK_N)
            mujoco.mj_step1(model, data)
            wanted = data.efc_aref
            # The solver begins where every motor does what it is asked: if they all can, it is there already.
            wanted[0] = first_guess[0] = (w1 - v1) / dt
            wanted[1] = first_guess[1] = (w2 - v2) / dt
            wanted[2] = first_guess[2] = (w3 - v3) / dt
            wanted[3] = first_guess[3] = (w4 - v4) / dt
            if bellows is not None:
                wanted[4] = first_guess[4] = (velocity - lip_speed[0]) / dt
            mujoco.mj_step2(model, data)
        self._check_motion(self.read_joints(), asked)
        if self._window is not None:
            self._window.show(self.scene())
        return 1

    def place_obstacles(self, obstacles: Sequence[Box]) -> None:
        if tuple(obstacles) != self._obstacles:  # a compiled world has as many shapes as it has
            before, self._obstacles = self._data, tuple(obstacles)
            self._build()
            for name in ("qpos", "qvel", "qacc_warmstart"):
                getattr(self._data, name)[:] = getattr(before, name)
            self._look()

    def _look(self) -> None:
        """Take note of where the arm is: links, and centres of mass."""
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)

    def touch_n(self) -> float:
        return self._force_n(self._parts, self._in_the_way) if self._in_the_way else 0.0

    def _put_object(self, centre_m: tuple[float, float, float]) -> None:
        n = self._driven
        self._data.qpos[n : n + 7] = (*centre_m, 1.0, 0.0, 0.0, 0.0)  # which wakes it
        self._data.qvel[n : n + 6] = 0.0

    def _object_pose(self) -> ObjectPose:
        x, y, z, w, a, b, c = self._data.qpos[self._driven : self._driven + 7].tolist()
        return x, y, z, w, a, b, c

    def contact_n(self) -> float:
        return self._force_n(self._touching, self._touching)

    def _force_n(self, these: set[int], those: set[int]) -> float:
        """The normal force (N) between shapes of two sets."""
        model, data, force, total = self._model, self._data, np.zeros(6), 0.0
        for number in range(data.ncon):
            one, other = data.contact.geom[number].tolist()
            if (one in these and other in those) or (other in these and one in those):
                mujoco.mj_contactForce(model, data, number, force)
                total += float(force[0])
        return total

    def _held_nm(self, joints: Chain) -> JointPositions:
        model, data, bodies = self._model, self._data, self._joined
        arms = data.subtree_com[bodies] - data.xanchor[:3]  # as they were before the last physics step
        moments = np.cross(arms, model.body_subtreemass[bodies, np.newaxis] * model.opt.gravity)
        one, two, three = (-np.sum(data.xaxis[:3] * moments, axis=1)).tolist()
        return one, two, three

    def link_ends(self) -> Vector:
        mujoco.mj_kinematics(self._model, self._data)
        return np.array([*self._data.xpos[self._links], self._data.site_xpos[self._cup]])

    def compression_m(self) -> float:
        return float(self._angles[4]) if self._bellows else 0.0

    def draw(self, scene: Scene, width: int, height: int, camera: Camera = CAMERA) -> NDArray[np.uint8]:
        if self._view is None or self._view.size != (width, height):
            if self._view is not None:
                self._view.close()
            self._view = View(self._object_size_m, (width, height))
        return self._view.picture(scene, camera)

    def close(self) -> None:
        for part in (self._view, self._window):
            if part is not None:
                part.close()
        self._view = self._window = None
