"""How far a success rate can be trusted: intervals, and comparisons that are paired on the test positions."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, comb
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uarm_rl import checks

Interval = tuple[float, float]


class Discordance(NamedTuple):
    """Positions at which exactly one of two policies succeeded, and the p-value of the exact McNemar test."""

    first_only: int
    second_only: int
    p_value: float


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> Interval:
    """The score interval of a binomial proportion, without continuity correction (Wilson 1927, JASA 22:209)."""
    checks.integer("trials", trials, low=1)
    checks.integer("successes", successes, low=0, high=trials)
    z = NormalDist().inv_cdf((1.0 + _confidence(confidence)) / 2.0)
    rate, shrinkage = successes / trials, z * z / trials
    centre = (rate + shrinkage / 2.0) / (1.0 + shrinkage)
    half = z * (rate * (1.0 - rate) / trials + shrinkage / (4.0 * trials)) ** 0.5 / (1.0 + shrinkage)
    # Exact ends: rounding must not exclude the rate itself.
    return (0.0 if successes == 0 else centre - half), (1.0 if successes == trials else centre + half)


def mcnemar_exact(first: ArrayLike, second: ArrayLike) -> Discordance:
    """Whether two policies differ on the same positions: exact two-sided McNemar test (1947, Psychometrika 12:153).

    ``first`` and ``second`` hold a 0 or 1 for each position, shape (positions,). Under the null hypothesis each
    discordant position falls to either policy with probability 1/2.
    """
    one, other = _successes("first", first, 1), _successes("second", second, 1)
    if one.shape != other.shape:
        raise ValueError(f"first and second must cover the same positions, got {one.size} and {other.size}")
    first_only, second_only = int(np.sum(one > other)), int(np.sum(one < other))
    discordant = first_only + second_only
    as_uneven = 2 * sum(comb(discordant, count) for count in range(min(first_only, second_only) + 1))
    return Discordance(first_only, second_only, min(1.0, as_uneven / 2**discordant))


def bootstrap_interval(
    methods: Sequence[ArrayLike],
    weights: Sequence[float],
    generator: np.random.Generator,
    *,
    confidence: float = 0.95,
    resamples: int = 10_000,
) -> Interval:
    """Percentile interval of ``sum(weight * mean of the method)`` by a bootstrap over seeds, then positions.

    Each method is an array of outcomes, shape (its seeds, positions). Weights (1,) give a success rate, (1, -1) the
    difference of two methods, (1, -1, -1, 1) the interaction of a 2 x 2 given row by row.

    Seeds are drawn anew for each method, because trainings share nothing; positions are drawn once for all methods
    and seeds, because all were tested on the same ones: Owen 2007, "The pigeonhole bootstrap", Ann. Appl. Stat. 1:386.
    With n seeds the spread between seeds is understated by the factor sqrt((n - 1) / n); three are few.
    """
    outcomes = [_outcomes(f"methods[{index}]", method, 2) for index, method in enumerate(methods)]
    if not outcomes or len(outcomes) != len(weights):
        raise ValueError(f"every method needs one weight, got {len(outcomes)} methods and {len(weights)} weights")
    if len({method.shape[1] for method in outcomes}) > 1:
        raise ValueError(f"the methods must share their positions, got {[method.shape[1] for method in outcomes]} of them")
    checks.integer("resamples", resamples, low=1)
    tail = (1.0 - _confidence(confidence)) / 2.0
    positions = _draws(outcomes[0].shape[1], resamples, generator)
    total = np.zeros(resamples)
    for method, weight in zip(outcomes, weights, strict=True):
        seeds = _draws(method.shape[0], resamples, generator)
        total += weight * np.sum(seeds @ method * positions, axis=1) / method.size
    low, high = np.quantile(total, (tail, 1.0 - tail)).tolist()
    return low, high


def quantile(values: ArrayLike, share: float) -> float:
    """The least of ``values`` (any shape, infinite ones too) that a ``share`` of them does not exceed."""
    array = np.sort(np.asarray(values, np.float64), axis=None)
    least: float = array[max(0, ceil(share * array.size - 1e-9) - 1)].item()  # numpy's own stumbles over infinity
    return least


def quantile_interval(
    values: ArrayLike, share: float, generator: np.random.Generator, *, confidence: float = 0.95, resamples: int = 10_000
) -> Interval:
    """Percentile interval of ``quantile`` of values of the shape (seeds, positions), by the same bootstrap over both."""
    array = np.asarray(values, np.float64)
    seeds, positions = (_draws(size, resamples, generator) for size in array.shape)
    order = np.argsort(array, axis=None, kind="stable")
    weights = (seeds[:, :, np.newaxis] * positions[:, np.newaxis, :]).reshape(resamples, -1)[:, order]
    below = np.cumsum(weights, axis=1)
    reached = np.argmax(below >= share * below[:, -1:] - 1e-9, axis=1)
    tail = (1.0 - _confidence(confidence)) / 2.0
    drawn = array.ravel()[order][reached]
    return quantile(drawn, tail), quantile(drawn, 1.0 - tail)


def success_interval(successes: ArrayLike, generator: np.random.Generator, *, resamples: int = 10_000) -> Interval:
    """The 95 % interval of one method's success rate; ``successes`` are 0 or 1, shape (seeds, positions).

    One seed: Wilson, for this policy. Several: bootstrap, for the method. Where all outcomes are equal a bootstrap
    returns a point, so there it is Wilson with as many trials as one seed has positions: trials of different seeds
    share the positions and are not independent, and counting one seed errs on the wide side.
    """
    outcomes = _successes("successes", successes, 2)
    if len(outcomes) == 1 or np.all(outcomes == outcomes[0, 0]):
        return wilson_interval(int(outcomes[0].sum()), outcomes.shape[1])
    return bootstrap_interval([outcomes], [1.0], generator, resamples=resamples)


def _draws(size: int, resamples: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """How often each of ``size`` things is drawn in ``size`` draws with replacement, shape (resamples, size)."""
    # Ten times as fast as ``generator.multinomial`` for equal chances.
    cells = generator.integers(size, size=(resamples, size)) + size * np.arange(resamples)[:, np.newaxis]
    return np.bincount(cells.ravel(), minlength=resamples * size).reshape(resamples, size).astype(np.float64)


def _confidence(value: float) -> float:
    if not 0.0 < value < 1.0:
        raise ValueError(f"confidence must be a number between 0 and 1, got {value!r}")
    return value


def _outcomes(name: str, values: ArrayLike, dimensions: int) -> NDArray[np.float64]:
    array = np.asarray(values, np.float64)
    if array.ndim != dimensions or array.size == 0 or not np.all(np.isfinite(array)):
        shape = ("(positions,)", "(seeds, positions)")[dimensions - 1]
        raise ValueError(f"{name} must hold finite numbers in the shape {shape}, got the shape {array.shape}")
    return array


def _successes(name: str, values: ArrayLike, dimensions: int) -> NDArray[np.float64]:
    array = _outcomes(name, values, dimensions)
    if not np.all((array == 0.0) | (array == 1.0)):
        raise ValueError(f"{name} must hold nothing but 0 and 1")
    return array
