"""One episode of a policy: the same function for evaluation in simulation and for the real arm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.policy import Policy


@dataclass(frozen=True)
class Episode:
    """What happened. ``trace`` has the state at the start and one row a look (``columns.STATE``): in simulation a
    look is a control step, a real arm is looked at when it stands still.
    """

    success: bool
    episode_return: float
    decisions: int
    trace: NDArray[np.float64]  # (looks + 1, 9)


def run_episode(env: UArmSuctionEnv, policy: Policy, **reset: Any) -> Episode:
    """Reset ``env`` with the keywords ``reset`` (``seed``, ``options``) and follow the greedy policy to the end."""
    observation, _ = env.reset(**reset)
    traces = [env.state()[np.newaxis]]
    episode_return, decisions = 0.0, 0
    terminated = truncated = False
    while not (terminated or truncated):
        observation, reward, terminated, truncated, _ = env.step(policy.act(observation))
        traces.append(env.trace)
        episode_return += reward
        decisions += 1
    return Episode(terminated, episode_return, decisions, np.concatenate(traces))
