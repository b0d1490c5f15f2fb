"""Policies that see more, act otherwise or choose how long: their cards, and every command that they meet."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from tests.conftest import FAST, needs_mujoco
from uarm_rl import checks, configuration, load_policy, make_env, trained
from uarm_rl.checks import UsageError
from uarm_rl.commands import evaluate, render, train
from uarm_rl.commands.arm_settings import check_policy
from uarm_rl.task.policy import ActorPolicy, PolicyFileError
from uarm_rl.task.rollout import run_episode

QUICK = (*FAST, "episodes=2", "time_limit_s=0.3", "simulate_beside=false", "buffer=uniform")

#: What is chosen, how many numbers are seen and acted with, and what the arm says to it.
KINDS = {
    "paper": ((), 20, 3, ""),
    "velocity": (("observation=velocity",), 23, 3, "the velocity of the joints"),
    "last_action": (("observation=last_action",), 23, 3, ""),
    "reference": (("observation=reference", "actions=reference"), 23, 3, ""),
    "stack": (("observation=stack", "observation.frames=2"), 40, 3, ""),
    "absolute": (("actions=absolute",), 20, 3, "any place in one move"),
    "torque": (("servo=torque", "observation=velocity"), 23, 3, "the policy commands torques"),
    "obstacles": (("task=obstacles", "name=past", "reward=plain"), 35, 3, ""),
    "learned": (("buffer=learned_hold", "agent.gamma_per=control_step"), 20, 4, "how long a command acts"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_policy_of_every_kind_is_trained_tested_filmed_and_judged_for_the_arm(tmp_path, kind, capsys):
    words, inputs, outputs, refused = KINDS[kind]
    settings = configuration.compose("train", (*QUICK, *words, f"results_dir={tmp_path}"))
    train.run(settings)
    run = train.output(settings)
    policy = load_policy(run)
    assert (policy.card.inputs, policy.card.outputs) == (inputs, outputs)
    assert policy.act(np.zeros(inputs, np.float32)).shape == (outputs,)
    assert policy.card.observation == configuration.observation_of(settings)

    (tmp_path / "where.csv").write_text("x_m,y_m,z_m\n0.2,0.1,0.03\n0.25,-0.1,0.03\n")
    test = (f"run={run}", f"positions={tmp_path / 'where.csv'}", f"out={run / 'o.csv'}", "workers=1", "time_limit_s=0.5")
    evaluate.run(configuration.compose("evaluate", test))
    with open(run / "o.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    env = make_env(*QUICK, *words, "time_limit_s=0.5")
    episode = run_episode(env, policy, options={"object_position": (0.2, 0.1, 0.03)})
    env.close()
    assert (len(rows), float(rows[0]["return"])) == (2, pytest.approx(episode.episode_return, rel=1e-6))
    if kind in ("stack", "learned", "obstacles"):
        render.run(configuration.compose("render", (f"run={run}", f"out={tmp_path / 'film.gif'}", "width=64", "height=64")))
        assert (tmp_path / "film.gif").stat().st_size > 100

    if refused:
        with pytest.raises(PolicyFileError, match=f"{refused}.*; take a policy that does without"):
            check_policy(policy.card, 0.25)
    else:
        assert len(check_policy(policy.card, 0.25)) == 3  # another servo, a rigid cup, and no waiting
    if kind in ("absolute", "learned", "torque"):
        with pytest.raises(UsageError, match="policy=ik moves relative to the current joints"):
            trained.load_policy(run, "ik", settings)
    capsys.readouterr()


@needs_mujoco
def test_in_the_other_engine_too(tmp_path, capsys):
    words = ("observation=velocity", "buffer=learned_hold", "sim=mujoco", f"results_dir={tmp_path}")
    settings = configuration.compose("train", (*QUICK, *words))
    train.run(settings)
    assert load_policy(train.output(settings)).card.inputs == 23
    capsys.readouterr()


def test_a_card_says_no_more_than_what_is_not_as_it_always_was(tmp_path):
    plain, other = (trained.policy_card(configuration.compose("train", words)) for words in ((), ("observation=velocity",)))
    assert {"observation", "actions"} & plain.written().keys() == set()  # an older version reads it
    assert plain.read(plain.written()) == plain
    assert other.written()["observation"] == {"name": "velocity"}
    layers = [(np.ones((20, 3), np.float32), np.zeros(3, np.float32))]
    ones = np.ones(20, np.float32)
    ActorPolicy(layers, offset=ones, scale=ones, card=other).save(tmp_path / "p.safetensors")
    with pytest.raises(PolicyFileError, match="it needs 23 inputs and 3 outputs, has layers"):
        ActorPolicy.load(tmp_path / "p.safetensors")
    ActorPolicy(layers, offset=ones, scale=ones, card=plain).save(tmp_path / "policy.safetensors")
    with pytest.raises(UsageError, match="is not of this run: the run has observation=velocity, not paper"):
        trained.load_policy(tmp_path, None, configuration.compose("train", ("observation=velocity",)))


def test_what_lies_within_a_decision_is_of_the_present_alone():
    for words in (("task=obstacles",), ("observation=stack",), ("actions=reference",), ("hold@buffer.hold=learned",)):
        settings = configuration.compose("train", ("buffer=every_step", *words))
        with pytest.raises(checks.UsageError, match="admission=every_step needs task=reach, actions=joint"):
            configuration.build_env(settings, time_limit_s=None, keep_within=True)
