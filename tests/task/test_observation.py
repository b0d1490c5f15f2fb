"""What can be seen besides the paper's 20 numbers, what actions can be relative to, and how long the agent may say they act."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uarm_rl import configuration
from uarm_rl.task import kinematics, observation
from uarm_rl.task.hold import FixedHold, LearnedHold
from uarm_rl.task.obstacles import Box

TARGET = (0.25, 0.1, 0.03)
ACTION = np.array([1.0, -0.5, 0.25], np.float32)
KINDS = configuration.choices("observation")


def test_every_kind_is_known_to_configurations_and_cards():
    assert observation.KINDS.keys() == configuration.OPEN_SETS["observation"].keys() == set(KINDS)
    for name in KINDS:
        settings = configuration.compose("train", (f"observation={name}",))["observation"]
        built, read = configuration.build("observation", settings), observation.kind(settings)
        assert type(built) is type(read)
        assert built.size == len(built.names) == len(set(built.names)) == len(built.offset) == len(built.scale)
    for wrong, sentence in (({"name": "eyes"}, "observation.name must be paper or"), ({"name": "stack"}, "frames is missing")):
        with pytest.raises(ValueError, match=sentence):
            observation.kind(wrong)


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_numbers_are_the_papers_whatever_else_is_seen(make_env, engine, kind):
    envs = [make_env("buffer=uniform", f"observation={name}", f"sim={engine}") for name in ("paper", kind)]
    plain, more = (env.reset(seed=3)[0] for env in envs)
    for step in range(4):
        assert more.shape == envs[1].observation_space.shape
        assert more.dtype == np.float32
        assert (more[:20] == plain).all(), step
        assert envs[1].observation_space.contains(more)
        plain, more = (env.step(ACTION)[0] for env in envs)


def test_velocities_are_those_of_the_last_control_step(make_env):
    env = make_env("buffer=fixed_hold", "observation=velocity")
    assert (env.reset(seed=0)[0][20:] == 0).all()
    seen, *_ = env.step(ACTION)
    before, after = env.trace[-2:, :3]
    assert seen[20:] == pytest.approx(20.0 * (after - before), rel=1e-4, abs=1e-6)
    assert np.abs(seen[20:]).max() > 0.01
    seen, _ = env.reset(options={"home": False})  # a new object is placed while the arm moves on
    assert seen[20:] == pytest.approx(20.0 * (after - before), rel=1e-4, abs=1e-6)
    assert (env.reset(options={"home": True})[0][20:] == 0).all()


def test_the_last_action_and_the_pending_reference(make_env):
    action, reference = (make_env("buffer=uniform", f"observation={name}") for name in ("last_action", "reference"))
    assert [(env.reset(seed=0)[0][20:] == 0).all() for env in (action, reference)] == [True, True]
    assert (action.step(ACTION)[0][20:] == ACTION).all()
    seen, *_ = reference.step(ACTION)
    goal = kinematics.HOME_JOINTS_RAD + 0.15 * ACTION
    assert seen[20:] == pytest.approx(goal - reference.trace[-1, :3], abs=1e-6)
    env = make_env("buffer=uniform", "observation=reference")
    env.reset(options={"object_position": TARGET})
    for _ in range(90):  # against a limit: what is pending is what was commanded, not what was asked for
        seen, *_, info = env.step(np.array([1.0, 0.0, 0.0], np.float32))
    assert info["clipped"]
    assert seen[20] + seen[15] == pytest.approx(np.pi / 2)


def test_a_stack_has_the_newest_first_and_none_from_before_a_reset(make_env):
    env = make_env("buffer=uniform", "observation=stack", "observation.frames=3")
    first, _ = env.reset(seed=0)
    frames = [first[:20]]
    assert (first == np.tile(first[:20], 3)).all()
    for _ in range(4):
        seen, *_ = env.step(ACTION)
        frames.append(seen[:20])
        newest = [frames[max(0, len(frames) - 1 - age)] for age in range(3)]
        assert (seen == np.concatenate(newest)).all()
    seen, _ = env.reset(options={"home": False})
    assert (seen == np.tile(seen[:20], 3)).all()
    again = copy.deepcopy(env)
    assert (again.reset(seed=0)[0] == first).all()


@pytest.mark.parametrize("actions", ["joint", "reference", "absolute"])
def test_what_an_action_is_relative_to(make_env, actions):
    env = make_env("buffer=uniform", f"actions={actions}", "observation=reference")
    env.reset(options={"object_position": TARGET})
    env.step(ACTION)
    joints = env.trace[-1, :3]
    seen, *_ = env.step(ACTION)
    reference = seen[20:].astype(float) + env.trace[-1, :3]
    low, high = kinematics.JOINT_LIMITS_RAD.T
    expected = {
        "joint": joints + 0.15 * ACTION,
        "reference": kinematics.HOME_JOINTS_RAD + 2 * 0.15 * ACTION,
        "absolute": kinematics.clip_to_limits(*(low + (high - low) * (ACTION + 1) / 2).tolist()),
    }
    assert reference == pytest.approx(np.array(expected[actions]), abs=1e-5)


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-0.05, 0.4), st.floats(-0.3, 0.3))
def test_the_frame_turns_with_the_arm(here, there, x, y):
    """Turned together about the base's axis, arm, object and obstacle look as before to the arm, and not in the base frame."""
    kind = observation.kind({"name": "arm_frame", "obstacles": 2})
    seen = []
    for joint1 in (here, there):
        joints = (joint1, 0.4, 0.2)
        ends = kinematics.forward(joints)
        turn = np.array([[math.cos(joint1), -math.sin(joint1)], [math.sin(joint1), math.cos(joint1)]])
        (a, b), (c, d) = (turn @ place for place in ((x, y), (0.2 + x, y)))
        box = Box((c, d, 0.05), (0.03, 0.04, 0.1))
        seen.append(kind.see(observation.Look(joints, ends, (a, b, 0.03), False, (0, 0, 0), joints, (0, 0, 0), (box,))))
    own = [name for name in kind.names if name.endswith(("ahead_m", "left_m"))]
    assert own == [*(f"object_{side}_m" for side in ("ahead", "left")), *kind.names[25:29]]
    one, other = (dict(zip(kind.names, look.tolist(), strict=True)) for look in seen)
    assert [one[name] for name in own] == pytest.approx([other[name] for name in own], abs=1e-6)
    reach = math.hypot(*kinematics.forward((0.0, 0.4, 0.2))[3][:2])
    assert [one[name] for name in own] == pytest.approx([x - reach, y, 0.2 + x, y, 0.0, 0.0], abs=1e-6)
    near = [one[f"object_{side}_near"] for side in ("ahead", "left", "up")]
    way = np.array([x - reach, y, 0.03 - kinematics.forward((0.0, 0.4, 0.2))[3][2]])
    assert near == pytest.approx(way / (np.abs(way) + 0.01), abs=1e-5)
    assert one["obstacle1_top_m"] == pytest.approx(0.1)


