"""How near the arm comes to an obstacle: held to the drawn arm, to PyBullet's distances, and to itself in between."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uarm_rl.sim import looks
from uarm_rl.sim.simulated_arm import urdf
from uarm_rl.task import kinematics
from uarm_rl.task.obstacles import _RADII, Box, _axes, boxes, clearances_m, way_clearances_m

angle = [st.floats(low, high) for low, high in kinematics.JOINT_LIMITS_RAD.tolist()]
poses = st.tuples(*angle).filter(kinematics.within_limits)
obstacle = st.builds(
    Box,
    st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(0.0, 0.4)),
    st.tuples(*[st.floats(0.005, 0.15)] * 3),
)


def turned(quaternion, vertices):
    w, x, y, z = quaternion
    across = 2.0 * np.cross([x, y, z], vertices)
    return vertices + w * across + np.cross([x, y, z], across)


@given(poses)
@settings(max_examples=25, deadline=None)
def test_every_part_of_the_drawn_arm_lies_in_the_capsules(joints):
    starts, ends = (axes[0][:, np.newaxis] for axes in _axes(np.array([joints])))
    placed = looks.poses(joints)
    for part in looks.parts():
        if part.frame.startswith("hose"):
            continue
        place, quaternion = placed[part.frame]
        vertices = np.array(place) + turned(quaternion, part.mesh.vertices)
        vertices = vertices[vertices[:, 2] > 0.0]  # nothing stands below the table
        if not len(vertices):
            continue
        along = ends - starts
        share = np.clip(((vertices - starts) * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
        outside = np.linalg.norm(vertices - starts - share[..., np.newaxis] * along, axis=-1) - _RADII[:, np.newaxis]
        assert outside.min(axis=0).max() <= 1e-4, part.frame


@given(poses, obstacle)
@settings(max_examples=60, deadline=None)
def test_the_nearest_point_of_an_axis_is_found(joints, box):
    starts, ends = _axes(np.array([joints]))
    shares = np.linspace(0.0, 1.0, 2001)[:, np.newaxis, np.newaxis]
    points = starts[0] + shares * (ends - starts)[0]
    low, high = (np.array(box.centre_m) + sign * np.array(box.size_m) / 2.0 for sign in (-1, 1))
    sampled = np.linalg.norm(np.maximum(0.0, np.maximum(low - points, points - high)), axis=-1) - _RADII
    (found,) = clearances_m(np.array([joints]), [box])
    assert sampled.min() - 2e-4 <= found <= sampled.min() + 1e-6


@given(poses, poses, obstacle, st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_nothing_between_two_looks_comes_nearer(start, end, box, share):
    """Only the parts that move count: what they are told to be at least as far from is what they are."""
    told = way_clearances_m(start, end, [box], math.radians(1.0)).min()
    between = np.array(start) + share * np.subtract(end, start)
    assert clearances_m(between[np.newaxis], [box])[0] >= told - 1e-9


def test_the_engine_never_has_the_arm_nearer():
    bullet = pytest.importorskip("uarm_rl.sim.pybullet_arm").bullet
    client = bullet.connect(bullet.DIRECT)
    arm = bullet.loadURDF(str(urdf()), useFixedBase=True, physicsClientId=client)
    generator = np.random.default_rng(0)
    gaps = []
    for _ in range(60):
        size = generator.uniform(0.01, 0.1, 3)
        shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=size / 2.0, physicsClientId=client)
        place = generator.uniform([-0.3, -0.3, 0.0], [0.4, 0.3, 0.3])
        box = bullet.createMultiBody(0.0, shape, basePosition=place, physicsClientId=client)
        joints = kinematics.clip_to_limits(*generator.uniform(*kinematics.JOINT_LIMITS_RAD.T))
        for joint, at in enumerate((*joints, kinematics.level(joints[1], joints[2]))):
            bullet.resetJointState(arm, joint, at, physicsClientId=client)
        near = min(point[8] for point in bullet.getClosestPoints(arm, box, 2.0, physicsClientId=client))
        (ours,) = clearances_m(np.array([joints]), [Box(tuple(place), tuple(size))])
        if near > 0.0:  # else they measure how deep, each in its own way
            gaps.append(near - ours)
        bullet.removeBody(box, physicsClientId=client)
    bullet.disconnect(client)
    assert min(gaps) > -1e-3
    assert np.median(gaps) < 0.06


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        (3, "obstacle must be six numbers, x y z and the three sides in metres, or a list of such; got 3"),
        ([0.2, 0.1, 0.05], "obstacle must be x y z and the three sides, in metres"),
        ([0.2, 0.1, 0.05, 0.03, 0.03, "x"], "obstacle must be a finite number, got 'x'"),
        ([0.2, 0.1, 0.05, 0.03, 0.0, 0.1], "each side of obstacle must be a number above 0"),
        (
            [[0.2, 0.1, 0.05, 0.03, 0.03, 0.1], [0.05, 0.0, 0.05, 0.03, 0.03, 0.1]],
            r"obstacle\[1\]: the obstacle .* arm's base is",
        ),
    ],
)
def test_what_is_no_obstacle_is_refused_in_a_sentence(value, sentence):
    with pytest.raises(ValueError, match=sentence):
        boxes("obstacle", value)


def test_obstacles_are_given_alone_or_as_a_list():
    one = Box((0.2, 0.1, 0.05), (0.03, 0.04, 0.1))
    row = [0.2, 0.1, 0.05, 0.03, 0.04, 0.1]
    assert boxes("obstacle", None) == ()
    assert boxes("obstacle", row) == boxes("obstacle", [row]) == (one,)
    assert boxes("obstacle", [row, row]) == (one, one)
    assert str(one) == "the obstacle of (30, 40, 100) mm at (200, 100, 50) mm"
