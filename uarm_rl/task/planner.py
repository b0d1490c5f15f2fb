"""The ceiling of the task with obstacles: a library's motion planner, which knows what the policy has to learn.

RRT-Connect (Kuffner and LaValle 2000) of the Open Motion Planning Library, https://ompl.kavrakilab.org, in the three joint
angles, with the capsules of :mod:`uarm_rl.task.obstacles` as what must not touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from uarm_rl import checks
from uarm_rl.task import kinematics, observation
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.obstacles import Box, clearances_m
from uarm_rl.task.policy import Array
from uarm_rl.task.positions import APPROACH_HEIGHT_M

try:
    from ompl import base, geometric, util
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"{error.name} is not installed, which plans ways past obstacles; {checks.how_to_add('plan')}", name=error.name
    ) from None

_CLEARANCE_M: Final = 0.01
_CHECKED: Final = 0.01  # of the space's extent is between two poses of a way that are looked at
_PATIENCE_S: Final = 30.0
_SEED: Final = 1
_ARRIVED_RAD: Final = 0.02
_SAME_M: Final = 0.005  # so little an object moves that the way onto it stays the same

util.setLogLevel(util.LogLevel.LOG_NONE)  # a seed that is set again is told as an error


def plan(start_rad: Sequence[float] | Vector, goal_rad: Sequence[float] | Vector, obstacles: Sequence[Box]) -> list[Vector]:
    """Joint positions, shape (3,) each, that lead from ``start_rad`` to ``goal_rad`` past the obstacles; the same every time.

    Empty if none was found within half a minute.
    """
    util.RNG.setSeed(_SEED)
    space = base.RealVectorStateSpace(3)
    bounds = base.RealVectorBounds(3)
    for joint, (low, high) in enumerate(kinematics.JOINT_LIMITS_RAD.tolist()):
        bounds.setLow(joint, low)
        bounds.setHigh(joint, high)
    space.setBounds(bounds)

    def free(state: Any) -> bool:
        pose = np.array([state[0], state[1], state[2]])
        if not kinematics.within_limits(pose, tolerance_rad=1e-9):
            return False
        return not obstacles or bool(clearances_m(pose[np.newaxis], obstacles).min() >= _CLEARANCE_M)

    def state_of(joints: Sequence[float] | Vector) -> Any:
        state = space.allocState()
        for joint in range(3):
            state[joint] = float(joints[joint])
        return state

    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(free)
    setup.setStartAndGoalStates(state_of(start_rad), state_of(goal_rad))
    setup.getSpaceInformation().setStateValidityCheckingResolution(_CHECKED)
    setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
    setup.solve(_PATIENCE_S)
    if not setup.haveExactSolutionPath():
        return []
    setup.simplifySolution()
    return [np.array([state[0], state[1], state[2]]) for state in setup.getSolutionPath().getStates()]


@dataclass
class PlannerPolicy:
    """Goes along a planned way to above the object, and straight down onto it; where there is no way it stays.

    What it knows is the observation with its ``slots`` obstacles (:class:`uarm_rl.task.observation.WithObstacles`). It plans
    anew when target or obstacles have changed, and when the arm is back at home: another attempt.
    """

    max_delta_rad: float
    slots: int
    _legs: list[Vector] = field(default_factory=list)
    _target_m: Vector | None = None
    _obstacles: tuple[Box, ...] = ()
    _away: bool = False  # from home

    def act(self, observed: Array) -> Array:
        joints = observed[observation.JOINTS].astype(np.float64)
        target_m = observed[observation.CUP].astype(np.float64) + observed[observation.CUP_TO_OBJECT]
        obstacles = observation.obstacles_in(observed, self.slots)
        at_home = np.abs(joints - kinematics.HOME_JOINTS_RAD).max() < _ARRIVED_RAD
        moved = self._target_m is None or np.linalg.norm(target_m - self._target_m) > _SAME_M
        if moved or obstacles != self._obstacles or (at_home and self._away):
            self._target_m, self._obstacles = target_m, obstacles
            self._legs = self._way(joints, target_m, obstacles)
        self._away = not at_home
        while len(self._legs) > 1 and np.abs(self._legs[0] - joints).max() < _ARRIVED_RAD:
            self._legs.pop(0)
        turn = (self._legs[0] - joints) / self.max_delta_rad
        action: Array = (turn / max(1.0, np.abs(turn).max())).astype(np.float32)  # straight in angles
        return action

    @staticmethod
    def _way(joints: Vector, target_m: Vector, obstacles: Sequence[Box]) -> list[Vector]:
        try:
            above = kinematics.inverse(target_m + (0.0, 0.0, APPROACH_HEIGHT_M))
            on = kinematics.inverse(target_m)
        except kinematics.UnreachableError:
            return [joints]
        legs = plan(joints, above, obstacles)
        return [*legs[1:], on] if legs else [joints]
