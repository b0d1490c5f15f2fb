"""A port with nobody behind it: it shows every line and answers like an arm that does just what it is told."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from uarm_rl.real import gcode
from uarm_rl.real.ports import READ_S
from uarm_rl.real.swift_arm import PARK_JOINTS_RAD
from uarm_rl.task import kinematics

_MOVE: Final = re.compile(r"G2206 B(\S+) L(\S+) R(\S+) F(\S+)")


class DryPort:
    """A ``ports.Port`` and its clock: ``Link(port, "dry run", clock=port.clock)``. ``say`` gets a line for each command.

    The arm starts parked, arrives when the firmware's speed law says so, and its cup seals whenever the pump runs.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self.commands = 0
        self._say = say
        self._motors_deg = kinematics.to_motor_deg(PARK_JOINTS_RAD)
        self._pump = 0
        self._now_s = 0.0
        self._out = b"@1\n@5 V1\n"

    def clock(self) -> float:
        """Seconds of the arm's time: they pass while somebody reads."""
        return self._now_s

    @property
    def in_waiting(self) -> int:
        return len(self._out)

    def read(self, size: int = 1) -> bytes:
        if not self._out:
            self._now_s += READ_S
        data, self._out = self._out[:size], self._out[size:]
        return data

    def write(self, data: bytes) -> int:
        for line in data.decode("ascii").splitlines():
            number, _, command = line.partition(" ")
            if command:
                self.commands += 1
                self._out += f"{number.replace('#', '$')} {self._obey(command)}\n".encode("ascii")
        return len(data)

    def close(self) -> None:
        """Nothing to give back."""

    def _obey(self, command: str) -> str:
        remark = gcode.COMMANDS[command.split(" ")[0]].purpose
        answer = ""
        if move := _MOVE.fullmatch(command):
            base, left, right, feed = (float(value) for value in move.groups())
            speed = gcode.FEED_DEG_S * feed
            distance = math.dist(self._motors_deg, (base, left, right))
            self._now_s += distance / speed + speed / gcode.ACCELERATION_DEG_S2
            self._motors_deg = base, left, right
            x, y, z = 1000.0 * kinematics.cup_position(kinematics.from_motor_deg(base, left, right))
            remark = f"cup to ({x:.1f}, {y:.1f}, {z:.1f}) mm"
        elif command.startswith("M2231"):
            self._pump = int(command[-1])
            remark = "pump on" if self._pump else "pump off"
        elif command == str(gcode.READ_ANGLES):
            answer = " B{:.4f} L{:.4f} R{:.4f}".format(*self._motors_deg)
        elif command == str(gcode.READ_FIRMWARE):
            answer = " V4.10.0"
        elif command == str(gcode.READ_PUMP):
            answer = f" V{2 * self._pump}"
        elif command == str(gcode.READ_POWER):
            answer = " V1"
        elif command == str(gcode.READ_MODE):
            answer = " V0"
        with suppress(BrokenPipeError):  # of the terminal, which is no fault of this port
            self._say(f"would send: {command:44} {remark}")
        return f"ok{answer}"
