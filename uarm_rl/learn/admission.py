"""May a transition enter the replay buffer? The second of the two questions that a buffer policy answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

from uarm_rl import checks


class Admission(Protocol):
    """A rule for what is stored.

    ``within`` tells that the control steps of a decision that may enter do so too (:mod:`uarm_rl.task.within`). They do not
    count as experiences: there is a gradient step for every decision, as without them.
    """

    within: ClassVar[bool]

    def admits(self, clipped: bool, travel_rad: float) -> bool:
        """Whether the transition may enter.

        ``clipped`` tells that the commanded reference lay beyond a joint limit and was cut back to it;
        ``travel_rad`` is the largest joint difference between the two states of the transition.
        """
        ...


@dataclass(frozen=True)
class AdmitAll:
    """Every transition enters: the common replay buffer."""

    within: ClassVar[bool] = False

    def admits(self, clipped: bool, travel_rad: float) -> bool:
        return True


@dataclass(frozen=True)
class NotStuck:
    """Reject transitions that stay stuck at a joint limit (section 3.3 of the paper).

    Stuck means: the command pushed against a limit and no joint moved by ``stuck_threshold_rad``, so that both
    states of the transition are the same state on the boundary.
    """

    stuck_threshold_rad: float
    within: ClassVar[bool] = False

    def __post_init__(self) -> None:
        checks.number("admission.stuck_threshold_rad", self.stuck_threshold_rad, low=0.0, open_low=True)

    def admits(self, clipped: bool, travel_rad: float) -> bool:
        return not (clipped and travel_rad < self.stuck_threshold_rad)


@dataclass(frozen=True)
class EveryStep(NotStuck):
    """Waste nothing: of every decision that is not stuck, the control steps within it enter too, each with its own target."""

    within: ClassVar[bool] = True
