"""The reward of the paper, equation (4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from uarm_rl import checks

_LARGEST: Final = 1e4  # a weight; beyond it float32 has no room for the rest


@dataclass(frozen=True)
class RewardTerms:
    """The three terms of equation (4), and two that are not the paper's; their sum is the reward.

    ``touching`` stands alone: an arm that touches an obstacle ends its attempt, and gets what the task has for that.
    """

    distance: float  # alpha * r_d(s')
    progress: float  # beta * (r_d(s') - r_d(s))
    displacement: float  # sigma * d_o(s, s')
    pressing: float = 0.0
    touching: float = 0.0

    @property
    def total(self) -> float:
        """The reward."""
        return self.distance + self.progress + self.displacement + self.pressing + self.touching


@dataclass(frozen=True)
class DistanceReward:
    """``alpha r_d(s') + beta (r_d(s') - r_d(s)) + sigma d_o(s, s')`` with ``r_d = alpha_d d_h + beta_d d_v``.

    d_h and d_v are the horizontal and vertical distances (m) from the cup to the centre of the object's upper
    surface, d_o the distance (m) by which the object moved. The paper demands alpha, beta > 0 and
    alpha_d, beta_d < 0; sigma is 0 (methods A, B) or negative (methods C, D).

    Two are not the paper's. ``pressing`` (1/m) punishes the depth of the cup below that surface. With ``saturation``, r_d
    becomes ``r_d / (1 + |r_d| / saturation)``: as steep as before at the object and never below -saturation, so that the
    last millimetres weigh more than the way there, and a way round costs little.
    """

    alpha: float
    beta: float
    sigma: float
    alpha_d: float
    beta_d: float
    pressing: float = 0.0
    saturation: float | None = None

    def __post_init__(self) -> None:
        checks.number("reward.alpha", self.alpha, low=0.0, high=_LARGEST, open_low=True)
        checks.number("reward.beta", self.beta, low=0.0, high=_LARGEST)
        checks.number("reward.sigma", self.sigma, low=-_LARGEST, high=0.0)
        checks.number("reward.alpha_d", self.alpha_d, low=-_LARGEST, high=0.0)
        checks.number("reward.beta_d", self.beta_d, low=-_LARGEST, high=0.0)
        checks.number("reward.pressing", self.pressing, low=-_LARGEST, high=0.0)
        if self.saturation is not None:
            checks.number("reward.saturation", self.saturation, low=0.0, high=_LARGEST, open_low=True)

    def distance_reward(self, cup_m: Sequence[float], object_m: Sequence[float]) -> float:
        """r_d of one state."""
        horizontal = math.hypot(cup_m[0] - object_m[0], cup_m[1] - object_m[1])
        return self._of(horizontal, abs(cup_m[2] - object_m[2]))

    def _of(self, horizontal_m: float, vertical_m: float) -> float:
        reward = self.alpha_d * horizontal_m + self.beta_d * vertical_m
        return reward if self.saturation is None else reward / (1.0 - reward / self.saturation)

    def bounds(self, horizontal_m: float, vertical_m: float) -> tuple[float, float]:
        """Lowest and highest reward of a step, if no distance or displacement exceeds these two (m)."""
        farthest = self._of(horizontal_m, vertical_m)
        lowest = (self.alpha + self.beta) * farthest + self.sigma * math.hypot(horizontal_m, vertical_m)
        lowest += self.pressing * vertical_m
        return lowest, -self.beta * farthest

    def __call__(
        self,
        cup_m: Sequence[float],
        object_m: Sequence[float],
        next_cup_m: Sequence[float],
        next_object_m: Sequence[float],
        press_m: float = 0.0,
    ) -> RewardTerms:
        """Terms of the reward for the step from (cup, object) to (next cup, next object), positions in metres.

        ``press_m``: how deep the cup was below the object's upper surface on the way, at most.
        """
        before = self.distance_reward(cup_m, object_m)
        after = self.distance_reward(next_cup_m, next_object_m)
        return RewardTerms(
            distance=self.alpha * after,
            progress=self.beta * (after - before),
            displacement=self.sigma * math.dist(object_m, next_object_m),
            pressing=self.pressing * press_m,
        )
