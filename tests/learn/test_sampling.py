"""What mini-batches are made of: sums of priorities, what is drawn, what it counts, and that it can be resumed."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.learn.test_ddpg import agent, batch
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.learn.returns import Transition
from uarm_rl.learn.sampling import Prioritized, SumTree

PRIORITIES = st.lists(st.floats(1e-9, 1e9) | st.just(0.0), min_size=1, max_size=40)
WRITES = st.lists(st.tuples(st.integers(0, 50), st.floats(0.0, 1e6)), min_size=1, max_size=60)


@given(WRITES)
def test_a_tree_depends_on_its_numbers_alone(writes):
    grown, numbers = SumTree(), {}
    for place, value in writes:
        grown.put(np.array([place]), np.array([value]))
        numbers[place] = value
    at_once = SumTree()
    at_once.put(np.array(list(numbers)), np.array(list(numbers.values())))
    size = max(numbers) + 1
    expected = np.array([numbers.get(place, 0.0) for place in range(size)])
    np.testing.assert_array_equal(grown.values(size), expected)
    np.testing.assert_array_equal(at_once.values(size), expected)
    assert grown.total == at_once.total == pytest.approx(expected.sum())


@given(PRIORITIES, st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_a_tree_finds_what_a_running_sum_finds(priorities, shares):
    if not any(priorities):
        priorities[0] = 1.0
    numbers, tree = np.array(priorities), SumTree()
    tree.put(np.arange(len(numbers)), numbers)
    masses = np.array(shares) * tree.total
    found = tree.find(masses)
    assert (numbers[found] > 0.0).all()
    sums = np.concatenate(([0.0], np.cumsum(numbers)))
    slack = 1e-12 * tree.total
    assert (sums[found] <= masses + slack).all()
    assert (masses <= sums[found + 1] + slack).all()


def prioritized(capacity: int = 8, alpha: float = 1.0, initial_beta: float = 0.5, seed: int = 0) -> ReplayBuffer:
    sampling = Prioritized(alpha=alpha, initial_beta=initial_beta, epsilon=1e-3)
    generator = np.random.default_rng(seed)
    return ReplayBuffer(capacity, observation_size=1, action_size=1, generator=generator, sampling=sampling)


def fill(buffer: ReplayBuffer, numbers: range) -> None:
    for number in numbers:
        buffer.add(Transition(np.full(1, number), np.zeros(1), 0.0, np.zeros(1), 0.9))


def learn(buffer: ReplayBuffer, errors: np.ndarray, size: int = 64) -> None:
    """Updates in which transition i has the error ``errors[i]``, until all have been drawn."""
    for _ in range(40):
        drawn = buffer.sample(size).observation
        buffer.learned(errors[drawn.astype(int)].astype(np.float32))


@pytest.mark.parametrize("alpha", [0.0, 0.6, 1.0])
def test_what_is_drawn_follows_the_priorities(alpha):
    buffer, errors = prioritized(alpha=alpha), np.array([1.0, -2.0, 3.0, -4.0, 5.0, 6.0, 7.0, -20.0])
    fill(buffer, range(8))
    learn(buffer, errors)
    draws = np.concatenate([buffer.sample(64).observation[:, 0].astype(int) for _ in range(200)])
    counts = np.bincount(draws, minlength=8)
    priorities = (np.abs(errors) + 1e-3) ** alpha
    expected = counts.sum() * priorities / priorities.sum()
    assert ((counts - expected) ** 2 / expected).sum() < 24.3  # chi-square, 7 degrees of freedom: 0.1 %


@pytest.mark.parametrize(("progress", "beta"), [(0.0, 0.5), (0.5, 0.75), (1.0, 1.0), (1.2, 1.0)])
def test_weights_make_up_for_what_is_drawn_too_often(progress, beta):
    buffer, errors = prioritized(), np.arange(1.0, 9.0)
    fill(buffer, range(8))
    learn(buffer, errors)
    sample = buffer.sample(64, progress)
    drawn = sample.observation[:, 0].astype(int)
    weights = (errors[drawn] + 1e-3) ** -beta
    assert sample.weight.shape == (64, 1)
    np.testing.assert_allclose(sample.weight[:, 0], weights / weights.max(), rtol=1e-5)


def test_what_is_new_is_drawn_as_often_as_what_surprised_most():
    buffer = prioritized(capacity=4)
    fill(buffer, range(3))
    learn(buffer, np.array([1.0, 8.0, 1.0]))
    fill(buffer, range(3, 5))  # the second takes the place of the oldest
    counts = np.bincount(np.concatenate([buffer.sample(64).observation[:, 0].astype(int) for _ in range(100)]), minlength=5)
    np.testing.assert_allclose(counts / counts.sum(), np.array([0, 8, 1, 8, 8]) / 25, atol=0.01)


def test_a_restored_buffer_goes_on_with_the_same_samples():
    buffer, errors = prioritized(capacity=8), np.arange(30.0)[:, np.newaxis] % 7
    fill(buffer, range(11))
    learn(buffer, errors[:, 0])
    then, state = buffer.snapshot(), buffer.state()

    def go_on(one: ReplayBuffer) -> list[np.ndarray]:
        samples = []
        for number in range(11, 25):
            fill(one, range(number, number + 1))
            samples.append(one.sample(5, 0.3).observation[:, 0].copy())
            one.learned(errors[samples[-1].astype(int)].astype(np.float32))
        return samples

    expected = go_on(buffer)
    resumed = prioritized(capacity=8, seed=5)
    resumed.restore(then(), state)
    np.testing.assert_array_equal(go_on(resumed), expected)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda arrays: arrays | {"priorities": arrays["priorities"][:-1]},
        lambda arrays: arrays | {"priorities": -arrays["priorities"]},
        lambda arrays: arrays | {"priorities": arrays["priorities"].astype(np.float32)},
    ],
)
def test_priorities_that_are_none_are_refused(spoil):
    buffer = prioritized()
    fill(buffer, range(5))
    with pytest.raises(ValueError, match="its priorities are not 5 numbers above 0"):
        prioritized().restore(spoil(buffer.snapshot()()), buffer.state())


def test_what_was_sampled_by_priority_is_not_gone_on_with_uniformly():
    buffer = prioritized()
    fill(buffer, range(5))
    plain = ReplayBuffer(8, observation_size=1, action_size=1, generator=np.random.default_rng(0))
    with pytest.raises(ValueError, match="it was sampled by priority"):
        plain.restore(buffer.snapshot()(), buffer.state())


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"alpha": 2}, "sampling.alpha must be a number from 0 to 1, got 2"),
        ({"initial_beta": -1}, "sampling.initial_beta must be a number from 0 to 1, got -1"),
        ({"epsilon": 0}, "sampling.epsilon must be a number above 0 and at most 1, got 0"),
    ],
)
def test_bad_values_are_refused_in_a_sentence(change, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        Prioritized(**{"alpha": 0.6, "initial_beta": 0.4, "epsilon": 1e-6} | change)


def test_a_weight_of_nothing_teaches_nothing_and_errors_are_those_of_the_targets():
    """Half of the batch weighs nothing: the gradient is that of the other half alone, at half its size."""
    sample = batch(64)
    weight = np.repeat(np.array([[1.0], [0.0]], np.float32), 32, axis=0)
    weighted, alone = agent(), agent()
    weighted.update(sample._replace(weight=weight))
    half = type(sample)(*(field[:32] for field in sample[:-1]))
    alone.update(half)
    split = weighted.parameters.numel() - sum(layer.numel() for pair in weighted.critic.layers for layer in pair)
    np.testing.assert_allclose(
        weighted.parameters[split:], alone.parameters[split:], atol=1e-4
    )  # steps of 1e-3: Adam knows no size
    assert weighted.errors.shape == (64, 1)
    np.testing.assert_allclose(weighted.errors[:32], alone.errors, atol=1e-5)
