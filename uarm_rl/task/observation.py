"""The 20 numbers that the policy sees (section 3.2 of the paper; the reading of it is argued in the README)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from uarm_rl.task import kinematics

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

CUP: Final = slice(9, 12)
CUP_TO_OBJECT: Final = slice(12, 15)
JOINTS: Final = slice(15, 18)


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
