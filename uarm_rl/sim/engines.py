"""Which engines there are, and which of them ``sim=auto`` takes. None is imported before it is asked for."""

from __future__ import annotations

import sys
from functools import cache
from importlib.util import find_spec


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
