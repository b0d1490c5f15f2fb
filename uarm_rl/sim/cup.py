"""Cups: a rigid one, which needs no model, and bellows that give."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Final

from uarm_rl import checks

_RETURN_S: Final = 0.02  # silicone comes back within a few hundredths of a second
_FASTEST_M_S: Final = 0.5
_BY_ITSELF_N: Final = 0.3  # its own weight ten times: uncompressed it is where it belongs and pushes nothing
_STRETCHED_N_M: Final = 2e4  # stretched out it is stiff: what it can hold stretches it by half a millimetre
_STOP: Final = 10.0  # folds that lie on each other are so much stiffer


@dataclass(frozen=True)
class Bellows:
    """A lip on a spring. Pressed together by ``x`` metres it pushes with ``stiffness_n_m`` x newton, and with far
    more beyond ``travel_m``.

    Both engines have it as a sliding joint whose motor wants to bring the lip back and has just that force: a row of the
    contact solver, which a stiff spring of so little mass would not survive at 120 steps a second.
    """

    stiffness_n_m: float
    travel_m: float
    mass_kg: float

    def __post_init__(self) -> None:
        checks.number("cup.stiffness_n_m", self.stiffness_n_m, low=0.0, high=1e5, open_low=True)
        checks.number("cup.travel_m", self.travel_m, low=0.0, high=0.02, open_low=True)
        checks.number("cup.mass_kg", self.mass_kg, low=1e-4, high=0.1)

    def push(self, compression_m: float) -> tuple[float, float]:
        """Velocity (m/s, negative: outwards) that the lip is driven with, and the force (N) that it has for that."""
        velocity = min(max(-compression_m / _RETURN_S, -_FASTEST_M_S), _FASTEST_M_S)
        if compression_m <= 0.0:  # stretched out
            return velocity, _BY_ITSELF_N - _STRETCHED_N_M * compression_m
        beyond_m = max(0.0, compression_m - self.travel_m)
        return velocity, self.stiffness_n_m * (compression_m + _STOP * beyond_m)

    def joined(self, urdf: str) -> str:
        """The arm's URDF with this cup on a sliding joint, up is pressed together, where the rigid one is fixed."""
        robot = ET.fromstring(urdf)
        joint, mass = robot.find("joint[@name='cup_joint']"), robot.find("link[@name='cup']/inertial/mass")
        assert joint is not None
        assert mass is not None
        mass.set("value", repr(self.mass_kg))
        joint.set("type", "prismatic")
        ET.SubElement(joint, "axis", xyz="0 0 1")
        ET.SubElement(joint, "limit", lower="1", upper="-1", effort="100", velocity="10")  # none
        return ET.tostring(robot, encoding="unicode")


def rigid() -> None:
    """No bellows: the cup is one with the hand."""
