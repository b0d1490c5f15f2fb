"""Hindsight: what a decision says of objects that lay elsewhere is what the environment would have said."""

from __future__ import annotations

import numpy as np
import pytest

from tests.learn.test_train import ORDINARY, learner, run
from uarm_rl import configuration
from uarm_rl.checks import UsageError
from uarm_rl.commands import train as commands_train
from uarm_rl.learn.hindsight import Hindsight, met_object
from uarm_rl.learn.returns import Transition
from uarm_rl.task import layouts, positions
from uarm_rl.task.observation import CUP, CUP_TO_OBJECT, FLAG, PaperObservation, kind, obstacles_in

ACTION = np.array([0.9, -0.7, 0.4], np.float32)


def hindsight(targets: int, seed: int = 0, slots: int = 0, seen: str = "paper", margin_m: float = 0.0) -> Hindsight:
    reward = configuration.build("reward", configuration.compose("train", ("reward=penalty",))["reward"])
    observation, generator = kind({"name": seen, "obstacles": slots}), np.random.default_rng(seed)
    return Hindsight(
        targets=targets,
        reward=reward,
        object_height_m=0.03,
        generator=generator,
        observation=observation,
        touching=-3.0,
        margin_m=margin_m,
    )


def decided(flag: float = 0.0) -> Transition:
    """A decision far from its object."""
    seen, then = np.zeros((2, 20), np.float32)
    seen[CUP], then[CUP] = (0.2, 0.0, 0.15), (0.25, 0.05, 0.1)
    seen[CUP_TO_OBJECT], then[CUP_TO_OBJECT] = (0.0, 0.2, -0.12), (-0.05, 0.15, -0.07)
    seen[FLAG] = flag
    return Transition(seen, ACTION, -3.0, then, 0.9)


@pytest.mark.parametrize("observation", ["paper", "arm_frame"])
def test_it_tells_what_the_environment_would_have_told(make_env, engine, observation):
    """The same action in the same pose, with the object really lying where hindsight has put it."""
    env = make_env(f"sim={engine}", "buffer=adaptive", "reward=penalty", f"observation={observation}")
    before, _ = env.reset(seed=0, options={"object_position": (0.2, 0.2, 0.03)})
    after, reward, *_, info = env.step(ACTION)
    assert not met_object(info)
    made = hindsight(20, seen=observation).of(Transition(before, ACTION, reward, after, 0.9))
    assert len({one.reward for one in made}) == 20
    for one in made:
        target = one.observation[CUP] + one.observation[CUP_TO_OBJECT]
        seen, _ = env.reset(options={"object_position": target.astype(float), "ghost": True})
        then, earned, terminated, *_ = env.step(ACTION)
        assert not terminated
        np.testing.assert_allclose(one.observation, seen, atol=5e-6)  # near the object, a rounded metre counts a hundredfold
        np.testing.assert_allclose(one.next_observation, then, atol=5e-6)
        assert one.reward == pytest.approx(earned, abs=1e-5)
        np.testing.assert_array_equal(one.action, ACTION)
        assert one.discount == 0.9


@pytest.mark.parametrize(("observation", "margin_m"), [("paper", 0.0), ("arm_frame", 0.005)])
def test_other_obstacles_are_told_as_the_environment_would_tell_them(make_env, engine, observation, margin_m, monkeypatch):
    """Half of the time: those that the arm went clear of, and those that it came to beyond doubt, which end the attempt."""
    env = make_env(
        f"sim={engine}", "buffer=adaptive", "reward=penalty", "task=obstacles", "task.touching=-3", f"observation={observation}"
    )
    there, far = [0.2, 0.24, 0.05, 0.04, 0.04, 0.1], [0.1, -0.3, 0.03, 0.05, 0.05, 0.06]
    near, around = [0.2, 0.085, 0.1, 0.06, 0.04, 0.2], [0.2, 0.0, 0.1, 0.06, 0.04, 0.2]
    where = {"object_position": (0.25, 0.2, 0.03)}
    seen = [env.reset(options=where | {"obstacles": others})[0] for others in ([near], [far], [far, there], [around])]
    before, _ = env.reset(options=where | {"obstacles": [there]})
    after, reward, *_, info = env.step(ACTION)
    assert not info["touched"]
    made = hindsight(200, slots=3, seen=observation, margin_m=margin_m).of(
        Transition(before, ACTION, reward, after, 0.9), seen=np.array(seen)
    )
    told = [obstacles_in(one.observation, 3) for one in made]
    kinds = {others: told.count(others) for others in told}
    assert set(kinds) == {obstacles_in(one, 3) for one in (before, *seen[:3])}  # never the one that the arm stands in
    assert 0.5 < kinds[obstacles_in(before, 3)] / len(made) < 0.8
    ends = set()
    for one, others in zip(made[:30], told, strict=False):
        target = (one.observation[CUP] + one.observation[CUP_TO_OBJECT]).astype(float)
        monkeypatch.setattr(layouts.Obstacles, "draw", lambda *_: layouts.Layout(target, others, margin_m=margin_m))  # noqa: B023
        stood, _ = env.reset(options={"ghost": True})
        then, earned, terminated, _, ended = env.step(ACTION)
        assert terminated == ended["touched"] == (one.discount == 0.0)
        np.testing.assert_allclose(one.observation, stood, atol=1e-6)
        assert one.reward == pytest.approx(earned, abs=1e-5)
        if not terminated:
            np.testing.assert_allclose(one.next_observation, then, atol=1e-6)
        ends.add(terminated)
    assert ends == {False, True}


