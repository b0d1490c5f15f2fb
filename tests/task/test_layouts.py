"""Layouts with obstacles: each has a way, which the arm goes in both engines; files that have none are refused by the row."""

from __future__ import annotations

import hashlib
import math
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import ENGINES
from uarm_rl import columns
from uarm_rl.configuration import make_env
from uarm_rl.task import kinematics, layouts
from uarm_rl.task.obstacles import Box
from uarm_rl.task.policy import InverseKinematicsPolicy
from uarm_rl.task.rollout import run_episode

MAX_DELTA_RAD = 0.15
#: Between home and an object to the left: low enough to go over, too high to go through.
IN_THE_WAY = layouts.Layout(np.array([0.12, 0.2, 0.03]), (Box((0.21, 0.12, 0.06), (0.05, 0.05, 0.12)),))


class Follower:
    """Goes from one joint position to the next, straight in angles."""

    def __init__(self, legs):
        self.legs = list(legs[1:])

    def act(self, observed):
        joints = observed[15:18].astype(float)
        while len(self.legs) > 1 and np.abs(self.legs[0] - joints).max() < 0.02:
            self.legs.pop(0)
        turn = (self.legs[0] - joints) / MAX_DELTA_RAD
        return (turn / max(1.0, np.abs(turn).max())).astype(np.float32)


@pytest.fixture(params=ENGINES)
def env(request):
    with make_env(("task=obstacles", f"sim={request.param}", "time_limit_s=20")) as made:
        yield made


def test_the_way_of_a_layout_is_one_in_a_real_world(env):
    """The planner knows capsules; the engines have the arm's own shapes, and feel a touch."""
    for layout in [IN_THE_WAY, *layouts.load_named("validation", 3)[:4]]:
        followed = run_episode(env, Follower(layouts.way(layout)), options=layout.options())
        assert (followed.success, followed.obstacle_contact_n) == (True, 0.0)


def test_who_goes_straight_touches_and_has_not_succeeded(env):
    straight = InverseKinematicsPolicy(MAX_DELTA_RAD)
    results = [run_episode(env, straight, options=one.options()) for one in layouts.load_named("validation", 3)[:10]]
    touched = [one.obstacle_contact_n > 0.0 for one in results]
    assert 2 <= sum(touched) < 10
    assert not any(one.success for one, did in zip(results, touched, strict=True) if did)
    assert all(one.success for one, did in zip(results, touched, strict=True) if not did)


def test_a_touch_costs_is_told_and_ends_the_attempt(env):
    beside = Box((0.2, 0.1, 0.1), (0.05, 0.1, 0.2))  # of the arm at home, which turns into it
    options = {"object_position": (0.2, 0.0, 0.03), "obstacles": [[*beside.centre_m, *beside.size_m]], "ghost": True}
    _, info = env.reset(seed=0, options=options)
    assert (info["touched"], info["obstacle_contact_n"]) == (False, 0.0)
    for _ in range(4):
        _, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0, 0.0], np.float32))
        if info["touched"]:
            break
        assert reward == pytest.approx(info["reward_distance"] + info["reward_progress"] + info["reward_displacement"])
    assert (terminated, truncated, info["is_success"], info["touched"]) == (True, False, False, True)
    assert info["obstacle_contact_n"] > 0.1
    assert reward == info["reward_touching"] == -1.0
    assert info["control_steps"] < 12  # at once, and not when the arm has come to rest
    assert not env.reset(seed=0, options=options)[1]["touched"]


