"""What may enter the replay buffer, and the ring that stores it."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uarm_rl.learn.admission import AdmitAll, NotStuck
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.learn.returns import Transition


@pytest.mark.parametrize(
    ("clipped", "travel_rad", "admits"),
    [(False, 0.0, True), (False, 0.1, True), (True, 0.1, True), (True, 0.001, True), (True, 0.0009, False), (True, 0.0, False)],
)
def test_stuck_means_cut_at_a_limit_and_not_moved(clipped, travel_rad, admits):
    assert NotStuck(stuck_threshold_rad=0.001).admits(clipped, travel_rad) is admits
    assert AdmitAll().admits(clipped, travel_rad) is True


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: NotStuck(float("nan")), "admission.stuck_threshold_rad must be a finite number above 0, got nan"),
        (lambda: ring(0), "buffer.capacity must be a whole number from 1 to 10000000, got 0"),
    ],
)
def test_bad_values_are_refused_in_a_sentence(build, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        build()


def ring(capacity: int, seed: int = 0) -> ReplayBuffer:
    return ReplayBuffer(capacity, observation_size=2, action_size=1, generator=np.random.default_rng(seed))


def fill(buffer: ReplayBuffer, numbers: range) -> None:
    for number in numbers:
        buffer.add(Transition(np.full(2, number), np.full(1, -number), 10.0 * number, np.full(2, number + 0.5), number % 2))


@given(capacity=st.integers(1, 12), added=st.integers(1, 40))
def test_the_ring_holds_the_newest(capacity, added):
    buffer = ring(capacity)
    fill(buffer, range(added))
    assert len(buffer) == min(capacity, added)
    held = set(buffer.sample(400).observation[:, 0].tolist())
    assert held <= set(range(max(0, added - capacity), added))
    assert len(held) > len(buffer) // 2


def test_a_sample_keeps_transitions_together():
    buffer = ring(10)
    fill(buffer, range(13))
    batch = buffer.sample(64)
    number = batch.observation[:, :1]
    assert [field.shape for field in batch[:-1]] == [(64, 2), (64, 1), (64, 1), (64, 2), (64, 1)]
    np.testing.assert_array_equal(batch.action, -number)
    np.testing.assert_array_equal(batch.reward, 10 * number)
    np.testing.assert_array_equal(batch.next_observation, np.hstack([number, number]) + 0.5)
    np.testing.assert_array_equal(batch.discount, number % 2)


def test_sampling_is_uniform_and_reproducible():
    buffer, same, other = ring(8, seed=1), ring(8, seed=1), ring(8, seed=2)
    for one in (buffer, same, other):
        fill(one, range(8))
    first = buffer.sample(8000).observation[:, 0].copy()
    np.testing.assert_array_equal(first, same.sample(8000).observation[:, 0])
    assert not np.array_equal(first, other.sample(8000).observation[:, 0])
    counts = np.bincount(first.astype(int), minlength=8)
    assert counts.min() > 850  # 1000 expected, standard deviation 30
    assert counts.max() < 1150


def test_an_empty_ring_refuses_to_sample():
    with pytest.raises(ValueError, match="empty"):
        ring(3).sample(1)


@pytest.mark.parametrize("more", [0, 5, 20])
@pytest.mark.parametrize("added", [3, 11])
def test_what_was_stored_at_an_instant_is_given_back_after_it_was_overwritten(added, more):
    buffer = ring(8)
    fill(buffer, range(added))
    then = buffer.snapshot()
    expected = buffer.rows[: len(buffer)].copy()
    fill(buffer, range(100, 100 + more))
    np.testing.assert_array_equal(then()["transitions"], expected)
