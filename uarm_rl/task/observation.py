"""What the policy sees: the paper's 20 numbers (section 3.2; as ``docs/paper.md`` reads it), or more than these.

The paper's lack what the arm is still doing: its velocity, and the reference that it has not reached yet. Other kinds add
one of these, or what they can be told from; one adds the frame that turns with the arm. Behind any of them
stands what is in the way, where the task has obstacles.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks
from uarm_rl.task import kinematics
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.obstacles import Box

Observation = NDArray[np.float32]

#: Names of the numbers in their order; metres and radians in the base frame.
NAMES: Final = (
    *(f"{end}_{axis}_m" for end in ("link1", "link2", "link3", "cup") for axis in "xyz"),
    *(f"cup_to_object_{axis}_m" for axis in "xyz"),
    *(f"joint{number}_rad" for number in (1, 2, 3, 4)),
    "flag",
)
SIZE: Final = len(NAMES)

#: Fixed scaling to about unit range, ``(observation - OFFSET) / SCALE``: centre and half range of each number over
#: the workspace. The end of link1 keeps its height, hence the scale of 1 there. The vector to the object gets the
#: finer scale of 0.04 m: it is the number that has to be read to a millimetre.
OFFSET: Final[NDArray[np.float32]] = np.array(
    [0.007, 0, 0.107, 0.08, 0, 0.18, 0.18, 0, 0.15, 0.24, 0, 0.08, 0, 0, 0, 0, 0.3, 0.3, -0.6, 0], np.float32
)
SCALE: Final[NDArray[np.float32]] = np.array(
    [0.014, 0.014, 1, 0.1, 0.1, 0.08, 0.15, 0.2, 0.12, 0.15, 0.3, 0.12, 0.04, 0.04, 0.04, 1.2, 0.8, 0.8, 0.8, 1], np.float32
)

#: What is seen of an obstacle; the scale is half of what there is, as above.
OBSTACLE_NAMES: Final = ("x_m", "y_m", "length_m", "width_m", "top_m")
OBSTACLE_SCALE: Final = (0.3, 0.3, 0.06, 0.06, 0.16)
_OBSTACLE_IN_FRAME: Final = {"ahead_m": 0.3, "left_m": 0.3}

_NEAR_M: Final = 0.01

CUP: Final = slice(9, 12)
CUP_TO_OBJECT: Final = slice(12, 15)
JOINTS: Final = slice(15, 18)
FLAG: Final = 19


def observe(
    joints_rad: Sequence[float], link_ends_m: NDArray[np.float64], object_m: Sequence[float], flag: bool
) -> Observation:
    """The observation, shape (20,), float32.

    ``link_ends_m`` is ``kinematics.forward(joints_rad)``, ``object_m`` the centre of the object's upper surface,
    ``flag`` tells that the cup has stayed close enough for long enough.
    """
    joint1, joint2, joint3 = joints_rad
    cup_x, cup_y, cup_z = link_ends_m[3].tolist()
    observation = np.empty(SIZE, np.float32)
    observation[:12] = link_ends_m.ravel()
    observation[12:] = (
        object_m[0] - cup_x,
        object_m[1] - cup_y,
        object_m[2] - cup_z,
        joint1,
        joint2,
        joint3,
        kinematics.level(joint2, joint3),
        flag,
    )
    return observation


@dataclass(frozen=True)
class Look:
    """What there is to be seen at the end of a decision, or after a reset; metres and radians, base frame."""

    joints_rad: Sequence[float]
    link_ends_m: NDArray[np.float64]
    object_m: Sequence[float]
    flag: bool
    velocity_rad_s: Sequence[float]  # of joint1..joint3, over the last control step
    reference_rad: Sequence[float]  # what joint1..joint3 were last commanded
    last_action: Sequence[float]  # in [-1, 1]; zeros while there was none
    obstacles: Sequence[Box] = ()


class PaperObservation:
    """The paper's 20 numbers. Further kinds put theirs behind them; ``scale`` brings them to about unit range."""

    further: tuple[str, ...] = ()
    further_scale: float | tuple[float, ...] = 1.0
    slots = 0  # for how many obstacles there is room
    turns = False  # whether it has the frame that turns with the arm

    def __init__(self) -> None:
        self.names: tuple[str, ...] = (*NAMES, *self.further)
        self.offset = np.concatenate((OFFSET, np.zeros(len(self.further), np.float32)))
        self.scale = np.concatenate((SCALE, np.full(len(self.further), self.further_scale, np.float32)))

    @property
    def size(self) -> int:
        """How many numbers."""
        return len(self.names)

    def begin(self) -> None:
        """Forget what was seen before a reset."""

    def see(self, look: Look) -> Observation:
        """The observation, shape (size,), float32."""
        seen = observe(look.joints_rad, look.link_ends_m, look.object_m, look.flag)
        return np.concatenate((seen, np.array(self.rest(look), np.float32))) if self.further else seen

    def rest(self, look: Look) -> Sequence[float]:
        """The numbers behind the 20."""
        return ()

    def told(self, observed: Observation, object_m: Vector, obstacles: Observation | None = None) -> Observation:
        """What would have been observed with the object there (x, y, z, m), and the cup not yet on it.

        ``obstacles``: and with these in the way, where there is room for some; as they stand at the end of an observation.
        """
        told: Observation = observed.copy()
        told[CUP_TO_OBJECT] = object_m - observed[CUP]
        told[FLAG] = 0.0
        return told


