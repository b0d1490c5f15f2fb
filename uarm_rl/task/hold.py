"""How long does a command act? The first of the two questions that a buffer policy answers.

A decision commands the joints once; the arm then runs for a number of control steps until the hold releases it,
and only then the next state is observed. The paper's uniform update releases after every control step, its
adaptive update when the arm has reached a steady state (section 3.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Protocol

from uarm_rl import checks
from uarm_rl.task.arm import JointPositions

#: What the published runs of method C took to come to rest, in the mean.
_USUAL: Final = 13


class Hold(Protocol):
    """A rule for how long a command acts."""

    @property
    def choices(self) -> int:
        """How many numbers of the action, behind the joints', say how long it acts."""
        ...

    def chosen(self, numbers: Sequence[float]) -> Hold:
        """The rule for a decision whose action has these numbers, each in [-1, 1], behind the joints'."""
        ...

    @property
    def usual_control_steps(self) -> int:
        """About how long a decision takes, for films."""
        ...

    def releases(self, control_steps: int, travel_rad: float, change_rad: float) -> bool:
        """Whether the decision ends now.

        ``control_steps`` counts those since the command (1 after the first); ``travel_rad`` is the largest joint
        movement between the last and the current control step, ``change_rad`` the most by which a joint moved otherwise
        than in the control step before that.
        """
        ...


@dataclass(frozen=True)
class FixedHold:
    """Release after a fixed number of control steps; 1 is the paper's uniform update."""

    control_steps: int
    choices: ClassVar[int] = 0

    def __post_init__(self) -> None:
        checks.integer("hold.control_steps", self.control_steps, low=1)

    @property
    def usual_control_steps(self) -> int:
        return self.control_steps

    def chosen(self, numbers: Sequence[float]) -> Hold:
        return self

    def releases(self, control_steps: int, travel_rad: float, change_rad: float) -> bool:
        return control_steps >= self.control_steps

    def __str__(self) -> str:
        return f"fixed({self.control_steps})"


@dataclass(frozen=True)
class UntilSteady:
    """Release when every joint moved less than a threshold in the last control step: the paper's steady state.

    ``min_control_steps`` covers the dead time of the servo (an arm that has not started yet looks steady),
    ``max_control_steps`` ends the wait for an arm that never comes to rest.
    """

    steady_threshold_rad: float
    min_control_steps: int
    max_control_steps: int
    choices: ClassVar[int] = 0

    def __post_init__(self) -> None:
        checks.number("hold.steady_threshold_rad", self.steady_threshold_rad, low=0.0, open_low=True)
        checks.integer("hold.min_control_steps", self.min_control_steps, low=1)
        checks.integer("hold.max_control_steps", self.max_control_steps, low=self.min_control_steps)

    @property
    def usual_control_steps(self) -> int:
        return min(max(_USUAL, self.min_control_steps), self.max_control_steps)

    def chosen(self, numbers: Sequence[float]) -> Hold:
        return self

    def releases(self, control_steps: int, travel_rad: float, change_rad: float) -> bool:
        if control_steps < self.min_control_steps:
            return False
        return travel_rad < self.steady_threshold_rad or control_steps >= self.max_control_steps

    def __str__(self) -> str:
        return f"until_steady({self.min_control_steps}..{self.max_control_steps}, {self.steady_threshold_rad:g} rad)"


class SteadySpeed(UntilSteady):
    """Release when no joint's speed changed any more: what is steady of an arm that is told torques.

    The paper waits for "a state expected by the command", which for angles is to stand at them. What a torque comes to is a
    speed, and an arm that stands is at a limit, or held by chance.
    """

    def releases(self, control_steps: int, travel_rad: float, change_rad: float) -> bool:
        return super().releases(control_steps, change_rad, change_rad)

    def __str__(self) -> str:
        return super().__str__().replace("until_steady", "steady_speed")


@dataclass(frozen=True)
class LearnedHold:
    """The agent says how long: one number of the action, from -1 for 1 control step to 1 for ``max_control_steps``.

    What the literature has in the place of the paper's rule: a repeat count beside the action (Sharma et al. 2017, FiGAR), a
    skip that is learned for an action that is chosen (Biedenkapp et al. 2021, TempoRL), a continuous duration, as here (Karimi
    et al. 2023, CTCO; Wang and Beltrame 2024, MOSEAC), repeating while the state stays in a region (Park et al. 2021, SAR).
    """

    max_control_steps: int
    choices: ClassVar[int] = 1

    def __post_init__(self) -> None:
        checks.integer("hold.max_control_steps", self.max_control_steps, low=2)

    @property
    def usual_control_steps(self) -> int:
        return (1 + self.max_control_steps) // 2

    def chosen(self, numbers: Sequence[float]) -> FixedHold:
        (number,) = numbers
        return FixedHold(1 + round((self.max_control_steps - 1) * (number + 1.0) / 2.0))

    def releases(self, control_steps: int, travel_rad: float, change_rad: float) -> bool:
        """The longest that may be chosen; a decision's own rule is ``chosen``."""
        return control_steps >= self.max_control_steps

    def __str__(self) -> str:
        return f"learned(1..{self.max_control_steps})"


def travel_rad_of(start: JointPositions, end: JointPositions) -> float:
    """How far a joint moved between two looks, at the most."""
    return max(abs(end[0] - start[0]), abs(end[1] - start[1]), abs(end[2] - start[2]))


def change_rad_of(earlier: JointPositions, last: JointPositions, now: JointPositions) -> float:
    """How much more or less a joint moved than between the two looks before, at the most."""
    return max(abs(c - 2.0 * b + a) for a, b, c in zip(earlier, last, now, strict=True))
