"""Faults of the arm, its cable and its power as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

#: What a fault does, from the moment it strikes.
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


@dataclass(frozen=True)
class Fault:
    """``effect`` strikes at the ``nth`` arrival of ``command`` (e.g. ``G2206``; ``any`` counts all of them)."""

    effect: str
    command: str = "any"
    nth: int = 1
    delay_s: float = 0.0
    data: bytes = b""

    def __post_init__(self) -> None:
        if self.effect not in EFFECTS:
            raise ValueError(f"a fault's effect is one of {', '.join(EFFECTS)}, got {self.effect!r}")
        if self.nth < 1 or not 0.0 <= self.delay_s < 3600.0:
            raise ValueError(f"a fault needs nth >= 1 and 0 <= delay_s < 3600, got {self.nth!r} and {self.delay_s!r}")


class Faults:
    """Which faults strike now, given the commands that arrive."""

    def __init__(self, faults: tuple[Fault, ...]) -> None:
        self._faults = faults
        self._counts: dict[str, int] = {}

    def strike(self, command: str) -> dict[str, Fault]:
        """Count ``command`` and return the faults that strike at it, by effect."""
        for name in (command, "any"):
            self._counts[name] = self._counts.get(name, 0) + 1
        due = [f for f in self._faults if f.command in (command, "any") and self._counts[f.command] == f.nth]
        return {fault.effect: fault for fault in due}