class VelocityObservation(PaperObservation):
    """And the velocities of joint1..joint3 over the last control step."""

    further = tuple(f"joint{number}_rad_s" for number in (1, 2, 3))
    further_scale = 0.5  # about the fastest of a move of 0.15 rad with the servo of the published runs

    def rest(self, look: Look) -> Sequence[float]:
        return look.velocity_rad_s


class LastActionObservation(PaperObservation):
    """And the action before, as agents that act with a delay are given it (Ramstedt and Pal 2019, Real-Time RL)."""

    further = tuple(f"last_action{number}" for number in (1, 2, 3))

    def rest(self, look: Look) -> Sequence[float]:
        return look.last_action[:3]


class ReferenceObservation(PaperObservation):
    """And how far joint1..joint3 still have to go to the reference that is pending."""

    further = tuple(f"joint{number}_to_reference_rad" for number in (1, 2, 3))
    further_scale = 0.15  # one action of the published runs

    def rest(self, look: Look) -> Sequence[float]:
        return [wanted - joint for wanted, joint in zip(look.reference_rad, look.joints_rad, strict=True)]


class ArmFrameObservation(PaperObservation):
    """And the way to the object as the arm sees it, however it is turned: ahead, along its reach, and to its left; and near.

    In the base frame the same error asks for another action at each bearing of the arm. Obstacles are seen so too.
    ``d / (|d| + 1 cm)`` of each part of the way spreads the last centimetre over half of its range, so that millimetres show.
    """

    further = ("object_ahead_m", "object_left_m", "object_ahead_near", "object_left_near", "object_up_near")
    further_scale = (0.04, 0.04, 1.0, 1.0, 1.0)  # the first two as the vector itself
    turns = True

    def rest(self, look: Look) -> Sequence[float]:
        return self._way(look.joints_rad[0], *np.subtract(look.object_m, look.link_ends_m[3]).tolist())

    def told(self, observed: Observation, object_m: Vector, obstacles: Observation | None = None) -> Observation:
        told = super().told(observed, object_m)
        told[SIZE:] = self._way(float(told[JOINTS][0]), *told[CUP_TO_OBJECT].tolist())
        return told

    @staticmethod
    def _way(joint1_rad: float, x: float, y: float, z: float) -> Sequence[float]:
        ahead, left = turned(joint1_rad, x, y)
        return ahead, left, *(part / (abs(part) + _NEAR_M) for part in (ahead, left, z))


def turned(joint1_rad: float, x: Any, y: Any) -> tuple[Any, Any]:
    """A vector in the table's plane, or several, in the frame that turns with the arm: ahead, to the left."""
    cosine, sine = math.cos(joint1_rad), math.sin(joint1_rad)
    return cosine * x + sine * y, cosine * y - sine * x