def test_obstacles_are_seen_behind_the_other_numbers_and_gone_with_the_next_layout():
    with make_env(("task=obstacles", "observation=velocity", "task.slots=2")) as env:
        observed, _ = env.reset(seed=1, options=IN_THE_WAY.options())
        assert observed.shape == env.observation_space.shape == (20 + 3 + 2 * 5,)
        np.testing.assert_allclose(observed[23:], [0.21, 0.12, 0.05, 0.05, 0.12, *[0.0] * 5], atol=1e-7)
        assert not env.reset(options={"object_position": (0.2, 0.0, 0.03)})[0][23:].any()
        far, near = [0.1, 0.25, 0.02, 0.02, 0.02, 0.04], [0.2, -0.1, 0.02, 0.02, 0.02, 0.04]
        orders = [
            env.reset(options={"object_position": (0.2, 0.0, 0.03), "obstacles": [*told]})[0]
            for told in ((far, near), (near, far))
        ]
        np.testing.assert_array_equal(*orders)  # whichever is told first
        three = [[0.2, y, 0.02, 0.02, 0.02, 0.04] for y in (-0.1, 0.1, 0.2)]
        with pytest.raises(ValueError, match="there are 3 obstacles, and an observation has room for 2"):
            env.reset(options={"object_position": (0.2, 0.0, 0.03), "obstacles": three})
    with make_env() as env, pytest.raises(ValueError, match="this task has no obstacles"):
        env.reset(options=IN_THE_WAY.options())


def test_drawn_layouts_have_a_way_and_something_in_it():
    generator, task, counts = np.random.default_rng(5), layouts.Obstacles(3, -1.0), set()
    for _ in range(3):
        object_m, obstacles, *_ = layout = task.draw(generator, 0.03, np.zeros(3))
        counts.add(len(obstacles))
        assert not layouts.fault(layout)
        legs = layouts.way(layout)
        np.testing.assert_allclose(kinematics.cup_position(legs[-1]), object_m, atol=1e-9)
        for box in obstacles:
            assert math.isclose(box.centre_m[2], box.size_m[2] / 2.0)  # on the table
    assert counts <= {1, 2, 3}


def test_some_attempts_of_a_training_begin_elsewhere_and_no_test_does(env):
    home = kinematics.HOME_JOINTS_RAD
    begun = []
    for seed in range(12):
        observed, info = env.reset(seed=seed)
        joints = env.unwrapped.arm.read_joints()
        assert observed[15:18] == pytest.approx(joints, abs=1e-6)
        begun.append(np.abs(joints - home).max() > 1e-6)
        assert not info["touched"]
        _, _, terminated, _, info = env.step(np.zeros(3, np.float32))
        assert not terminated
        assert env.unwrapped.arm.read_joints() == pytest.approx(joints, abs=1e-3)  # at rest, and where nothing is
    assert 3 <= sum(begun) <= 9
    env.reset(seed=0, options=IN_THE_WAY.options())
    assert env.unwrapped.arm.read_joints() == pytest.approx(home)


@pytest.mark.parametrize("margin_m", [0.0, 0.01])
def test_in_training_the_arm_is_padded_and_in_a_test_it_is_not(env, monkeypatch, margin_m):
    beside = Box((0.2, 0.1 + margin_m, 0.1), (0.05, 0.07, 0.2))
    layout = layouts.Layout(np.array([0.2, 0.0, 0.03]), (beside,), margin_m=margin_m)
    monkeypatch.setattr(layouts.Obstacles, "draw", lambda *_: layout)
    turn, touched = np.array([1.0, 0.0, 0.0], np.float32), []
    for options in ({}, layout.options()):
        env.reset(seed=0, options=options)
        count, terminated = 0, False
        while not terminated:
            *_, terminated, _, info = env.step(turn)
            count += 1
        touched.append((count, info["touched"], info["obstacle_contact_n"] > 0.0))
    assert touched[0] == (1, True, False)
    assert touched[1] == (2, True, True)


def test_the_committed_layouts_are_those_of_their_seeds():
    hashes = {
        "test_layouts.csv": "5ac7b5b90aca7d4ae1ac459ce754ea81653096b33e9f882a1e81cf2fc76f7e60",
        "validation_layouts.csv": "ab7087a57ade9b45ca180af14532e58ea278944f2be8355ac976d6ac1a49c3f8",
    }
    for name, (rows, seed) in layouts.FILES.items():
        data = (resources.files("uarm_rl.task") / name).read_bytes()
        assert hashlib.sha256(data).hexdigest() == hashes[name]
        committed = layouts.load_named(name.removesuffix("_layouts.csv"), 3)
        assert len(committed) == rows
        first = layouts.Obstacles(layouts.SLOTS, 0.0).draw(np.random.default_rng(seed), 0.03, np.zeros(3))
        np.testing.assert_allclose(committed[0].object_m, first.object_m, atol=1e-6)
        assert committed[0].obstacles == first.obstacles


