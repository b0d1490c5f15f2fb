"""Equation (4) of the paper, by hand and by its properties."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uarm_rl.task.reward import DistanceReward

points = st.tuples(*[st.floats(-0.5, 0.5)] * 3)


def test_by_hand():
    reward = DistanceReward(alpha=2.0, beta=10.0, sigma=-5.0, alpha_d=-1.0, beta_d=-3.0)
    # Before: d_h = 0.05 (3-4-5 triangle), d_v = 0.10; after: d_h = 0, d_v = 0.02, the object moved 0.05 m.
    terms = reward((0.20, 0.00, 0.13), (0.23, 0.04, 0.03), (0.20, 0.00, 0.05), (0.20, 0.00, 0.03))
    r_before = -1.0 * 0.05 - 3.0 * 0.10
    r_after = -1.0 * 0.0 - 3.0 * 0.02
    assert terms.distance == pytest.approx(2.0 * r_after)
    assert terms.progress == pytest.approx(10.0 * (r_after - r_before))
    assert terms.displacement == pytest.approx(-5.0 * 0.05)
    assert terms.total == pytest.approx(2.0 * r_after + 10.0 * (r_after - r_before) - 0.25)


@given(points, points, points, points)
def test_plain_and_penalty_differ_in_the_displacement_alone(cup, target, next_cup, next_target):
    plain = DistanceReward(1.0, 10.0, 0.0, -1.0, -1.0)(cup, target, next_cup, next_target)
    penalty = DistanceReward(1.0, 10.0, -5.0, -1.0, -1.0)(cup, target, next_cup, next_target)
    assert (plain.distance, plain.progress) == (penalty.distance, penalty.progress)
    assert plain.displacement == 0
    assert penalty.displacement <= 0


@given(points, points)
def test_standing_still_earns_the_distance_term_only(cup, target):
    terms = DistanceReward(1.0, 10.0, -5.0, -1.0, -1.0)(cup, target, cup, target)
    assert terms.total == terms.distance <= 0


@given(points, points, points, st.floats(1e-3, 1.0))
def test_a_saturated_reward_is_as_steep_at_the_object_and_never_as_far_down(cup, target, next_cup, saturation):
    plain = DistanceReward(1.0, 10.0, -5.0, -1.0, -1.0)
    saturated = DistanceReward(1.0, 10.0, -5.0, -1.0, -1.0, saturation=saturation)
    far, shown = plain.distance_reward(cup, target), saturated.distance_reward(cup, target)
    assert max(far, -saturation) <= shown <= far / (1.0 + abs(far) / saturation) + 1e-12
    lowest, highest = saturated.bounds(2.0, 1.0)
    assert lowest <= saturated(cup, target, next_cup, target).total <= highest
    near = saturated.distance_reward((target[0] + 1e-9, *target[1:]), target)
    assert near == pytest.approx(plain.distance_reward((target[0] + 1e-9, *target[1:]), target), rel=1e-5)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("alpha", 0.0),
        ("alpha", "1"),
        ("beta", -1.0),
        ("sigma", 0.1),
        ("alpha_d", 1.0),
        ("beta_d", float("inf")),
        ("saturation", 0.0),
    ],
)
def test_signs_that_the_paper_excludes_are_refused(name, value):
    values = {"alpha": 1.0, "beta": 10.0, "sigma": 0.0, "alpha_d": -1.0, "beta_d": -1.0} | {name: value}
    with pytest.raises(ValueError, match=f"reward.{name} must be a"):
        DistanceReward(**values)