class StackedObservation(PaperObservation):
    """The 20 numbers of the last ``frames`` decisions, the newest first; after a reset that of the reset, again and again."""

    def __init__(self, frames: int) -> None:
        super().__init__()
        self._frames: deque[Observation] = deque(maxlen=checks.integer("observation.frames", frames, low=1, high=100))
        self.names = tuple(f"{name}{f'_{age}_ago' if age else ''}" for age in range(frames) for name in NAMES)
        self.offset, self.scale = np.tile(OFFSET, frames), np.tile(SCALE, frames)

    def begin(self) -> None:
        self._frames.clear()

    def see(self, look: Look) -> Observation:
        self._frames.appendleft(super().see(look))
        while len(self._frames) < (self._frames.maxlen or 1):
            self._frames.append(self._frames[-1])
        return np.concatenate(self._frames)


class WithObstacles(PaperObservation):
    """Another observation, and behind it the obstacles: where each stands and its sides, zeros for those that are not there.

    Metres in the base frame; before them, if the other observation turns with the arm, where each stands in its frame.
    ``slots`` is for how many there is room; :class:`ValueError` where there are more.
    """

    def __init__(self, inner: PaperObservation, slots: int) -> None:
        self._inner, self.slots = inner, checks.integer("observation.obstacles", slots, low=1, high=100)
        in_frame = _OBSTACLE_IN_FRAME if inner.turns else {}
        each = in_frame, dict(zip(OBSTACLE_NAMES, OBSTACLE_SCALE, strict=True))
        scales = {f"obstacle{number}_{name}": of[name] for of in each for number in range(1, slots + 1) for name in of}
        self.names = (*inner.names, *scales)
        self.offset = np.concatenate((inner.offset, np.zeros(len(scales), np.float32)))
        self.scale = np.concatenate((inner.scale, np.array([*scales.values()], np.float32)))

    def begin(self) -> None:
        self._inner.begin()

    def see(self, look: Look) -> Observation:
        if len(look.obstacles) > self.slots:
            raise ValueError(f"there are {len(look.obstacles)} obstacles, and an observation has room for {self.slots}")
        seen = np.zeros((self.slots, len(OBSTACLE_NAMES)), np.float32)
        for row, box in zip(seen, look.obstacles, strict=False):
            row[:] = *box.centre_m[:2], *box.size_m[:2], box.centre_m[2] + box.size_m[2] / 2.0
        return self._with(self._inner.see(look), seen.ravel())

    def told(self, observed: Observation, object_m: Vector, obstacles: Observation | None = None) -> Observation:
        told = self._inner.told(observed[: self._inner.size], object_m)
        return np.concatenate((told, observed[len(told) :])) if obstacles is None else self._with(told, obstacles)

    def _with(self, seen: Observation, obstacles: Observation) -> Observation:
        if not self._inner.turns:
            return np.concatenate((seen, obstacles))
        x, y = obstacles.reshape(self.slots, -1)[:, :2].T
        in_frame = np.array(turned(float(seen[JOINTS][0]), x, y), np.float32)
        return np.concatenate((seen, in_frame.T.ravel(), obstacles))


def obstacles_in(observed: NDArray[Any], slots: int) -> tuple[Box, ...]:
    """The obstacles that stand in an observation with room for ``slots``; on the table, as all are."""
    rows = observed[len(observed) - slots * len(OBSTACLE_NAMES) :].reshape(slots, -1).astype(np.float64).tolist()
    return tuple(Box((x, y, top / 2.0), (length, width, top)) for x, y, length, width, top in rows if top > 0.0)


#: Each kind by its name in a configuration and on a policy's card.
KINDS: Final[Mapping[str, type[PaperObservation]]] = {
    "paper": PaperObservation,
    "velocity": VelocityObservation,
    "last_action": LastActionObservation,
    "reference": ReferenceObservation,
    "arm_frame": ArmFrameObservation,
    "stack": StackedObservation,
}


def kind(settings: Mapping[str, Any]) -> PaperObservation:
    """The kind that a configuration or a policy's card names; :class:`ValueError` with a sentence if there is none such.

    ``obstacles`` among the settings: with room for so many.
    """
    arguments = checks.mapping("observation", settings)
    slots = arguments.pop("obstacles", 0)
    name = checks.one_of("observation.name", arguments.pop("name", None), tuple(KINDS))
    try:
        seen = KINDS[name](**arguments)
        return WithObstacles(seen, slots) if slots else seen
    except TypeError:
        raise ValueError(f"observation={name} has no such keys: {', '.join(arguments) or 'frames is missing'}") from None
