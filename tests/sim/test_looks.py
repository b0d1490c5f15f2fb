"""What the arm looks like: in the right place, closed, drawn without moving anything."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import make_arm
from tests.sim.test_arm import trajectory
from uarm_rl.sim import looks
from uarm_rl.sim.backdrop import posed
from uarm_rl.sim.simulated_arm import CAMERA, Scene
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError

JOINTS = [(0.0, 0.0, 0.0), (0.7, 0.6, 0.3), (-1.2, -0.4, 0.9)]


def at(poses, frame, point):
    """A point of a frame, from the base."""
    return posed(looks.Mesh(np.array([point]), np.zeros((1, 3)), np.zeros((0, 3), np.int32)), poses[frame]).vertices[0]


@pytest.mark.parametrize("joints", JOINTS)
def test_frames_are_where_the_geometry_has_them(joints):
    poses, ends = looks.poses(joints), kinematics.forward(joints)
    for frame, end in zip(("lower_arm", "forearm", "hand", "cup"), ends, strict=True):
        assert poses[frame][0] == pytest.approx(end, abs=1e-12)
    long, far = kinematics.LOWER_ARM_M, kinematics.FOREARM_M
    for rod, length, on, point in (
        ("lower_arm", (0, 0, long), "elbow", (0, 0, 0)),
        ("level_rod", (0, 0, long), "elbow", (-0.040, 0, 0.012)),
        ("drive_rod", (0, 0, long), "forearm", (-0.045, 0, 0)),
        ("drive_rod", (0, 0, 0), "crank", (-0.045, 0, 0)),
        ("hand_rod", (far, 0, 0), "hand", (0.004, 0, 0.036)),
        ("hand_rod", (0, 0, 0), "elbow", (0.004, 0, 0.036)),
    ):
        assert at(poses, rod, length) == pytest.approx(at(poses, on, point), abs=1e-12), rod
    lip = next(part.mesh for part in looks.parts() if part.frame == "cup")
    assert posed(lip, poses["cup"]).vertices[:, 2].min() == pytest.approx(ends[3][2], abs=1e-4)
    assert looks.poses(joints, 0.003)["cup"][0][2] == pytest.approx(ends[3][2] + 0.003)


@pytest.mark.parametrize("joints", JOINTS)
def test_a_frame_turns_where_it_hangs(joints):
    poses, before = looks.poses(joints), looks.poses((0.3, 0.2, 0.1))
    for frame, parent in looks.PARENTS.items():
        assert looks.seen_from(poses[parent], poses[frame])[0] == looks.seen_from(before[parent], before[frame])[0], frame
        corner = np.array([0.01, 0.02, 0.03])
        local = at({"it": looks.seen_from(poses[parent], poses[frame])}, "it", corner)
        assert at(poses, parent, local) == pytest.approx(at(poses, frame, corner), abs=1e-6)


def test_shapes_are_closed_and_face_outwards():
    """The volume that the faces enclose is positive, and every face looks the way of its normals."""
    for part in looks.parts():
        mesh = part.mesh
        a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in (0, 1, 2))
        assert np.einsum("ij,ij->i", np.cross(a, b), c).sum() > 0.0, part.frame
        facing = np.einsum("ij,ij->i", np.cross(b - a, c - a), mesh.normals[mesh.faces].mean(axis=1))
        assert (facing > 0.0).all(), part.frame
        assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0)
    assert {part.frame for part in looks.parts()} == set(looks.poses(JOINTS[0]))


def test_a_fitted_camera_shows_all_and_no_more():
    points = np.concatenate([kinematics.forward(joints) for joints in JOINTS])
    for size in ((640, 720), (1280, 720)):
        places = CAMERA.fitted(points, *size).pixels(*size, points) / size
        assert places.min() > 0.049
        assert places.max() < 0.951
        assert np.isclose([places.min(axis=0), places.max(axis=0)], [[0.05], [0.95]], atol=0.002).any(axis=1).all()


def test_a_picture_moves_nothing(engine):
    with make_arm(engine) as arm, make_arm(engine) as other:
        scene = Scene(JOINTS[1], (0.25, 0.1, 0.015, 1.0, 0.0, 0.0, 0.0))
        try:
            drawn = arm.draw(scene, 160, 120)
        except ArmError as error:
            pytest.skip(str(error))
        arm.home()
        assert trajectory(arm, 0) == trajectory(other, 0)
        np.testing.assert_array_equal(arm.draw(scene, 160, 120), drawn)
        assert drawn.shape == (120, 160, 3)


def test_the_arm_casts_a_shadow_and_the_table_is_light(engine):
    with make_arm(engine) as arm:
        try:
            picture = arm.draw(Scene((0.0, 0.0, 0.3), (0.0, 0.5, 0.015, 1.0, 0.0, 0.0, 0.0)), 320, 180)
        except ArmError as error:
            pytest.skip(str(error))
    light = np.array(looks.LIGHT)
    cup = looks.poses((0.0, 0.0, 0.3))["hand"][0]
    column, row = (round(value) for value in CAMERA.pixel(320, 180, cup - cup[2] / light[2] * light))
    column_lit, row_lit = (round(value) for value in CAMERA.pixel(320, 180, (0.2, -0.3, 0.0)))
    assert picture[row_lit, column_lit].min() > 200
    assert picture[row, column].max() < 0.9 * picture[row_lit, column_lit].min()
