"""The models for other programs: each is loaded by one, and its cup is where the arm's geometry has it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import uarm_rl
from uarm_rl import cli
from uarm_rl.task import kinematics

LIMITS = np.vstack([kinematics.JOINT_LIMITS_RAD, [-2.2, 0.2]])

#: The ends of link1, link2, link3 and the cup, shape (4, 3), at the angles of joint1 to joint4.
Ends = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("models") / "new"
    cli.main(["export-model", f"out={folder}"])
    return folder


def in_yourdfpy(folder: Path) -> tuple[Ends, list]:
    robot = pytest.importorskip("yourdfpy").URDF.load(str(folder / "uarm_swift_pro.urdf"))

    def ends(joints: np.ndarray) -> np.ndarray:
        robot.update_cfg(joints)
        return np.array([robot.get_transform(link)[:3, 3] for link in ("link2", "link3", "link4", "cup")])

    limits = [robot.joint_map[name].limit for name in robot.actuated_joint_names]
    return ends, [(limit.lower, limit.upper) for limit in limits]


def in_pybullet(folder: Path) -> tuple[Ends, list]:
    pytest.importorskip("pybullet", reason="pybullet is not installed", exc_type=ModuleNotFoundError)
    from uarm_rl.sim.pybullet_arm import bullet

    client = {"physicsClientId": bullet.connect(bullet.DIRECT)}
    arm = bullet.loadURDF(str(folder / "uarm_swift_pro.urdf"), useFixedBase=True, **client)

    def ends(joints: np.ndarray) -> np.ndarray:
        for joint, angle in enumerate(joints):
            bullet.resetJointState(arm, joint, angle, **client)
        states = bullet.getLinkStates(arm, (1, 2, 3, 4), computeForwardKinematics=True, **client)
        return np.array([state[4] for state in states])

    return ends, [bullet.getJointInfo(arm, joint, **client)[8:10] for joint in range(4)]


def in_mujoco(folder: Path) -> tuple[Ends, list]:
    mujoco = pytest.importorskip("uarm_rl.sim.mujoco_arm").mujoco
    model = mujoco.MjModel.from_xml_path(str(folder / "uarm_swift_pro.xml"))
    data = mujoco.MjData(model)

    def ends(joints: np.ndarray) -> np.ndarray:
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        return np.array([*(data.body(link).xpos for link in ("link2", "link3", "link4")), data.site("cup").xpos])

    return ends, [model.joint(f"joint{number}").range for number in (1, 2, 3, 4)]


@pytest.mark.parametrize("load", [in_yourdfpy, in_pybullet, in_mujoco])
def test_the_cup_is_where_the_geometry_has_it_and_the_limits_are_the_arms(folder, load):
    ends, limits = load(folder)
    assert np.allclose(limits, LIMITS, atol=1e-5)
    generator = np.random.default_rng(0)
    for _ in range(100):
        joints = kinematics.clip_to_limits(*generator.uniform(*kinematics.JOINT_LIMITS_RAD.T))
        there = ends(np.array([*joints, kinematics.level(*joints[1:])]))
        assert np.abs(there - kinematics.forward(joints)).max() < 1e-4


def test_in_mujoco_three_motors_move_the_arm_and_its_rods_keep_the_cup_upright(folder):
    mujoco = pytest.importorskip("uarm_rl.sim.mujoco_arm").mujoco
    model = mujoco.MjModel.from_xml_path(str(folder / "uarm_swift_pro.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    assert np.allclose(data.site("cup").xpos, kinematics.HOME_CUP_M, atol=1e-4)
    for name, torque_nm in (("joint1", 0.1), ("joint2", -1.0), ("joint3", 1.18)):
        data.actuator(name).ctrl = torque_nm
    mujoco.mj_step(model, data, 10)
    assert np.sign(data.qvel[:3]).tolist() == [1, -1, 1]
    mujoco.mj_step(model, data, 500)
    assert abs(data.qpos[1:].sum()) < 0.01
    assert kinematics.within_limits(data.qpos, 0.05)


def test_what_is_there_stays_as_it_is(tmp_path):
    there = tmp_path / "model" / "uarm_swift_pro.xml"
    there.parent.mkdir()
    there.write_text("mine")
    done = uarm_rl("export-model", "out=model", cwd=tmp_path)
    assert done.returncode == 2
    remedy = "remove it, or choose another folder with out=FOLDER"
    assert done.stderr == f"error: {there.relative_to(tmp_path)} exists already; {remedy}\n"
    assert there.read_text() == "mine"
    assert list(there.parent.iterdir()) == [there]


def test_without_mujoco_the_urdf_is_written_alone(tmp_path, without):
    done = uarm_rl("export-model", "out=model", cwd=tmp_path, environment=without("mujoco"))
    assert done.returncode == 0, done.stderr
    assert "without uarm_swift_pro.xml, because MuJoCo" in done.stdout
    assert [path.name for path in (tmp_path / "model").iterdir()] == ["uarm_swift_pro.urdf"]
