"""Faults of arm, camera, cables and power as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

#: What a fault of the arm does, from the moment it strikes.
EFFECTS: Final = {
    "silence": "nothing is sent any more",
    "late": "the reply comes delay_s later",
    "lost": "the reply never comes",
    "duplicate": "the reply comes twice",
    "garbage": "data comes before the reply",
    "error": "the reply is data, e.g. E22, and the command is not carried out; empty data: a reply without a status",
    "slow": "bytes come delay_s apart from here on",
    "reset": "the controller restarts delay_s later",
    "power": "12 V disappears delay_s later",
    "unplug": "the cable is pulled delay_s later",
}
#: The same for the camera. Its pictures have no checksum: only a length in front, and JPEG inside.
CAMERA_EFFECTS: Final = {
    "silence": "nothing is sent any more",
    "late": "the picture comes delay_s later",
    "lost": "the picture never comes",
    "slow": "packets of 64 bytes come delay_s apart from here on",
    "truncated": "the second half of the picture never comes",
    "dropped": "one byte in the middle of the picture is missing",
    "corrupt": "some bytes in the middle of the picture are wrong",
    "length": "the four bytes of the length are data",
    "text": "data comes before the length (with lost: alone)",
    "trailing": "data comes after the picture",
    "frozen": "the picture before comes again, and again from here on",
    "size": "the picture is half as wide and high",
    "unplug": "the cable is pulled delay_s later",
}


@dataclass(frozen=True)
class Fault:
    """``effect`` strikes at the ``nth`` arrival of ``command`` (e.g. ``G2206``; ``any`` counts all), ``times`` in a row."""

    effect: str
    command: str = "any"
    nth: int = 1
    times: int = 1
    delay_s: float = 0.0
    data: bytes = b""
    effects: ClassVar[Mapping[str, str]] = EFFECTS

    def __post_init__(self) -> None:
        if self.effect not in self.effects:
            raise ValueError(f"a fault's effect is one of {', '.join(self.effects)}, got {self.effect!r}")
        if self.nth < 1 or self.times < 1 or not 0.0 <= self.delay_s < 3600.0:
            raise ValueError(
                f"a fault needs nth and times of at least 1 and 0 <= delay_s < 3600, got {self.nth!r}, {self.times!r} "
                f"and {self.delay_s!r}"
            )


@dataclass(frozen=True)
class CameraFault(Fault):
    """The same for the camera, whose only command is ``snap``."""

    effects: ClassVar[Mapping[str, str]] = CAMERA_EFFECTS


class Faults:
    """Which faults strike now, given the commands that arrive."""

    def __init__(self, faults: tuple[Fault, ...]) -> None:
        self._faults = faults
        self._counts: dict[str, int] = {}

    def strike(self, command: str) -> dict[str, Fault]:
        """Count ``command`` and return the faults that strike at it, by effect."""
        for name in (command, "any"):
            self._counts[name] = self._counts.get(name, 0) + 1
        due = [f for f in self._faults if f.command in (command, "any") and 0 <= self._counts[f.command] - f.nth < f.times]
        return {fault.effect: fault for fault in due}
