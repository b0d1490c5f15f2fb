"""Which engines there are, and which of them ``sim=auto`` takes. None is imported before it is asked for."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uarm_rl.sim.simulated_arm import SimulatedArm


def pybullet() -> type[SimulatedArm]:
    """Raises :class:`ModuleNotFoundError` with a sentence where PyBullet is not installed."""
    from uarm_rl.sim.pybullet_arm import SimArm

    return SimArm


def mujoco() -> type[SimulatedArm]:
    """Raises :class:`ModuleNotFoundError` with a sentence where MuJoCo is not installed."""
    from uarm_rl.sim.mujoco_arm import MujocoArm

    return MujocoArm


def loaders() -> dict[str, Callable[[], type[SimulatedArm]]]:
    """Functions that import their engine, by its name."""
    return {"pybullet": pybullet, "mujoco": mujoco}


def installed() -> str:
    """PyBullet where it is installed, because the published runs are its; else MuJoCo."""
    return "pybullet" if find_spec("pybullet") else "mujoco"


@cache
def tell() -> None:
    """Say, once a process, that the engine is not that of the published runs."""
    print(
        "note: PyBullet is not installed, so sim=auto takes MuJoCo; the published runs are PyBullet's, and RESULTS.md "
        "(Two engines) says how far the two agree",
        file=sys.stderr,
    )
