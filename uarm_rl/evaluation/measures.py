"""What an episode of a test shows, in the columns of an evaluation and of its traces."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from uarm_rl import columns
from uarm_rl.task.reward import DistanceReward
from uarm_rl.task.rollout import Episode

Row = dict[str, float | int | bool | str]

_TRACE_DECIMALS: Final = 6  # micrometres, microradians

#: Movements shorter than this in one control step have no direction worth counting as reversed.
_REVERSAL_M: Final = 1e-4


def measure(position: int, episode: Episode, common_reward: DistanceReward, *, control_hz: int) -> Row:
    """What one episode shows, with the keys ``columns.MEASURED``, and how the arm leaned and touched.

    ``common_return`` sums one reward, the same for all methods, over control steps.
    """
    cup, target = episode.trace[:, 3:6], episode.trace[:, 6:9]
    distance = np.linalg.norm(cup - target, axis=1)
    states = list(zip(cup.tolist(), target.tolist(), strict=True))
    return {
        "position": position,
        "success": episode.success,
        "return": episode.episode_return,
        "common_return": sum(common_reward(*state, *following).total for state, following in pairwise(states)),
        "time_s": (len(cup) - 1) / control_hz,
        "final_distance_m": float(distance[-1]),
        "min_distance_m": float(distance.min()),
        "object_displacement_m": float(np.linalg.norm(target[-1] - target[0])),
        **shaking(cup, control_hz=control_hz),
        "decisions": episode.decisions,
        "press_m": episode.press_m,
        "reference_press_m": episode.reference_press_m,
        "contact_n": episode.contact_n,
        "touched": episode.obstacle_contact_n > 0.0,
        "obstacle_contact_n": episode.obstacle_contact_n,
    }


def settled_distance_m(trace: NDArray[np.float64], dwell_steps: int) -> float:
    """How near the cup came to stay: the least, over all windows of ``dwell_steps`` looks, of the largest distance (m) in one.

    ``trace`` is that of an episode which nothing but time ends. Then a test with the tolerance t succeeds where this is at most
    t: the environment counts the same looks, the start not among them. NaN if there are fewer.
    """
    distances = np.array([math.dist(state[3:6], state[6:9]) for state in trace[1:].tolist()])  # as the environment has it
    if len(distances) < dwell_steps:
        return math.nan
    return float(np.lib.stride_tricks.sliding_window_view(distances, dwell_steps).max(axis=1).min())


def trace_rows(position: int, episode: Episode, *, control_hz: int) -> Iterator[Row]:
    """The episode control step by control step, with the keys ``columns.TRACES``."""
    for step, state in enumerate(np.round(episode.trace, _TRACE_DECIMALS).tolist()):
        yield {"position": position, "step": step, "time_s": step / control_hz, **dict(zip(columns.STATE, state, strict=True))}


def shaking(tip_m: NDArray[np.float64], *, control_hz: int) -> dict[str, float]:
    """How restless the tip is, from its path (shape (n, 3), one row a control step).

    ``reversals_per_s``: how often two consecutive movements point against each other. ``rms_jerk`` (m/s^3): root
    mean square of the third difference. ``tip_travel_last_s_m``: length of the path in the last second.
    """
    moves = np.diff(tip_m, axis=0)
    lengths = np.linalg.norm(moves, axis=1)
    real = (lengths[1:] > _REVERSAL_M) & (lengths[:-1] > _REVERSAL_M)
    reversals = np.count_nonzero(real & (np.einsum("ij,ij->i", moves[1:], moves[:-1]) < 0.0))
    jerk = np.diff(tip_m, n=3, axis=0) * control_hz**3
    return {
        "reversals_per_s": reversals * control_hz / max(1, len(moves)),
        "rms_jerk": float(np.sqrt(np.mean(np.sum(jerk**2, axis=1)))) if len(jerk) else 0.0,
        "tip_travel_last_s_m": float(lengths[-control_hz:].sum()),
    }