def test_an_obstacle_that_was_touched_stays_whatever_the_target(make_env):
    env = make_env("buffer=adaptive", "reward=penalty", "task=obstacles", "task.touching=-3")
    before, _ = env.reset(options={"object_position": (0.25, 0.2, 0.03), "obstacles": [0.2, 0.06, 0.1, 0.06, 0.04, 0.2]})
    after, reward, *_, info = env.step(ACTION)
    assert info["touched"]
    made = hindsight(30, slots=3).of(Transition(before, ACTION, reward, after, 0.0), touched=True, seen=np.array([before]))
    assert {obstacles_in(one.observation, 3) for one in made} == {obstacles_in(before, 3)}
    assert {(one.reward, one.discount) for one in made} == {(-3.0, 0.0)} == {(info["reward_touching"], 0.0)}


def test_targets_lie_where_objects_may_and_many_of_them_near_the_cup():
    made = hindsight(400).of(decided())
    targets = np.array([one.next_observation[CUP] + one.next_observation[CUP_TO_OBJECT] for one in made], float)
    assert targets[:, 2] == pytest.approx(0.03)
    assert all(positions.in_operating_range(target) for target in targets)
    away = np.hypot(*(targets[:, :2] - (0.25, 0.05)).T)
    assert 0.1 < np.mean(away < 0.01) < 0.3  # log-uniform from 1 to 150 mm: 46 % of one half
    assert np.mean(away > 0.15) > 0.2  # and far ones from the other


def test_the_decision_itself_is_left_as_it_was_and_no_other_is_a_success():
    decision = decided(flag=1.0)
    copies = [field.copy() for field in (decision.observation, decision.next_observation)]
    assert all(one.observation[FLAG] == 0.0 for one in hindsight(5).of(decision))
    np.testing.assert_array_equal((decision.observation, decision.next_observation), copies)


def test_without_targets_there_is_nothing_and_nothing_is_drawn():
    generator = np.random.default_rng(0)
    reward = configuration.build("reward", configuration.compose("train")["reward"])
    settings = {"reward": reward, "object_height_m": 0.03, "generator": generator, "observation": PaperObservation()}
    assert Hindsight(targets=0, **settings).of(decided()) == []
    assert generator.bit_generator.state == np.random.default_rng(0).bit_generator.state


FREE = ORDINARY | {"contact_n": 0.0, "touched": False, "object_moved_m": 1e-5}


@pytest.mark.parametrize(
    ("answer", "stored"),
    [
        (FREE, 4 * 3),
        (FREE | {"contact_n": 0.1}, 4),
        (FREE | {"object_moved_m": 0.001}, 4),
        (FREE | {"terminated": True, "is_success": True}, 4),  # it ended early, which it would not have elsewhere
        (FREE | {"terminated": True, "touched": True}, 4 * 3),  # at an obstacle, and that stands where it stands
    ],
)
def test_only_what_did_not_touch_the_object_is_learned_from_again_and_nothing_counts_twice(answer, stored):
    one = learner(answer)
    one.hindsight = hindsight(2)
    (row,) = run(one)
    assert one.replay.added == stored
    assert (row["experiences"], row["updates"]) == (4, 2)


@pytest.mark.parametrize("word", ["observation=stack", "reward.pressing=-1"])
def test_what_another_target_would_have_made_of_a_decision_must_be_known(tmp_path, word):
    settings = configuration.compose("train", ("hindsight_targets=2", word, f"results_dir={tmp_path}"))
    with pytest.raises(UsageError, match="hindsight_targets needs an observation of one moment"):
        commands_train.run(settings)
    assert list(tmp_path.iterdir()) == []
