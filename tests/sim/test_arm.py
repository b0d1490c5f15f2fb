"""The simulated world, in every engine: geometry, limits, contact, determinism, lifetime."""

from __future__ import annotations

import copy
import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.conftest import ENGINES, make_arm
from uarm_rl.sim.simulated_arm import CAMERA, SimulatedArm
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError, PhysicsError
from uarm_rl.task.obstacles import Box


def run(arm: SimulatedArm, reference: np.ndarray, control_steps: int = 60) -> np.ndarray:
    arm.command_joints(kinematics.clip_to_limits(*reference))
    for _ in range(control_steps):
        arm.advance()
    return np.array(arm.read_joints())


@pytest.fixture(scope="module", params=ENGINES)
def arm(request):
    with make_arm(request.param) as one:
        yield one


@pytest.fixture
def engines():
    """An arm in each engine."""
    for name in ("pybullet", "mujoco"):
        pytest.importorskip(name, reason=f"{name} is not installed")
    with make_arm("pybullet") as one, make_arm("mujoco") as other:
        yield one, other


unit = st.floats(0, 1)


@settings(max_examples=30)
@given(st.tuples(unit, unit, unit))
def test_engine_and_forward_kinematics_agree(arm, share):
    low, high = kinematics.JOINT_LIMITS_RAD.T
    reference = np.array(kinematics.clip_to_limits(*(low + share * (high - low))))
    assume(kinematics.cup_position(reference)[2] > 0.005)  # above the table
    arm.home()
    joints = run(arm, reference)
    assert joints == pytest.approx(reference, abs=0.005)
    assert np.abs(arm.link_ends() - kinematics.forward(joints)).max() < 1e-4


@settings(max_examples=20)
@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 3), min_size=1, max_size=8))
def test_no_command_drives_a_joint_past_its_limits(arm, actions):
    arm.home()
    for action in actions:
        joints = run(arm, np.array(arm.read_joints()) + 0.8 * np.array(action), 4)
        assert kinematics.within_limits(joints, tolerance_rad=0.002)


def test_link4_stays_level(engine):
    with make_arm(engine) as arm:
        for reference in ([0.5, 0.3, 0.6], [-0.5, -0.4, 0.9], [0.0, 0.2, -0.1]):
            arm.command_joints(reference)
            for _ in range(20):
                arm.advance()
                wrist, cup = arm.link_ends()[2:]
                assert wrist[2] - cup[2] == pytest.approx(kinematics.CUP_DOWN_M, abs=1e-4)


def test_a_resting_object_stays_where_it_was_put(engine):
    with make_arm(engine) as arm:
        arm.place_object((0.2, -0.1, 0.03))
        for _ in range(200):
            arm.advance()
        assert arm.object_position() == pytest.approx((0.2, -0.1, 0.03), abs=1e-4)


def test_the_cup_pushes_the_object_aside(engine):
    with make_arm(engine) as arm:
        arm.place_object((0.2, 0.05, 0.03))
        beside = kinematics.inverse((0.2, 0.0, 0.02))
        run(arm, beside)
        run(arm, kinematics.inverse((0.2, 0.05, 0.02)))
        _, y, z = arm.object_position()
        assert y > 0.065
        assert z == pytest.approx(0.03, abs=0.001)


@pytest.mark.parametrize(
    ("cup", "gap_m"),
    [("pybullet", 0.00097), ("pybullet sim.exact_cup=true", 0.0), ("mujoco", 0.0)],
    ids=["hull", "lip", "mujoco"],
)
def test_the_rigid_cup_rests_on_object_and_table(cup, gap_m):
    """PyBullet's hull of the cup stands 0.97 mm proud of it; the others touch where its lip is drawn."""
    engine, *overrides = cup.split()
    pytest.importorskip(engine, reason=f"{engine} is not installed")
    with make_arm(engine, *overrides) as arm:
        arm.place_object((0.2, 0.0, 0.03))
        joints = run(arm, kinematics.inverse((0.2, 0.0, 0.025)), 60)
        x, y, top_m = arm.object_position()
        assert kinematics.cup_position(joints)[2] - top_m == pytest.approx(gap_m, abs=5e-5)
        assert (x, y) == pytest.approx((0.2, 0.0), abs=0.005)
        joints = run(arm, kinematics.inverse((0.25, 0.1, -0.03)))
        assert kinematics.cup_position(joints)[2] == pytest.approx(gap_m, abs=5e-5)


