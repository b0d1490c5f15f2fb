"""How long a command acts."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uarm_rl.task.hold import FixedHold, SteadySpeed, UntilSteady


@pytest.mark.parametrize(
    ("control_steps", "travel_rad", "releases"),
    [
        (1, 0.0, False),  # before the minimum an arm at rest has not started yet
        (2, 0.0, True),
        (2, 0.00199, True),
        (2, 0.002, False),  # "less than", section 3.3
        (9, 0.1, False),
        (10, 0.1, True),  # the maximum ends every wait
        (11, 0.1, True),
    ],
)
def test_until_steady(control_steps, travel_rad, releases):
    hold = UntilSteady(steady_threshold_rad=0.002, min_control_steps=2, max_control_steps=10)
    assert hold.releases(control_steps, travel_rad, 1.0) is releases


@given(st.integers(1, 12), st.floats(0, 0.01), st.floats(0, 0.01))
def test_a_steady_speed_is_judged_as_a_steady_place_is(control_steps, travel_rad, change_rad):
    settings = {"steady_threshold_rad": 0.002, "min_control_steps": 2, "max_control_steps": 10}
    place, speed = UntilSteady(**settings), SteadySpeed(**settings)
    assert speed.releases(control_steps, travel_rad, change_rad) is place.releases(control_steps, change_rad, travel_rad)


@given(st.integers(1, 50), st.floats(0, 1))
def test_fixed_hold_looks_at_the_clock_alone(control_steps, travel_rad):
    assert FixedHold(1).releases(control_steps, travel_rad, 0.0)
    assert FixedHold(7).releases(control_steps, travel_rad, 0.0) is (control_steps >= 7)


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: FixedHold(0), "hold.control_steps must be a whole number of at least 1, got 0"),
        (lambda: FixedHold(True), "got True"),
        (lambda: UntilSteady(0.0, 1, 2), "hold.steady_threshold_rad must be a number above 0, got 0.0"),
        (lambda: UntilSteady(0.1, 5, 4), "hold.max_control_steps must be a whole number of at least 5, got 4"),
    ],
)
def test_bad_values_are_refused_in_a_sentence(build, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        build()
