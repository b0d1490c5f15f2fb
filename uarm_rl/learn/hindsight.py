"""What a decision says of objects that lay elsewhere: hindsight (Andrychowicz et al. 2017), for a task with a dense reward.

Where the object lies is three numbers of the observation, and an arm in free air moves as it does wherever that is. So a
decision that was carried out tells what it would have been worth for any other target: the same action, the same motion, the
vector from the cup to the object told anew, and the reward that equation (4) has for it. The arm is simulated once and learned
from many times, and where it is simulated slowly that is what counts.

It is right where the object was not touched. A decision in which the cup met the object, or moved it, stands for itself alone;
an obstacle that was touched is touched whatever the target, and costs the same. Where none was, the decision tells of other
obstacles too, those of another experience: if the whole arm would have gone clear of them nothing else changes, and if it would
have run into them beyond doubt it would have ended there.

At a target that is made up there is nothing solid, as with ``ghost_share``; what an object does to the arm only the true
decisions tell. Nor is it known for how long the cup would have been near enough, so no such decision ends in success: it is
worth what staying there is worth, which differs by the few millimetres within the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks
from uarm_rl.learn.returns import Transition
from uarm_rl.task import positions
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.observation import CUP, JOINTS, OBSTACLE_NAMES, PaperObservation, obstacles_in
from uarm_rl.task.obstacles import clearances_m, way_clearances_m
from uarm_rl.task.reward import DistanceReward

Array = NDArray[np.float32]

#: The share of the targets that lie about the place to which the cup came, and how far from it (m). Far ones teach to go there;
#: to stop there to the millimetre is learned from near ones, which chance seldom gives.
_NEAR: Final = 0.5
_NEAREST_M, _FARTHEST_M = 0.001, 0.15

_OTHERS: Final = 0.5  # the share of the made-up decisions that are told with other obstacles
_OVERSHOT: Final = 0.2  # of a way in angles: a servo swings beyond its end, and back beyond its beginning
_STEP_RAD: Final = 0.05
_LOOKS: Final = 5  # poses on that way
_DOUBT_M: Final = 0.003  # a servo's way is not quite straight

_SETTLING_M: Final = 1e-4  # an object that was put down settles by some hundredths of a millimetre


def met_object(info: Mapping[str, Any]) -> bool:
    """Whether the arm met the object in a decision, as far as the environment's ``info`` of it knows."""
    return bool(info["contact_n"] > 0.0 or info["object_moved_m"] > _SETTLING_M)


class Hindsight:
    """Makes ``targets`` further transitions of each decision; none if that is 0.

    ``generator`` draws the targets, within the operating range as the task's own: half of them uniformly, half about the cup,
    at a distance that is drawn log-uniformly. ``observation``: what is seen; ``touching``: the reward of touching an obstacle,
    which is coming nearer to one than ``margin_m``.
    """

    def __init__(
        self,
        *,
        targets: int,
        reward: DistanceReward,
        object_height_m: float,
        generator: np.random.Generator,
        observation: PaperObservation,
        touching: float = 0.0,
        margin_m: float = 0.0,
    ) -> None:
        self._observation, self._slots = observation, observation.slots
        self._touching, self._margin_m = touching, margin_m
        self._targets = checks.integer("hindsight_targets", targets, low=0, high=1000)
        self._reward = reward
        self._object_height_m = object_height_m
        self._generator = generator

    def of(self, decision: Transition, *, touched: bool = False, seen: Array | None = None) -> list[Transition]:
        """The same decision with other targets. Its ``discount`` is that of a decision which ends nothing.

        ``touched``: whether an obstacle was. ``seen``: observations, shape (n, size), in which other obstacles stand; without
        them it is told with its own.
        """
        cup, next_cup = decision.observation[CUP].tolist(), decision.next_observation[CUP].tolist()
        made = []
        for _ in range(self._targets):
            target = self._near(next_cup) if self._generator.random() < _NEAR else None
            if target is None:
                target = positions.draw(self._generator, self._object_height_m)
            place, others, ends = target.tolist(), None, touched
            if self._slots and seen is not None and len(seen) and not touched and self._generator.random() < _OTHERS:
                others, ends = self._others(decision, seen[self._generator.integers(len(seen))])
            made.append(
                decision._replace(
                    observation=self._observation.told(decision.observation, target, others),
                    reward=self._touching if ends else self._reward(cup, place, next_cup, place).total,
                    next_observation=self._observation.told(decision.next_observation, target, others),
                    discount=0.0 if ends else decision.discount,
                )
            )
        return made

    def _others(self, decision: Transition, seen: Array) -> tuple[Array | None, bool]:
        """The obstacles of another observation, as they stand in it, and whether the arm would have touched them.

        None where that is not known.
        """
        start, end = (one[JOINTS].astype(np.float64) for one in (decision.observation, decision.next_observation))
        beyond = _OVERSHOT * (end - start)
        obstacles, told = obstacles_in(seen, self._slots), seen[-self._slots * len(OBSTACLE_NAMES) :]
        if way_clearances_m((start - beyond).tolist(), (end + beyond).tolist(), obstacles, _STEP_RAD).min() > self._margin_m:
            return told, False
        first, *others = clearances_m(np.linspace(start, end, _LOOKS), obstacles).tolist()
        touches = first > self._margin_m and min(others) < self._margin_m - _DOUBT_M
        return (told, True) if touches else (None, False)

    def _near(self, cup_m: list[float]) -> Vector | None:
        """A target about the cup; none if the one that was drawn is out of range."""
        distance_m = math.exp(self._generator.uniform(math.log(_NEAREST_M), math.log(_FARTHEST_M)))
        angle = self._generator.uniform(-math.pi, math.pi)
        x, y = cup_m[0] + distance_m * math.cos(angle), cup_m[1] + distance_m * math.sin(angle)
        target = np.array([x, y, self._object_height_m])
        return target if positions.in_operating_range(target) else None
