"""Intervals and paired tests, held against scipy, closed forms and simulated experiments."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from uarm_rl.report.statistics import bootstrap_interval, mcnemar_exact, success_interval, wilson_interval

counts = st.integers(1, 2000).flatmap(lambda trials: st.tuples(st.integers(0, trials), st.just(trials)))
pairs = st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=120)


def generator(seed: int = 7) -> np.random.Generator:
    return np.random.default_rng(seed)


@given(counts, st.floats(0.5, 0.999))
def test_wilson_agrees_with_scipy_and_contains_the_rate(count, confidence):
    successes, trials = count
    low, high = wilson_interval(successes, trials, confidence)
    assert 0.0 <= low <= successes / trials <= high <= 1.0
    expected = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    assert (low, high) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_wilson_of_a_perfect_score_by_hand():
    z = 1.959963984540054
    assert wilson_interval(100, 100) == pytest.approx((100 / (100 + z * z), 1.0), abs=1e-12)
    assert wilson_interval(0, 100) == pytest.approx((0.0, z * z / (100 + z * z)), abs=1e-12)


@given(pairs)
def test_mcnemar_is_the_binomial_test_of_the_discordant_positions_and_symmetric(outcomes):
    first, second = np.array(outcomes).T
    result = mcnemar_exact(first, second)
    assert result.first_only == sum(a and not b for a, b in outcomes)
    assert result.second_only == sum(b and not a for a, b in outcomes)
    discordant = result.first_only + result.second_only
    expected = binomtest(result.first_only, discordant).pvalue if discordant else 1.0
    assert result.p_value == pytest.approx(expected, abs=1e-12)
    assert mcnemar_exact(second, first) == (result.second_only, result.first_only, result.p_value)


def test_mcnemar_by_hand():
    assert mcnemar_exact([1] * 6 + [0] * 4, [0] * 6 + [0] * 4) == (6, 0, pytest.approx(2 / 2**6))


def test_bootstrap_is_deterministic_and_takes_its_randomness_from_the_generator():
    outcomes = generator().random((3, 40)) < 0.7
    assert bootstrap_interval([outcomes], [1.0], generator()) == bootstrap_interval([outcomes], [1.0], generator())
    assert bootstrap_interval([outcomes], [1.0], generator(), resamples=50) != bootstrap_interval(
        [outcomes], [1.0], generator(8), resamples=50
    )


def test_bootstrap_of_one_seed_is_the_spread_over_positions():
    outcomes = np.arange(400)[np.newaxis] % 4 > 0  # 75 %
    low, high = bootstrap_interval([outcomes], [1.0], generator())
    half = 1.96 * math.sqrt(0.75 * 0.25 / 400)
    assert (low, high) == pytest.approx((0.75 - half, 0.75 + half), abs=0.006)


def test_bootstrap_of_seeds_that_each_fail_or_succeed_everywhere_is_the_spread_over_seeds():
    outcomes = np.repeat([[1.0], [0.0], [1.0]], 100, axis=1)
    assert bootstrap_interval([outcomes], [1.0], generator()) == (0.0, 1.0)  # 1 of 27 draws is all failures


def test_positions_are_shared_so_equal_methods_differ_by_exactly_zero():
    outcomes = np.tile(generator().random(50) < 0.5, (3, 1))  # hard and easy positions, equal seeds
    assert bootstrap_interval([outcomes, outcomes], [1.0, -1.0], generator()) == (0.0, 0.0)
    assert bootstrap_interval([outcomes] * 4, [1.0, -1.0, -1.0, 1.0], generator()) == (0.0, 0.0)


def test_interaction_is_the_difference_of_differences():
    rates = [0.99, 0.75, 1.00, 0.60]
    methods = [generator(index).random((5, 200)) < rate for index, rate in enumerate(rates)]
    low, high = bootstrap_interval(methods, [1.0, -1.0, -1.0, 1.0], generator())
    means = [float(method.mean()) for method in methods]
    assert low < means[0] - means[1] - means[2] + means[3] < high < 0.0


def test_methods_may_have_different_numbers_of_seeds():
    low, high = bootstrap_interval([np.ones((3, 20)), np.zeros((1, 20))], [1.0, -1.0], generator())
    assert (low, high) == (1.0, 1.0)


def test_bootstrap_covers_the_true_rate_about_as_often_as_it_says():
    experiments, covered = generator(), 0
    for _ in range(200):
        skill = experiments.normal(0.0, 0.6, (8, 1))  # of a seed
        ease = experiments.normal(0.0, 0.6, (1, 60))  # of a position
        outcomes = experiments.random((8, 60)) < 1 / (1 + np.exp(-(1.0 + skill + ease)))
        low, high = bootstrap_interval([outcomes], [1.0], experiments, resamples=300)
        covered += low <= 0.7046 <= high  # E[logistic(1 + N(0, 0.72))]
    assert 0.85 <= covered / 200 <= 1.0


def test_success_interval_is_wilson_for_one_seed():
    outcomes = np.arange(100)[np.newaxis] < 80
    assert success_interval(outcomes, generator()) == wilson_interval(80, 100)


@pytest.mark.parametrize("outcome", [0, 1])
def test_success_interval_of_equal_outcomes_counts_the_positions_once(outcome):
    assert success_interval(np.full((5, 100), outcome), generator()) == wilson_interval(100 * outcome, 100)


def test_success_interval_of_several_seeds_is_the_bootstrap():
    outcomes = generator().random((3, 40)) < 0.9
    assert success_interval(outcomes, generator()) == bootstrap_interval([outcomes], [1.0], generator())


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: wilson_interval(1, 0), "trials must be a whole number of at least 1, got 0"),
        (lambda: wilson_interval(11, 10), "successes must be a whole number from 0 to 10, got 11"),
        (lambda: wilson_interval(1, 10, 1.0), "confidence must be a number between 0 and 1, got 1.0"),
        (lambda: mcnemar_exact([1, 0], [1]), "the same positions, got 2 and 1"),
        (lambda: mcnemar_exact([1, 2], [1, 0]), "first must hold nothing but 0 and 1"),
        (lambda: mcnemar_exact([], []), r"first must hold finite numbers in the shape \(positions,\)"),
        (lambda: bootstrap_interval([], [], generator()), "every method needs one weight"),
        (lambda: bootstrap_interval([[[1]]], [1, 2], generator()), "got 1 methods and 2 weights"),
        (lambda: bootstrap_interval([[[1, 0]], [[1]]], [1, -1], generator()), r"must share their positions, got \[2, 1\]"),
        (lambda: bootstrap_interval([[1, 0]], [1], generator()), r"methods\[0\] must hold .* shape \(seeds, positions\)"),
        (lambda: bootstrap_interval([[[1, math.nan]]], [1], generator()), "finite numbers"),
        (lambda: bootstrap_interval([[[1]]], [1], generator(), resamples=0), "resamples must be a whole number"),
        (lambda: bootstrap_interval([[[1]]], [1], generator(), confidence=95.0), "confidence must be a number between"),
        (lambda: success_interval([[0.5]], generator()), "successes must hold nothing but 0 and 1"),
    ],
)
def test_bad_input_is_answered_with_a_sentence(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call()