def test_what_is_remembered_ends_with_a_reset_that_brings_the_arm_home(make_env):
    env = make_env("buffer=uniform", "actions=reference", "observation=reference")
    first = env.reset(seed=0)[0]
    trace = [env.step(ACTION)[0] for _ in range(3)]
    env.reset(options={"home": False})
    kept = env.step(ACTION)[0]
    assert kept[20:23] + kept[15:18] == pytest.approx(kinematics.HOME_JOINTS_RAD + 4 * 0.15 * ACTION, abs=1e-5)
    assert (env.reset(seed=0)[0] == first).all()
    assert all((env.step(ACTION)[0] == seen).all() for seen in trace)


def test_the_agent_says_how_long(make_env):
    hold = LearnedHold(max_control_steps=40)
    assert [hold.chosen([number]) for number in (-1.0, 0.0, 1.0)] == [FixedHold(1), FixedHold(21), FixedHold(40)]
    assert FixedHold(7).chosen([]) == FixedHold(7)
    env = make_env("buffer=learned_hold")
    assert env.action_space.shape == (4,)
    env.reset(options={"object_position": TARGET})
    for number, steps in ((-1.0, 1), (-0.5, 11), (1.0, 40)):
        assert env.step(np.array([0.2, 0.0, 0.0, number], np.float32))[4]["control_steps"] == steps
    with pytest.raises(ValueError, match="an action is 4 finite numbers"):
        env.step(ACTION)
