"""What transitions say of the future: discounts, and rewards added up over several decisions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uarm_rl.learn.returns import Returns, Transition


def returns(n_steps: int = 1, gamma: float = 0.5, per: str = "decision") -> Returns:
    return Returns(gamma=gamma, gamma_per=per, n_steps=n_steps)


def decision(number: int, discount: float = 0.5) -> Transition:
    """From state ``number`` to the next, for a reward of its own."""
    return Transition(np.array([number]), np.array([-number]), 10.0**-number, np.array([number + 1]), discount)


def test_a_discount_is_per_decision_or_per_control_step():
    assert [returns(gamma=0.9).discount(steps) for steps in (1, 13)] == [0.9, 0.9]
    timed = returns(gamma=0.992, per="control_step")
    assert timed.discount(1) == 0.992
    assert timed.discount(13) == pytest.approx(0.9, abs=1e-3)
    assert timed.discount(3) * timed.discount(5) == pytest.approx(timed.discount(8))  # a hold in two halves sees equally far


def test_one_step_hands_on_what_it_gets():
    one, made = returns(), decision(0)
    assert one.add(made) == [made]
    assert (one.held_back, one.cut()) == (0, [])


@given(st.integers(1, 6), st.lists(st.sampled_from(["goes on", "terminates", "is cut"]), max_size=25))
def test_targets_are_those_of_the_definition(n_steps, ends):
    """sum of gamma^i r_(t+i), then gamma^m of the state behind, with m as many as there are up to n."""
    one, stored, waiting = returns(n_steps), [], 0
    for number, end in enumerate(ends):
        stored += one.add(decision(number, 0.0 if end == "terminates" else 0.5))
        if end == "is cut":
            stored += one.cut()
        waiting = 0 if end != "goes on" else min(waiting + 1, n_steps - 1)
        assert one.held_back == waiting
    stored += one.cut()
    assert [transition.observation.item() for transition in stored] == list(range(len(ends)))  # in their order
    for start, transition in enumerate(stored):
        length = 1
        while length < n_steps and start + length < len(ends) and ends[start + length - 1] == "goes on":
            length += 1
        last = start + length - 1
        assert transition.action.item() == -start
        assert transition.reward == pytest.approx(sum(0.5**i * 10.0 ** -(start + i) for i in range(length)))
        assert transition.next_observation.item() == last + 1
        assert transition.discount == (0.0 if ends[last] == "terminates" else 0.5**length)


def test_what_ends_with_a_decision_goes_on_as_it_does():
    """Control steps within it: their own reward and discount, then those of the decisions behind."""
    one = returns(n_steps=2)
    within = Transition(np.array([0.5]), np.array([7]), 100.0, np.array([1]), 0.8)
    assert one.add(decision(0), within) == []
    assert one.held_back == 1
    first, second = one.add(decision(1))
    assert (first.reward, first.discount) == (pytest.approx(1 + 0.5 * 0.1), 0.25)
    assert (second.reward, second.discount) == (pytest.approx(100 + 0.8 * 0.1), pytest.approx(0.4))
    assert [one.observation.item() for one in (first, second)] == [0, 0.5]
    assert [one.next_observation.item() for one in (first, second)] == [2, 2]
