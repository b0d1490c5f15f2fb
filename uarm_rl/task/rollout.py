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
    press_m: float = 0.0  # the deepest that the cup was below the object's upper surface while over it
    reference_press_m: float = 0.0  # and the deepest that it was told to be
    contact_n: float = 0.0  # the largest normal force between cup and object
    obstacle_contact_n: float = 0.0  # and between the arm and an obstacle


def run_episode(env: UArmSuctionEnv, policy: Policy, **reset: Any) -> Episode:
    """Reset ``env`` with the keywords ``reset`` (``seed``, ``options``) and follow the greedy policy to the end."""
    observation, _ = env.reset(**reset)
    traces = [env.state()[np.newaxis]]
    episode_return, decisions = 0.0, 0
    terminated = truncated = False
    leaning = dict.fromkeys(("press_m", "reference_press_m", "contact_n", "obstacle_contact_n"), 0.0)
    while not (terminated or truncated):
        observation, reward, terminated, truncated, info = env.step(policy.act(observation))
        leaning = {name: max(value, info[name]) for name, value in leaning.items()}
        traces.append(env.trace)
        episode_return += reward
        decisions += 1
    return Episode(info["is_success"], episode_return, decisions, np.concatenate(traces), **leaning)