def test_a_blocked_arm_pushes_with_its_motors_torque_and_no_more(engine):
    """Level with the box it can push with 1.18 N m / 0.2 m = 6 N; 1 kg with a friction of at least 2 stands, and holds it."""
    with make_arm(engine, "sim.object_mass_kg=1", "sim.friction=2") as arm:
        arm.place_object((0.2, 0.04, 0.03))
        joints = run(arm, kinematics.inverse((0.2, 0.0, 0.015)))
        joints = run(arm, kinematics.inverse((0.2, 0.04, 0.015)))
        assert arm.object_position() == pytest.approx((0.2, 0.04, 0.03), abs=0.001)
        assert kinematics.cup_position(joints)[1] == pytest.approx(0.04 - 0.015 - 0.0095, abs=0.0015)


def test_a_toppled_object_is_lost(engine):
    with make_arm(engine) as arm:
        arm.place_object((0.2, 0.1, 0.03))
        assert arm.object_position() is not None
        arm.place_object((2.0, 0.1, 0.03))  # beside the table: it falls
        for _ in range(40):
            arm.advance()
        assert arm.object_position() is None


def trajectory(arm: SimulatedArm, seed: int) -> bytes:
    """An episode with contact, as bytes."""
    generator = np.random.default_rng(seed)
    arm.home()
    arm.place_object((0.22, 0.02, 0.03))
    rows = []
    for reference in (kinematics.inverse((0.2, -0.03, 0.02)), kinematics.inverse((0.24, 0.06, 0.02))):
        for _ in range(15):
            arm.command_joints(kinematics.clip_to_limits(*(reference + generator.normal(0, 0.02, 3))))
            arm.advance()
            rows.append((*arm.read_joints(), *(arm.object_position() or (0, 0, 0))))
    return np.array(rows).tobytes()


def test_episodes_repeat_to_the_last_bit_whatever_ran_before(engine):
    with make_arm(engine) as fresh:
        expected = [trajectory(fresh, seed) for seed in (0,)]
    with make_arm(engine) as used:
        for seed in (5, 6, 7):
            trajectory(used, seed)
        assert [trajectory(used, seed) for seed in (0,)] == expected
        assert trajectory(used, 1) != expected[0]


