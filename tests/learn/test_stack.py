"""Learners side by side: what they learn in a stack is what each learns on its own, whoever else is there."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.conftest import CARD
from uarm_rl.learn.actor_critic import DivergenceError
from uarm_rl.learn.ddpg import DDPG
from uarm_rl.learn.learner import Learner
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.learn.returns import Transition
from uarm_rl.learn.sampling import Prioritized, Uniform
from uarm_rl.learn.stack import Stack
from uarm_rl.task import observation

BATCH = 16
_needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")
DEVICES = ["cpu", pytest.param("cuda", marks=_needs_gpu)]
WAYS = [("cpu", False), ("cpu", True), pytest.param("cuda", True, marks=_needs_gpu)]


def learner(seed: int, *, hidden: tuple[int, ...] = (40, 30), stored: int = 100, capacity: int = 200) -> Learner:
    """Each with rates, a capacity and a generator of its own; every second one samples by priority."""
    agent = DDPG(
        hidden=hidden,
        gamma=0.9,
        gamma_per="decision",
        n_steps=1,
        tau=0.01 * (seed + 1),
        actor_lr=1e-3 / (seed + 1),
        critic_lr=1e-3,
        final_layer_init=0.1,
        annealing=0.0 if seed % 3 else 0.6,
        huber=0.1 if seed % 2 else None,
        action_l2=0.1 * (seed % 3),
        action_size=3,
        generator=torch.Generator().manual_seed(seed),
    )
    sampling = Prioritized(alpha=0.6, initial_beta=0.4, epsilon=1e-3) if seed % 2 else Uniform()
    replay = ReplayBuffer(
        capacity + seed, observation_size=20, action_size=3, generator=np.random.default_rng(seed), sampling=sampling
    )
    made = Learner(None, agent, agent.policy(CARD), replay, None, None)
    store(made, np.random.default_rng(seed), stored)
    return made


def store(one: Learner, generator: np.random.Generator, count: int) -> None:
    for _ in range(count):
        seen, then = generator.normal(0, 0.2, (2, observation.SIZE)).astype(np.float32)
        action = generator.uniform(-1, 1, 3).astype(np.float32)
        one.replay.add(Transition(seen, action, float(generator.normal()), then, 0.9))


def numbers(one: Learner) -> dict[str, np.ndarray]:
    return {name: tensor.numpy().copy() for name, tensor in one.agent.tensors().items()}


def advance(stack: Stack, alone: list[Learner], rounds: int) -> None:
    """Store and learn in both, on a schedule in which every learner rests now and then."""
    generators = [[np.random.default_rng(100 + number) for number in range(len(alone))] for _ in range(2)]
    for turn in range(rounds):
        due = [number for number in range(len(alone)) if (turn + number) % 3]
        for number in due:
            for of, one in ((0, alone[number]), (1, stack.learners[number])):
                store(one, generators[of][number], number + 1)
            alone[number].update(BATCH, turn / rounds)
        stack.update({number: turn / rounds for number in due})
    for number in range(len(alone)):
        stack.settle(number)


def test_one_after_the_other_they_have_the_bytes_of_learners_on_their_own():
    """With other rates, capacities that are full and priorities, while some rest."""
    alone, stacked = ([learner(seed, stored=190) for seed in range(4)] for _ in range(2))
    advance(Stack(stacked, BATCH, "cpu", batched=False), alone, rounds=30)
    for ours, theirs in zip(stacked, alone, strict=True):
        for name, expected in numbers(theirs).items():
            np.testing.assert_array_equal(numbers(ours)[name], expected, err_msg=name)
        assert ours.metrics == theirs.metrics
        assert ours.counters == theirs.counters
        assert ours.replay.state() == theirs.replay.state()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("hidden", [(40, 30), (400, 300)])
def test_in_one_go_an_update_is_that_of_a_learner_on_its_own(hidden, device):
    """To some 1e-6 of the numbers' size, in float32: products are added up in another order. Adam divides a gradient of nearly
    nothing by itself, so a single parameter may differ by more; their mean does not."""
    alone, stacked = ([learner(seed, hidden=hidden) for seed in range(3)] for _ in range(2))
    for _ in range(5):
        for theirs, ours in zip(alone, stacked, strict=True):
            ours.agent.load_tensors(theirs.agent.tensors())  # so that differences do not add up
        stack = Stack(stacked, BATCH, device, batched=True)
        before = [numbers(one) for one in alone]
        stack.update(dict.fromkeys(range(3), 0.5))
        for number, (ours, theirs) in enumerate(zip(stacked, alone, strict=True)):
            theirs.update(BATCH, 0.5)
            stack.settle(number)
            for name, expected in numbers(theirs).items():
                difference, size = np.abs(numbers(ours)[name] - expected), np.abs(expected).max()
                moves = name.endswith("parameters")
                assert difference.mean() <= 1e-6 * size, name
                assert difference.max() <= 3e-6 * size or moves, name
                assert difference.max() <= 0.1 * 1e-3 or not moves, name  # a tenth of a step
                assert not np.array_equal(expected, before[number][name])
            assert ours.metrics == pytest.approx(theirs.metrics, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize(("device", "batched"), WAYS)
def test_who_rests_keeps_every_byte(device, batched):
    stacked = [learner(seed) for seed in range(3)]
    stack = Stack(stacked, BATCH, device, batched=batched)
    stack.update(dict.fromkeys(range(3), 0.0))
    for number in range(3):
        stack.settle(number)
    before, metrics = numbers(stacked[1]), stacked[1].metrics
    for _ in range(3):
        stack.update({0: 0.0, 2: 0.0})
    for number in range(3):
        stack.settle(number)
    assert all(np.array_equal(value, before[name]) for name, value in numbers(stacked[1]).items())
    assert (stacked[1].metrics, stacked[1].counters.updates) == (metrics, 1)
    assert stacked[0].counters.updates == 4


@pytest.mark.parametrize(("device", "batched"), WAYS)
def test_actions_are_those_of_the_policy_after_the_last_update(device, batched):
    stacked = [learner(seed) for seed in range(3)]
    stack = Stack(stacked, BATCH, device, batched=batched)
    for _ in range(3):
        stack.update(dict.fromkeys(range(3), 0.0))
    seen = {number: np.random.default_rng(number).normal(0, 0.2, 20).astype(np.float32) for number in (0, 2)}
    before = {number: stacked[number].policy.act(one) for number, one in seen.items()}
    actions = {number: action.copy() for number, action in stack.act(seen).items()}
    assert actions.keys() == {0, 2}
    for number, one in seen.items():
        stack.settle(number)
        np.testing.assert_allclose(actions[number], stacked[number].policy.act(one), atol=2e-6 if batched else 0.0)
        assert not np.allclose(actions[number], before[number])


@pytest.mark.parametrize(("device", "batched"), WAYS)
def test_one_that_diverges_is_named_and_leaves_the_others_as_they_are(device, batched):
    alone, stacked = ([learner(seed) for seed in (0, 2, 4)] for _ in range(2))
    stacked[1].agent.parameters[7] = float("nan")
    stack = Stack(stacked, BATCH, device, batched=batched)
    for _ in range(3):
        stack.update({number: 0.0 for number in range(3)})
        for number in (0, 2):
            alone[number].update(BATCH, 0.0)
    with pytest.raises(DivergenceError, match="parameters"):
        stack.settle(1)
    for number in (0, 2):
        stack.settle(number)
        for name, expected in numbers(alone[number]).items():
            np.testing.assert_allclose(numbers(stacked[number])[name], expected, atol=1e-4 if batched else 0.0, err_msg=name)
