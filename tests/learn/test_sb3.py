"""Stable-Baselines3's learners: their models as policy files of ours, and their trainings in a folder like any other."""

from __future__ import annotations

import csv
import re

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import gymnasium
from stable_baselines3 import DDPG, PPO, SAC, TD3
from torch import nn

from tests.conftest import CARD
from tests.learn.test_training import interrupt_in, outcome, train
from uarm_rl import cli
from uarm_rl.learn.sb3 import Goals, from_sb3
from uarm_rl.learn.sb3_training import TrainingEpisodes
from uarm_rl.task import observation
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.policy import ActorPolicy


def scale(raw: np.ndarray) -> np.ndarray:
    return (raw - observation.OFFSET) / observation.SCALE


class Spaces(gymnasium.Env):
    """Nothing but the spaces of the task, or a goal's."""

    def __init__(self, high: float = 1.0) -> None:
        self.observation_space = gymnasium.spaces.Box(-6.0, 6.0, (observation.SIZE,), np.float32)
        self.action_space = gymnasium.spaces.Box(-high, high, (3,), np.float32)


def model(kind: type, net_arch: list[int] | None = None, env: gymnasium.Env | None = None, **policy: object):
    policy = {"net_arch": [40, 30] if net_arch is None else net_arch} | policy
    name = "MultiInputPolicy" if isinstance(env, Goals) else "MlpPolicy"
    made = kind(name, env or Spaces(), policy_kwargs=policy, seed=3, device="cpu")
    if hasattr(made, "actor") and made.actor is not None:
        for parameter in made.actor.parameters():  # as if it had learned: actions of all sizes
            parameter.data.mul_(2.0)
    return made


RAW = (
    np.random.default_rng(0).uniform(-1, 1, (50, observation.SIZE)).astype(np.float32) * observation.SCALE + observation.OFFSET
)


@pytest.mark.parametrize("kind", [TD3, DDPG, SAC])
@pytest.mark.parametrize("net_arch", [[], [7], [64, 64], [400, 300], [32, 16, 8, 4]])
def test_a_policy_acts_as_its_model_does(tmp_path, kind, net_arch):
    theirs = model(kind, net_arch)
    expected = theirs.predict(scale(RAW), deterministic=True)[0]
    from_sb3(theirs, CARD).save(tmp_path / "policy.safetensors")
    saved = ActorPolicy.load(tmp_path / "policy.safetensors")
    assert np.ptp(expected, axis=0).min() > 0.01
    np.testing.assert_allclose([saved.act(raw) for raw in RAW], expected, atol=1e-6)
    raw_model = from_sb3(theirs, CARD, offset=np.zeros(observation.SIZE), scale=np.ones(observation.SIZE))
    np.testing.assert_allclose([raw_model.act(raw) for raw in scale(RAW)], expected, atol=1e-6)


def test_a_model_of_goals_becomes_a_policy_that_sees_the_twenty_numbers():
    goals = Goals(Spaces(), 0.005)
    theirs, ours = model(SAC, [40, 30], goals), from_sb3(model(SAC, [40, 30], goals), CARD)
    seen = [dict(zip(("achieved_goal", "desired_goal", "observation"), parts, strict=True)) for parts in map(told, RAW)]
    expected = [theirs.predict(one, deterministic=True)[0] for one in seen]
    np.testing.assert_allclose([ours.act(raw) for raw in RAW], expected, atol=3e-6)  # the goal is put together by another sum


def told(raw: np.ndarray) -> list[np.ndarray]:
    """Where the cup is and should be, scaled as the cup is, and the numbers that say nothing of the object."""
    cup, rest = scale(raw)[9:12], np.r_[scale(raw)[:12], scale(raw)[15:19]]
    goal = (raw[9:12] + raw[12:15] - observation.OFFSET[9:12]) / observation.SCALE[9:12]
    return [part.astype(np.float32) for part in (cup, goal, rest)]