def test_a_new_process_repeats_them(engine):
    code = (
        "import hashlib; from tests.sim.test_arm import make_arm, trajectory\n"
        f"with make_arm({engine!r}) as arm: print(hashlib.sha256(trajectory(arm, 0)).hexdigest())"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    with make_arm(engine) as arm:
        assert run.stdout.split()[-1] == hashlib.sha256(trajectory(arm, 0)).hexdigest()


def test_a_copy_is_another_world(engine):
    with make_arm(engine) as arm, copy.deepcopy(arm) as other:
        before = other.read_joints()
        run(arm, kinematics.inverse((0.25, 0.1, 0.1)), 5)
        assert other.read_joints() == before
        assert trajectory(other, 0) == trajectory(arm, 0)


def test_engines_move_alike(engines):
    """Ten seconds of steps in the air, new ones before the last have ended: 0.01 mm; agreement on contact is not promised."""
    one, other = engines
    generator = np.random.default_rng(0)
    apart = 0.0
    for _ in range(50):
        reference = kinematics.clip_to_limits(*(np.array(one.read_joints()) + generator.uniform(-0.15, 0.15, 3)))
        if kinematics.cup_position(reference)[2] < 0.06:
            continue
        for arm in engines:
            arm.command_joints(reference)
        for _ in range(4):
            for arm in engines:
                arm.advance()
            apart = max(apart, np.abs(one.link_ends() - other.link_ends()).max())
    assert apart < 1e-5


def test_pictures_show_the_same(engines):
    """Where the box is red, and the white above the table, to a pixel or two."""
    reds = []
    for arm in engines:
        arm.place_object((0.22, 0.05, 0.03))
        try:
            picture = arm.render(320, 240).astype(int)
        except ArmError as error:
            pytest.skip(str(error))
        red = (picture[:, :, 0] > 90) & (picture[:, :, 1:].max(axis=2) < 0.5 * picture[:, :, 0])
        reds.append(red)
        column, row = CAMERA.pixel(320, 240, (0.22, 0.05, 0.015))
        assert red[round(row), round(column)]
    assert np.logical_xor(*reds).sum() < 0.2 * reds[0].sum()


def test_pictures_show_the_obstacles_of_the_scene_and_no_others(engines):
    for arm in engines:
        try:
            empty = arm.render(320, 240).astype(int)
        except ArmError as error:
            pytest.skip(str(error))
        places = [(0.25, -0.12, 0.03), (0.1, 0.25, 0.05)]
        for x, y, z in places:
            arm.place_obstacles([Box((x, y, z), (0.04, 0.04, 2.0 * z))])
            changed = np.abs(arm.render(320, 240).astype(int) - empty).max(axis=2) > 40
            seen = [changed[round(row), round(column)] for column, row in (CAMERA.pixel(320, 240, place) for place in places)]
            assert seen == [place == (x, y, z) for place in places]
        arm.place_obstacles([])
        assert np.array_equal(arm.render(320, 240), empty)


def test_mujoco_without_a_way_to_draw_says_so():
    """A process of its own: how MuJoCo draws is settled when it is imported."""
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    code = "from tests.conftest import make_arm\nwith make_arm('mujoco') as arm: arm.render(64, 64)"
    environment = {key: value for key, value in os.environ.items() if key != "DISPLAY"} | {"MUJOCO_GL": "disable"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert "ArmError: MuJoCo cannot draw here: it needs a screen, or EGL" in run.stderr


def test_an_explosion_is_an_exception_and_leaves_no_file(tmp_path, monkeypatch):
    mujoco_arm = pytest.importorskip("uarm_rl.sim.mujoco_arm", reason="mujoco is not installed", exc_type=ImportError)
    monkeypatch.chdir(tmp_path)
    step = mujoco_arm.mujoco.mj_step2

    def explode(model, data):
        data.qvel[0] = 1e300
        step(model, data)

    with make_arm("mujoco") as arm:
        monkeypatch.setattr(mujoco_arm.mujoco, "mj_step2", explode)
        with pytest.raises(PhysicsError, match="the joints are at"):
            arm.advance()
        monkeypatch.undo()
        arm.home()
        run(arm, kinematics.HOME_JOINTS_RAD, 1)
    assert not list(tmp_path.iterdir())


def test_an_old_mujoco_is_refused_in_a_sentence(monkeypatch):
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed")
    monkeypatch.setattr(mujoco, "__version__", "3.7.0")
    with pytest.raises(ArmError, match=r"MuJoCo 3\.7\.0 is too old: 3\.8 is the oldest that works"):
        make_arm("mujoco")


def test_closing_twice_is_fine(engine):
    arm = make_arm(engine)
    arm.close()
    arm.close()


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("sim.physics_hz=130", r"sim\.physics_hz must be a multiple of control_hz \(20\), got 130"),
        ("sim.physics_hz=60", r"sim\.physics_hz must be a whole number from 120 to 10000, got 60"),
        ("sim.object_mass_kg=0", r"sim\.object_mass_kg must be a number above 0"),
    ],
)
def test_bad_values_are_refused_in_a_sentence(engine, override, sentence):
    with pytest.raises(ValueError, match=sentence):
        make_arm(engine, override)


def test_a_window_needs_a_screen(engine, monkeypatch):
    for display in ("", ":4711"):  # none, and one whose server is not there
        monkeypatch.setenv("DISPLAY", display)
        with pytest.raises(ArmError, match=r"sim\.gui=true needs a screen"):
            make_arm(engine, "sim.gui=true")