HEAD = ",".join(columns.LAYOUTS)
PLACE = "0.12,0.2,0.03"
REST = "," * 12


@pytest.mark.parametrize(
    ("row", "slots", "sentence"),
    [
        (f"{PLACE},0.12,0.2,0.05,0.03,0.03,0.1{REST}", 3, "line 2: .* stands on the object"),
        (f"{PLACE},0.05,0.0,0.05,0.03,0.03,0.1{REST}", 3, "line 2: the obstacle: .* stands where the arm's base is"),
        (f"{PLACE},0.2,0.0,0.1,0.03,0.03,0.2{REST}", 3, "line 2: an obstacle is nearer than 10 mm to the arm at home"),
        (f"{PLACE},0.2,0.1,0.2,0.1,0.05,0.4{REST}", 3, "line 2: no way past the obstacles was found"),
        (f"{PLACE},0.2,0.1,,0.03,0.03,0.1{REST}", 3, "line 2: an obstacle needs x_m, y_m, .* or none of them"),
        (f"{PLACE},0.2,0.1,0.02,0.03,0.03,0{REST}", 3, "each side of .*, line 2: the obstacle must be a number above 0"),
        (f"{PLACE},0.21,0.12,0.02,0.03,0.03,0.04,0.21,0.12,0.02,0.03,0.03,0.04,,,,,,", 3, "stand in each other"),
        (
            f"{PLACE},0.21,0.12,0.02,0.03,0.03,0.04,0.16,0.12,0.02,0.03,0.03,0.04,,,,,,",
            1,
            "2 obstacles, and this policy sees 1",
        ),
        (f"0.9,0.2,0.03,,,,,,{REST},", 3, "line 2: the cup cannot come down onto"),
    ],
)
def test_a_layout_that_cannot_be_is_named_by_its_row(tmp_path: Path, row, slots, sentence):
    path = tmp_path / "layouts.csv"
    path.write_text(f"{HEAD}\n{row}\n")
    with pytest.raises(ValueError, match=sentence):
        layouts.load_named(str(path), slots)


def test_layouts_come_back_from_a_file_and_a_file_that_is_not_there_is_a_sentence(tmp_path: Path):
    path = tmp_path / "layouts.csv"
    kept = [IN_THE_WAY, layouts.Layout(np.array([0.2, 0.1, 0.03]))]
    layouts.save(path, kept)
    assert [(one.object_m.tolist(), one.obstacles) for one in layouts.load_named(str(path), 3)] == [
        (one.object_m.tolist(), one.obstacles) for one in kept
    ]
    with pytest.raises(ValueError, match="with task=obstacles, positions takes test or validation or a CSV file of layouts"):
        layouts.load_named("none.csv", 3)
    path.write_text(f"{HEAD}\n")
    with pytest.raises(ValueError, match="holds no layouts"):
        layouts.load_named(str(path), 3)


def test_on_a_desk_things_stand_anywhere_and_there_is_a_way_all_the_same():
    generator, task = np.random.default_rng(7), layouts.Obstacles(3, -1.0, anywhere=1.0)
    drawn = [task.draw(generator, 0.03, np.zeros(3)) for _ in range(40)]
    turns = [math.atan2(layout.object_m[1], layout.object_m[0]) for layout in drawn]
    assert min(map(abs, turns)) < 0.2  # straight ahead too
    sides = [{box.centre_m[1] * turn > 0.0 for box in layout.obstacles} for layout, turn in zip(drawn, turns, strict=True)]
    assert {True, False} in sides
    assert {False} in sides
    assert all(layouts.way(layout) for layout in drawn)