def test_a_goal_is_reached_within_the_tolerance():
    goals = Goals(Spaces(), 0.005)
    away = np.array([[0.0, 0.0, 0.0], [0.0049, 0.0, 0.0], [0.003, 0.003, 0.003]]) / observation.SCALE[9:12]
    assert goals.compute_reward(away, np.zeros(3), [{}] * 3).tolist() == [0.0, 0.0, -1.0]


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: model(TD3, activation_fn=nn.Tanh),
            "only a TD3, DDPG or SAC with MlpPolicy and ReLU, without gSDE, .* got TD3",
        ),
        (lambda: SAC("MlpPolicy", Spaces(), use_sde=True, device="cpu"), "without gSDE, becomes a policy here, got SAC"),
        (lambda: model(PPO), "got PPO"),
        (lambda: model(TD3, env=Spaces(high=2.0)), r"its actions must be in \[-1, 1\], got Box"),
    ],
)
def test_other_models_are_refused_in_a_sentence(make, sentence):
    with pytest.raises(ValueError, match=sentence):
        from_sb3(make(), CARD)


SMALL = ("experiences_per_episode=40", "warmup_experiences=40", "name=theirs", "episodes=2", "time_limit_s=0.2")


@pytest.mark.parametrize(("agent", "buffer"), [("sb3_td3", "uniform"), ("sb3_sac", "steady_only"), ("sb3_her", "uniform")])
def test_a_training_is_like_any_other(tmp_path, monkeypatch, agent, buffer):
    words = (*SMALL, f"agent={agent}", f"buffer={buffer}")
    run = train(tmp_path / "a", *words)
    first = outcome(run)
    assert sorted(path.name for path in run.iterdir()) == ["config.yaml", "policy.safetensors", "progress.csv"]
    rows = first["progress"]
    assert [(row["experiences"], row["decisions"], row["updates"]) for row in rows] == [("40", "40", "0"), ("80", "80", "39")]
    assert [row["validation_success_rate"] != "" for row in rows] == [False, True]
    assert all(int(row["control_steps"]) >= int(row["decisions"]) for row in rows)
    cli.main(["evaluate", f"run={run}", "positions=validation", "time_limit_s=0.1", f"out={tmp_path / 'it.csv'}", "workers=1"])
    with open(tmp_path / "it.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == 50
    if agent == "sb3_td3":  # an interrupted one begins anew, and comes to the same end
        with monkeypatch.context() as patch, pytest.raises(SystemExit):
            interrupt_in(patch, UArmSuctionEnv, "step", 60, 2)
            train(tmp_path / "b", *words)
        assert not (tmp_path / "b" / "theirs" / "seed0" / "policy.safetensors").exists()
        assert outcome(train(tmp_path / "b", *words, "resume=true")) == first


def test_episodes_are_as_long_as_ours_and_begin_at_home():
    homes: list[bool] = []

    class Task(Spaces):
        def reset(self, *, seed=None, options=None):
            homes.append(options["home"])
            return np.zeros(observation.SIZE, np.float32), {}

        def step(self, action):
            done = len(homes) == 1
            info = {"control_steps": 3, "object_moved_m": 0.0, "object_lost": False, "exploded": False, "is_success": done}
            return np.zeros(observation.SIZE, np.float32), -1.0, done, False, info

    one = TrainingEpisodes(Task(), 3)
    ends = []
    one.reset()
    for _ in range(7):
        *_, terminated, truncated, _ = one.step(np.zeros(3))
        ends.append((terminated, truncated))
        if terminated or truncated:
            one.reset()
    cut, goes_on = (False, True), (False, False)
    assert ends == [(True, False), goes_on, cut, goes_on, goes_on, cut, goes_on]
    assert homes == [True, False, True, True]
    assert one.sums == {"episode_return": -7.0, "successes": 1, "control_steps": 21} | dict.fromkeys(
        ("object_moved_m", "object_losses", "explosions"), 0
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("buffer=adaptive",), "agent=sb3_sac has a buffer of its own, with admission all, not not_stuck; take buffer=uniform"),
        (("buffer=uniform", "sampling@buffer.sampling=prioritized"), "with sampling uniform, not prioritized"),
        (("buffer=uniform", "agent.learning_rate=0"), "agent.learning_rate must be a number above 0 and at most 1, got 0"),
    ],
)
def test_what_it_cannot_do_is_refused_in_a_sentence(tmp_path, words, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        train(tmp_path, *SMALL, "agent=sb3_sac", *words)
    assert not list(tmp_path.iterdir())
