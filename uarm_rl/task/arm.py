"""What the environment asks of an arm and of a target. The simulated arm, the real arm and the tests' fake answer."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from uarm_rl.task.kinematics import Vector
    from uarm_rl.task.obstacles import Box

JointPositions = tuple[float, float, float]


class ArmError(Exception):
    """The arm or its world cannot do what was asked; the message is a sentence with the remedy."""


class PhysicsError(ArmError):
    """The simulated world no longer behaves like one: speeds or positions that no arm can have."""


class Arm(Protocol):
    """Joint positions are joint1..joint3 in radians (chain angles of ``kinematics``). A context manager that closes."""

    def home(self) -> None:
        """Bring the arm to its home pose, at rest."""
        ...

    def stand_at(self, joints_rad: Sequence[float]) -> None:
        """As ``home``, in another pose. Raises :class:`ArmError` where it takes a way to get there."""
        ...

    def read_joints(self) -> JointPositions:
        """Where the joints are."""
        ...

    def command_joints(self, reference_rad: Sequence[float]) -> None:
        """Give the servo a new reference, inside the joint limits."""
        ...

    def command_torques(self, shares: Sequence[float]) -> None:
        """Give the motors of joint1..joint3 torques, each as a share of what it has, from -1 to 1.

        Raises :class:`ArmError` where an arm takes none.
        """
        ...

    def advance(self) -> int:
        """Let time pass, a control step if the arm can; returns how many passed, at least 1.

        A simulated arm advances by one. A real one cannot be looked at in motion and returns when it stands still.
        Raises :class:`PhysicsError` when a simulated world explodes.
        """
        ...

    def contact_n(self) -> float:
        """With how much normal force (N) the cup pushes the object now; 0 where nobody can tell."""
        ...

    def place_obstacles(self, obstacles: Sequence[Box]) -> None:
        """Put these boxes in its way, and no others; a real arm is only told of those that stand there."""
        ...

    def touch_n(self) -> float:
        """With how much normal force (N) the arm, any part of it, pushes obstacles now; 0 where nobody can tell."""
        ...

    @property
    def at_rest(self) -> bool:
        """Whether the arm itself says that it stands still, as a real one does; of others it is seen in their joints."""
        ...

    def close(self) -> None:
        """Let go of the arm; closing twice is fine."""
        ...

    def __enter__(self) -> Arm: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...


class Target(Protocol):
    """The object that the cup has to reach."""

    def place_object(self, top_m: Sequence[float] | Vector) -> None:
        """Put the object so that the centre of its upper surface is at ``top_m``, at rest."""
        ...

    def object_position(self) -> tuple[float, float, float] | None:
        """Centre of the object's upper surface (m), or ``None`` if it is lost (fallen over, off the table)."""
        ...


class Ghost:
    """A target without a body: it stays where it was told to be."""

    def __init__(self) -> None:
        self._top_m = (0.0, 0.0, 0.0)

    def place_object(self, top_m: Sequence[float] | Vector) -> None:
        x, y, z = (float(value) for value in top_m)
        self._top_m = x, y, z

    def object_position(self) -> tuple[float, float, float] | None:
        return self._top_m
