"""The task as a Gymnasium environment."""

from __future__ import annotations

import numpy as np
import pytest

from uarm_rl.columns import STATE
from uarm_rl.task import kinematics, observation
from uarm_rl.task.policy import InverseKinematicsPolicy
from uarm_rl.task.reward import DistanceReward
from uarm_rl.task.rollout import run_episode

TARGET = (0.25, 0.1, 0.03)


def test_the_twenty_numbers(make_env):
    env = make_env()
    seen, _ = env.reset(options={"object_position": TARGET})
    ends = kinematics.forward(kinematics.HOME_JOINTS_RAD)
    joints = kinematics.HOME_JOINTS_RAD
    expected = [*ends.ravel(), *(np.array(TARGET) - ends[3]), *joints, kinematics.level(joints[1], joints[2]), 0.0]
    assert seen.dtype == np.float32
    assert seen == pytest.approx(np.array(expected), abs=1e-6)
    assert len(observation.NAMES) == len(seen) == 20


def test_scaled_observations_have_about_unit_range(make_env):
    env = make_env("buffer=uniform")
    generator = np.random.default_rng(0)
    seen = []
    for seed in range(5):
        seen.append(env.reset(seed=seed)[0])
        for _ in range(30):
            seen.append(env.step(generator.uniform(-1, 1, 3).astype(np.float32))[0])
    scaled = (np.array(seen) - observation.OFFSET) / observation.SCALE
    assert np.abs(np.delete(scaled, [12, 13, 14], axis=1)).max() < 5
    assert np.abs(scaled).max() < 15  # the vector to the object is scaled for its last centimetres
    assert np.abs(scaled).mean() < 1.5


