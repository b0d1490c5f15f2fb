"""A library's planner past obstacles: its way is free, the same every time, and the arm goes it without a touch."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from itertools import pairwise

import numpy as np
import pytest

from uarm_rl import make_env
from uarm_rl.task import kinematics, layouts
from uarm_rl.task.obstacles import clearances_m
from uarm_rl.task.rollout import run_episode

needs_ompl = pytest.mark.skipif(find_spec("ompl") is None, reason="ompl is not installed")


@needs_ompl
def test_the_way_is_free_and_the_same_every_time():
    from uarm_rl.task.planner import plan

    layout = layouts.load_named("validation", 3)[2]
    above = kinematics.inverse(layout.object_m + (0.0, 0.0, 0.06))
    legs = plan(kinematics.HOME_JOINTS_RAD, above, layout.obstacles)
    np.testing.assert_array_equal(legs, plan(kinematics.HOME_JOINTS_RAD, above, layout.obstacles))
    np.testing.assert_allclose((legs[0], legs[-1]), (kinematics.HOME_JOINTS_RAD, above))
    poses = np.concatenate([np.linspace(one, other, 50) for one, other in pairwise(legs)])
    assert clearances_m(poses, layout.obstacles).min() > 0.008  # what is looked at lies some milliradians apart
    assert all(kinematics.within_limits(pose, 1e-9) for pose in poses)


@needs_ompl
def test_the_arm_goes_it_without_a_touch_and_stays_where_there_is_no_way():
    from uarm_rl.task.planner import PlannerPolicy

    env, policy = make_env("experiment=obstacles"), PlannerPolicy(0.15, 3)
    one, other = layouts.load_named("validation", 3)[:2]
    for layout in (one, other, other):  # the same again is another attempt, from home
        episode = run_episode(env, policy, options=layout.options())
        assert (episode.success, episode.obstacle_contact_n) == (True, 0.0)
    walled = {"object_position": (0.12, 0.2, 0.03), "obstacles": [[0.12, 0.2, 0.15, 0.1, 0.1, 0.2]]}
    observed, _ = env.reset(options=walled)
    assert not policy.act(observed).any()
    env.close()


def test_without_the_library_a_sentence_says_how_to_add_it():
    code = "import sys; sys.modules['ompl'] = None; import uarm_rl.task.planner"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "ompl is not installed, which plans ways past obstacles; in the checkout: pip install" in done.stderr
