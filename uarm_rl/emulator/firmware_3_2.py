"""Firmware 3.2.0, based on Marlin: as much of its dialect as a program needs to recognise it and to be misled by it.

Unlike firmware 4 it prints two decimals and CR LF, says ok to moves as soon as they are queued, says ok to targets out
of reach, has no command for three motors, and answers what it does not know with a line that carries no number.
"""

from __future__ import annotations

import re
from typing import Final

from uarm_rl.emulator.firmware import Firmware

_GREETING: Final = (
    "start\necho:Marlin 1.1.0-RC7\necho: Free Memory: 2983  PlannerBufferBytes: 1168\necho:  M92 X320.00 Y320.00\n"
)
_SILENCE_S: Final = 2.5  # after the greeting
_KNOWN: Final = re.compile(r"[GMP](0|1|17|18|90|91|2019|2120|22\d\d|2400)")
_UNKNOWN: Final = ("G2206", "M2200", "P2243", "P2244")  # of those that the pattern lets through


class MarlinFirmware(Firmware):
    """Use it with ``Settings(firmware="V3.2.0")``."""

    def _greet(self) -> None:
        boot_s = self.settings.boot_s
        self._emit(_GREETING, boot_s)
        self._loop_free_s = self._booted_s + _SILENCE_S
        if self.machine.power_12v:
            self._emit("@5 V1\r\n", boot_s + _SILENCE_S)

    def _command(self, number: str, command: str, name: str) -> None:
        if name == "M2200":
            self._answer(number, f"ok V{int(self.machine.motion.moving)}")
        elif _KNOWN.fullmatch(name) and name not in _UNKNOWN:
            super()._command(number, command, name)
        else:
            self._emit(f'echo:Unknown command: "{command}"\n')

    def _defers(self, name: str) -> bool:
        return False

    def _answer(self, number: str, answer: str, delay_s: float = 0.0) -> None:
        answer = re.sub(r"-?\d+\.\d{4}\b", lambda match: f"{float(match[0]):.2f}", answer)
        answer = answer.removeprefix("sscanf 1\r\n")
        if answer == "E22":
            answer = "ok E22 unreachable\r\n"
        prefix = f"${number} " if number.strip("0") else ""
        self._emit(f"{prefix}{answer}\r\n" if answer != "ok" else f"{prefix}ok\n", delay_s)