def test_seeds_decide_where_the_object_lies(make_env):
    env = make_env()
    first, again, other = (env.reset(seed=seed)[1]["object_position"] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_an_action_is_a_difference_to_the_current_joints(make_env):
    env = make_env("servo=instant", "buffer=uniform", "max_delta_rad=0.1")
    env.reset(options={"object_position": TARGET})
    seen, *_ = env.step(np.array([1.0, -0.5, 0.25], np.float32))
    assert seen[observation.JOINTS] - kinematics.HOME_JOINTS_RAD == pytest.approx([0.1, -0.05, 0.025], abs=1e-4)


def test_reward_is_equation_4_between_the_two_states(make_env):
    env = make_env("reward=penalty")
    env.reset(options={"object_position": (0.22, 0.03, 0.03)})
    reward_function = DistanceReward(1.0, 10.0, -5.0, -1.0, -1.0)
    before = env.state()
    for _ in range(15):
        action = env.action_space.sample()
        _, reward, *_, info = env.step(action)
        after = env.trace[-1]
        terms = reward_function(before[3:6], before[6:9], after[3:6], after[6:9])
        assert reward == pytest.approx(terms.total, abs=1e-12)
        assert info["reward_distance"] == pytest.approx(terms.distance, abs=1e-12)
        assert info["reward_displacement"] == pytest.approx(terms.displacement, abs=1e-12)
        before = after


def test_success_is_a_dwell_without_a_break_and_terminates(make_env):
    env = make_env("tolerance_m=0.01", "dwell_s=0.5")
    episode = run_episode(env, InverseKinematicsPolicy(0.15), options={"object_position": TARGET})
    assert episode.success
    distance = np.linalg.norm(episode.trace[:, 3:6] - episode.trace[:, 6:9], axis=1)
    assert (distance[-10:] <= 0.01).all()  # 0.5 s at 20 Hz
    assert distance[-11] > 0.01
    assert episode.trace.shape[1] == len(STATE)


def test_the_time_limit_truncates(make_env):
    env = make_env("buffer=uniform", time_limit_s=0.5)
    env.reset(options={"object_position": TARGET})
    ends = [env.step(np.zeros(3, np.float32))[2:4] for _ in range(10)]
    assert ends == [(False, False)] * 9 + [(False, True)]


def test_no_time_limit_in_training(make_env):
    env = make_env("buffer=uniform", time_limit_s=None)
    env.reset(options={"object_position": TARGET})
    assert not any(env.step(np.zeros(3, np.float32))[3] for _ in range(250))


def test_a_lost_object_truncates(make_env):
    env = make_env("buffer=uniform")
    env.reset(options={"object_position": TARGET})
    env.target.place_object((0.6, 0.0, 0.03))  # out of reach
    *_, terminated, truncated, info = env.step(np.zeros(3, np.float32))
    assert (terminated, truncated, info["object_lost"]) == (False, True, True)


def test_the_adaptive_hold_waits_for_rest(make_env):
    env = make_env("buffer=adaptive")
    env.reset(options={"object_position": TARGET})
    info = env.step(np.array([1.0, 0.0, 0.0], np.float32))[4]
    joints = env.trace[:, 0]
    assert 5 < info["control_steps"] < 40
    assert abs(joints[-1] - joints[-2]) < 0.001 <= abs(joints[-2] - joints[-3])
    assert joints[-1] == pytest.approx(0.15 * 1.163, abs=0.003)  # at rest on the crest of the overshoot of damping 0.5


def test_a_reference_beyond_a_limit_is_cut_and_said(make_env):
    env = make_env("servo=instant", "buffer=uniform")
    env.reset(options={"object_position": TARGET})
    infos = [env.step(np.array([1.0, 0.0, 0.0], np.float32))[4] for _ in range(14)]
    assert [info["clipped"] for info in infos] == [False] * 10 + [True] * 4  # 10 x 0.15 rad stay below pi/2
    assert infos[-1]["travel_rad"] < 0.001
    assert env.state()[0] == pytest.approx(np.pi / 2, abs=1e-4)


def test_placing_anew_keeps_the_arm_and_clears_the_cup(make_env):
    env = make_env()
    env.reset(seed=0)
    env.step(np.array([1.0, 0.3, 0.0], np.float32))
    joints = env.state()[:3].copy()
    for _ in range(50):
        _, info = env.reset(options={"home": False})
        assert env.state()[:3] == pytest.approx(joints, abs=1e-12)
        assert np.linalg.norm(np.array(info["object_position"])[:2] - env.state()[3:5]) >= 0.06


@pytest.mark.parametrize("action", [[0, 0, np.nan], [0, 0, np.inf], [0, 0, 1.001], [0, 0], [[0, 0, 0]]])
def test_bad_actions_are_refused_and_nothing_moves(make_env, action):
    env = make_env()
    env.reset(options={"object_position": TARGET})
    before = env.state()
    with pytest.raises(ValueError, match=r"an action is 3 finite numbers in \[-1, 1\]"):
        env.step(np.array(action, np.float32))
    np.testing.assert_array_equal(env.state(), before)


@pytest.mark.parametrize("options", [{"object_position": (9, 9, 9)}, {"object_position": (0.2, np.nan, 0.03)}, {"position": 1}])
def test_bad_reset_options_are_refused(make_env, options):
    with pytest.raises(ValueError, match="object_position"):
        make_env().reset(options=options)


def test_pictures(make_env):
    env = make_env("buffer=uniform", render_mode="rgb_array_list", picture_size=(96, 64))
    env.reset(options={"object_position": TARGET})
    env.step(np.zeros(3, np.float32))
    pictures = env.render()
    assert [picture.shape for picture in pictures] == [(64, 96, 3)] * 2
    assert pictures[0].std() > 10  # there is something to see
    assert env.render() == []


@pytest.mark.parametrize("jump", [float("nan"), 5.0])
def test_a_world_that_jumps_in_its_last_physics_step_is_seen_at_once(make_env, monkeypatch, jump):
    """The engine itself is made to jump, behind the last look that the servo takes."""
    bullet = pytest.importorskip("uarm_rl.sim.pybullet_arm").bullet
    env = make_env("sim=pybullet", "buffer=uniform", time_limit_s=None)
    env.reset(seed=0)
    arm, steps = env.arm, 0
    step_simulation = bullet.stepSimulation

    def step(**client):
        nonlocal steps
        step_simulation(**client)
        steps += 1
        if steps == 6:  # the last one of a control step
            bullet.resetJointState(arm.bodies.arm, 1, jump, **client)

    monkeypatch.setattr(bullet, "stepSimulation", step)
    before = env.state()
    *_, reward, terminated, truncated, info = env.step(np.zeros(3, np.float32))
    assert steps == 6
    assert (terminated, truncated, info["exploded"]) == (False, True, True)
    assert np.isfinite(reward)
    np.testing.assert_array_equal(env.state(), before)  # what such a world shows is not taken for a state


def test_an_exploding_simulation_ends_the_episode_and_only_that(make_env, monkeypatch):
    env = make_env("buffer=uniform", time_limit_s=None)
    env.reset(seed=0)
    monkeypatch.setattr(env.arm._servo, "velocity", lambda *_: (float("nan"), 0.0, 0.0))
    *_, reward, terminated, truncated, info = env.step(np.zeros(3, np.float32))
    assert (terminated, truncated, info["exploded"]) == (False, True, True)
    assert np.isfinite(reward)
    monkeypatch.undo()
    env.reset(options={"object_position": TARGET})
    *_, truncated, info = env.step(np.zeros(3, np.float32))
    assert (truncated, info["exploded"]) == (False, False)


# Leaning


def deeper(env):
    """The action that leads towards a place 18 mm below the upper surface of the box at (0.2, 0, 0.03)."""
    wish = kinematics.inverse((0.2, 0.0, 0.012)) - env.state()[:3]
    return np.clip(wish / 0.15, -1.0, 1.0).astype(np.float32)


def test_a_ghost_bears_nothing(make_env):
    """Told the same target with nothing there, a cup that goes down goes through; over the box it is stopped."""
    deepest = {}
    for ghost in (False, True):
        env = make_env("buffer=adaptive")
        env.reset(options={"object_position": (0.2, 0.0, 0.03), "ghost": ghost})
        infos = [env.step(deeper(env))[4] for _ in range(9)]
        assert {info["ghost"] for info in infos} == {ghost}
        deepest[ghost] = max(info["press_m"] for info in infos)
        assert (max(info["contact_n"] for info in infos) > 0.5) is not ghost
        assert max(info["reference_press_m"] for info in infos) > 0.01
        assert infos[-1]["object_position"][2] == pytest.approx(0.03, abs=1e-3)
    assert deepest[False] < 0.002 < 0.01 < deepest[True]


def test_a_share_of_the_episodes_has_ghosts(make_env):
    env = make_env("ghost_share=0.5")
    kinds = [env.reset(seed=0)[1]["ghost"], *(env.reset()[1]["ghost"] for _ in range(39))]
    assert 10 < sum(kinds) < 30
    kind = env.reset()[1]["ghost"]
    assert {env.reset(options={"home": False})[1]["ghost"] for _ in range(10)} == {kind}  # until the arm goes home
    again = [env.reset(seed=0)[1]["ghost"], *(env.reset()[1]["ghost"] for _ in range(39))]
    assert again == kinds


def test_training_episodes_draw_their_tolerance(make_env):
    """Near enough is what the episode drew; a test has the tolerance itself, and then nothing is drawn."""

    def near_enough(env, **options):
        env.reset(options={"object_position": (0.2, 0.0, 0.03), **options})
        arrived = []
        for _ in range(200):
            wish = kinematics.inverse((0.2, 0.0, 0.034)) - env.state()[:3]  # 4 mm above the target
            _, _, success, _, info = env.step(np.clip(wish / 0.15, -1.0, 1.0).astype(np.float32))
            arrived.append(info["distance_m"])
            if success:
                return True
        assert max(arrived[-5:]) == pytest.approx(0.004, abs=2e-4)
        return False

    strict = make_env("buffer=adaptive", "tightest_m=0.001")
    strict.reset(seed=0)
    drawn = [near_enough(strict) for _ in range(30)]
    assert 2 < sum(drawn) < 15  # a quarter of the tolerances from 1 to 5 mm let 4 mm pass
    assert near_enough(strict, tolerance_m=strict.tolerance_m)
    assert not near_enough(strict, tolerance_m=0.003)
    assert near_enough(make_env("buffer=adaptive"))
    with pytest.raises(ValueError, match=r"tightest_m must be .* 0.005"):
        make_env("tightest_m=0.006")


def test_pressing_costs_what_the_reward_says(make_env):
    rewards = {}
    for pressing in (0.0, -10.0):
        env = make_env("buffer=adaptive", f"reward.pressing={pressing}")
        env.reset(options={"object_position": (0.2, 0.0, 0.03), "ghost": True})
        steps = [env.step(deeper(env)) for _ in range(9)]
        rewards[pressing] = np.array([reward for _, reward, *_ in steps])
        presses = np.array([info["press_m"] for *_, info in steps])
    np.testing.assert_allclose(rewards[0.0] - rewards[-10.0], 10.0 * presses, atol=1e-9)
    assert presses.max() > 0.01
