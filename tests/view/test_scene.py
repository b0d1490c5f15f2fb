"""The drawn arm: it stands as the kinematics say, and what is not installed is told in a sentence."""

import subprocess
import sys

import numpy as np
import pytest

from uarm_rl.task.kinematics import HOME_JOINTS_RAD, cup_position

viser = pytest.importorskip("viser")

from uarm_rl.view.scene import ArmView  # noqa: E402


@pytest.fixture(scope="module")
def server():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


def test_the_drawn_cup_is_where_the_kinematics_have_it(server):
    left, right = ArmView(server, "/left"), ArmView(server, "/right", place_m=(0.0, 0.5, 0.0), title="B")
    right.pose([0.0, 0.0, 0.0])
    for joints in (HOME_JOINTS_RAD, [0.6, 0.3, 0.4], [-1.2, 0.9, 0.2]):
        left.pose(joints)
        np.testing.assert_allclose(left.cup_m(), cup_position(joints), atol=1e-6)
    np.testing.assert_allclose(right.cup_m(), cup_position([0.0, 0.0, 0.0]), atol=1e-6)


def test_object_and_mark_come_and_go(server):
    arm = ArmView(server, "/one")
    before = server.get_scene_serializer().serialize()
    arm.put_object((0.25, 0.1, 0.03))
    arm.mark_target((0.25, 0.1, 0.03))
    arm.draw_path(np.array([[0.2, 0.0, 0.15], [0.25, 0.1, 0.03]]))
    shown = server.get_scene_serializer().serialize()
    assert shown != before
    arm.size_object((0.06, 0.03, 0.02))
    arm.put_object((0.25, 0.1, 0.03))
    assert arm._object.position[2] == pytest.approx(0.02)  # the upper surface stays where it was told
    assert server.get_scene_serializer().serialize() != shown
    arm.put_object(None)
    arm.mark_target(None)
    assert server.get_scene_serializer().serialize() != shown


def test_without_viser_a_sentence_says_how_to_add_it():
    code = "import sys; sys.modules['viser'] = None; import uarm_rl.view.scene"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "viser is not installed, which shows the arm in a browser; in the checkout: pip install" in done.stderr
