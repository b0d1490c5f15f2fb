"""What the firmware's commands do to the machine: motors, pump, encoders, settings. Firmware V4.

A command comes in without its number and without blanks, e.g. ``G2206B90L80R40F50``; the answer is what follows
``$n `` on the wire. When an answer may leave is the business of ``firmware``.
"""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable
from typing import Final

from uarm_rl.emulator import geometry
from uarm_rl.emulator.motion import Joints, Motion, MotorAngles
from uarm_rl.emulator.realism import Settings

_Words = dict[str, float]


class RefusalError(Exception):
    """An answer other than ok: ``E22``, or an empty one for what grbl's parser does not understand."""


class Machine:
    """The state that a reset clears, and the commands. ``execute`` is the way in."""

    def __init__(self, settings: Settings, joints: Joints) -> None:
        self.settings = settings
        self.joints = joints
        self._noise = random.Random(settings.noise_seed)
        self.power_12v = settings.power_12v
        self.tool_mode = settings.tool_mode  # the tool mode survives a reset (EEPROM)
        self.reset()

    def reset(self) -> None:
        self.motion = Motion(self.encoders())
        self.started = False
        self.motors_on = [False] * 3  # B, L, R
        self.parser_mm = (0.0, 0.0, 0.0)  # the G-code parser's idea of where it is
        self.feed = 0.0
        self.relative = False
        self.servo_deg = 89.1
        self.report_period_s = 0.0
        self.reports_end = False
        self.busy_s = 0.0  # of a beep that was just asked for
        self._stop_pump()

    def start(self) -> None:
        """The boot loader is done: the motors hold where the arm has sagged to."""
        self.started = True
        self.motors_on = [self.settings.motors_on_at_boot] * 3
        self.resynchronise()

    def lose_power(self) -> None:
        """12 V is gone: motors limp, pump off; the controller lives on from USB."""
        self.power_12v = False
        self._stop_pump()

    def _stop_pump(self) -> None:
        self.pumping = False
        self.joints.suck(False)

    def encoders(self) -> MotorAngles:
        """The joint angles as the encoders see them."""
        pairs = zip(self.joints.motor_deg(), self.settings.encoder_offset_deg, strict=True)
        noise_deg = self.settings.encoder_noise_deg
        b, left, right = (angle + offset + self._noise.gauss(0.0, noise_deg) for angle, offset in pairs)
        return geometry.quantised((b, left, right))

    def drive(self, dt_s: float) -> None:
        """Let ``dt_s`` pass."""
        self.motion.advance(dt_s)
        offsets = self.settings.encoder_offset_deg
        b, left, right = (at - off for at, off in zip(self.motion.position, offsets, strict=True))
        self.joints.drive((b, left, right) if self.power_12v and all(self.motors_on) else None, dt_s)

    def resynchronise(self) -> None:
        """Take the encoders' word for where the motors are."""
        self.joints.resynchronise()
        self.motion.flush(self.encoders())

    def _cup_mm(self, motor_deg: MotorAngles) -> tuple[float, float, float]:
        return geometry.cup_mm(motor_deg, self.tool_mode)

    def _motors(self, x: float, y: float, z: float) -> MotorAngles:
        return geometry.motors_deg(x, y, z, self.tool_mode)

    def _check(self, motor_deg: MotorAngles) -> bool:
        """Whether a move is carried out; raises a refusal, or is false for one that is silently lost."""
        if not geometry.legal(motor_deg, self.settings.version):
            raise RefusalError("E22")
        if not all(self.motors_on):
            if self.settings.version >= (4, 10, 0):
                raise RefusalError("E27")
            return False
        return self.power_12v

    # Commands

    def execute(self, command: str) -> str:
        """Carry out ``command`` and return its answer; raises ``RefusalError``."""
        match = _COMMAND.match(command)
        if match is None:
            raise RefusalError("")
        name, rest = match[1] + match[2], command[match.end() :]
        if name in _GRBL:
            return _GRBL[name](self, _free_words(rest)) or "ok"
        if name not in _COMMANDS or self.settings.version < _SINCE.get(name, ()):
            if name[0] in "PS":
                return "ok"
            raise RefusalError("E20" if len(match[2]) >= 2 or name[0] == "M" else "")
        letters, handler = _COMMANDS[name]
        words = re.fullmatch("".join(rf"{letter}({_NUMBER})" for letter in letters), rest)
        if letters and words is None:
            raise RefusalError("sscanf 1\r\nE21")
        return handler(self, dict(zip(letters, map(float, words.groups() if words else ()), strict=True))) or "ok"

    def _joint_or_line(self, words: _Words, *, line: bool) -> None:
        self.feed = words.get("F", self.feed if not line else 0.0)
        if self.feed < 0.0 or (line and self.feed == 0.0):
            raise RefusalError("")
        base = self.parser_mm
        x, y, z = (
            (base[i] + words.get(axis, 0.0)) if self.relative else words.get(axis, base[i]) for i, axis in enumerate("XYZ")
        )
        self.parser_mm = (x, y, z)  # a refused target is remembered as well
        self._go(x, y, z, line=line)

    def _go(self, x: float, y: float, z: float, *, line: bool) -> None:
        target = self._motors(x, y, z)
        if not self._check(target):
            return
        if not line:
            self.motion.queue(target, self.feed)
            return
        start = self._cup_mm(self.motion.planned)
        self.motion.queue_line(
            lambda share: self._motors(*(a + share * (b - a) for a, b in zip(start, (x, y, z), strict=True))), self.feed
        )

    def _line_to(self, words: _Words) -> None:
        self._set_feed(words)
        self._go(*geometry.from_polar(words["S"], words["R"]), words["H"], line=True)

    def _line_by(self, words: _Words) -> None:
        x, y, z = self._cup_mm(self.motion.planned)
        self._set_feed(words)
        self._go(x + words["X"], y + words["Y"], z + words["Z"], line=True)

    def _polar_by(self, words: _Words) -> None:
        x, y, z = self._cup_mm(self.motion.planned)
        base_deg = 90.0 + math.degrees(math.atan2(y, x))
        self._set_feed(words)
        self._go(*geometry.from_polar(math.hypot(x, y) + words["S"], base_deg + words["R"]), z + words["H"], line=True)

    def _set_feed(self, words: _Words) -> None:
        self.feed = words["F"]
        if self.feed < 0.0:
            raise RefusalError("")

    def _one_motor(self, words: _Words) -> None:
        if words["N"] not in (0, 1, 2, 3):
            raise RefusalError("E21")
        if words["N"] == 3:
            if 0.0 <= words["V"] <= 180.0:
                self.servo_deg = words["V"]
            return
        b, left, right = (words["V"] if words["N"] == i else at for i, at in enumerate(self.motion.planned))
        if self._check((b, left, right)):
            self.motion.queue((b, left, right), words["F"])

    def _three_motors(self, words: _Words) -> None:
        target = words["B"], words["L"], words["R"]
        if self._check(target):
            self.motion.queue(target, words["F"])

    def _motor(self, words: _Words) -> int:
        if words["N"] not in (0, 1, 2, 3):
            raise RefusalError("E21")
        return min(int(words["N"]), 2)

    def _switch_all(self, on: bool) -> None:
        self.motors_on = [on] * 3
        if on:
            self.resynchronise()

    def _switch_one(self, words: _Words, on: bool) -> None:
        self.motors_on[self._motor(words)] = on
        if on:
            self.resynchronise()

    def _attached(self, words: _Words) -> str:
        # The firmware mixes the motors up here: N0 reports the left one, N1 the right one, N2 the base.
        return f"ok V{int(self.motors_on[(self._motor(words) + 1) % 3])}"

    def _pump(self, words: _Words) -> None:
        if words["V"] not in ((0, 1, 2) if self.settings.version >= (4, 10, 0) else (0, 1)):
            raise RefusalError("E21")
        self.pumping = words["V"] == 1 and self.power_12v
        self.joints.suck(self.pumping)

    def pump_state(self) -> int:
        return 0 if not (self.pumping and self.power_12v) else 2 if self.joints.holding() else 1

    def _set_tool(self, words: _Words) -> None:
        digit = int(str(int(words["S"]))[0])  # the firmware reads one digit: S10 is mode 1
        if digit not in geometry.TOOLS_MM:
            raise RefusalError("E21")
        self.tool_mode = digit

    def _angle(self, words: _Words) -> str:
        if words["N"] not in (0, 1, 2, 3):
            raise RefusalError("E21")
        return f"ok V{(*self.encoders(), self.servo_deg)[int(words['N'])]:.4f}"

    def _inverse(self, words: _Words) -> str:
        angles = self._motors(words["X"], words["Y"], words["Z"])
        if math.isnan(angles[1]):
            return "ok B  NAN L  NAN R  NAN"
        return "ok B{:.4f} L{:.4f} R{:.4f}".format(*angles)

    def _reachable(self, words: _Words) -> str:
        x, y = words["X"], words["Y"]
        if words["P"] == 1:
            x, y = geometry.from_polar(x, y)
        return f"ok V{int(geometry.legal(self._motors(x, y, words['Z']), self.settings.version))}"

    def cup_text(self) -> str:
        return "X{:.4f} Y{:.4f} Z{:.4f}".format(*(value + 0.0 for value in self._cup_mm(self.encoders())))

    def _polar_text(self) -> str:
        x, y, z = self._cup_mm(self.encoders())
        return f"S{math.hypot(x, y):.4f} R{90.0 + math.degrees(math.atan2(y, x)):.4f} H{z:.4f}"

    def _beep(self, words: _Words) -> None:
        self.busy_s = words["T"] / 1000.0

    def _hold(self, on: bool) -> None:
        self.motion.held = on

    def _dwell(self, words: _Words) -> None:
        self.busy_s = words["P"] / 1000.0

    def _acceleration(self, words: _Words) -> None:
        self.motion.acceleration_deg_s2 = 80.0 * words["A"]

    def _relative(self, on: bool) -> None:
        self.relative = on

    def _report(self, period_s: float) -> None:
        self.report_period_s = max(0.0, period_s)

    def _report_ends(self, words: _Words) -> None:
        self.reports_end = words["V"] == 1


_NUMBER: Final = r"[-+]?(?:\d+\.?\d*|\.\d+)"
_COMMAND: Final = re.compile(r"([GMPS])0*(\d{1,4})(?!\d)")
_Handler = Callable[[Machine, _Words], str | None]


def _free_words(text: str) -> _Words:
    """The words of G0 and G1, in any order."""
    if not re.fullmatch(rf"(?:[A-Z]{_NUMBER})*", text):
        raise RefusalError("")
    return {letter: float(value) for letter, value in re.findall(rf"([A-Z])({_NUMBER})", text)}


def _counts(motor_deg: MotorAngles) -> str:
    return "ok B{} L{} R{}".format(*geometry.counts(motor_deg))


_GRBL: Final[dict[str, _Handler]] = {
    "G0": lambda m, w: m._joint_or_line(w, line=False),
    "G1": lambda m, w: m._joint_or_line(w, line=True),
    "G90": lambda m, w: m._relative(False),
    "G91": lambda m, w: m._relative(True),
    "G92": lambda m, w: None,
}

#: Commands that older firmware does not know.
_SINCE: Final = {"M2124": (4, 10, 0), "P2235": (4, 10, 0), "P2236": (4, 10, 0), "P2244": (4, 7, 0)}

# Name -> letters of the words, all required and in this order, and what it does. Left out, and therefore answered as
# unknown: what would spoil the calibration or lock up a real arm (M2401, M2410, M2500, S1100), and the EEPROM.
_COMMANDS: Final[dict[str, tuple[str, _Handler]]] = {
    "G2004": ("P", Machine._dwell),
    "G2201": ("SRHF", Machine._line_to),
    "G2202": ("NVF", Machine._one_motor),
    "G2204": ("XYZF", Machine._line_by),
    "G2205": ("SRHF", Machine._polar_by),
    "G2206": ("BLRF", Machine._three_motors),
    "M17": ("", lambda m, w: m._switch_all(True)),
    "M18": ("", lambda m, w: m._switch_all(False)),
    "M204": ("A", Machine._acceleration),
    "M2019": ("", lambda m, w: m._switch_all(False)),
    "M2120": ("V", lambda m, w: m._report(w["V"])),
    "M2121": ("", lambda m, w: m._report(0.0)),
    "M2122": ("V", Machine._report_ends),
    "M2201": ("N", lambda m, w: m._switch_one(w, True)),
    "M2202": ("N", lambda m, w: m._switch_one(w, False)),
    "M2203": ("N", Machine._attached),
    "M2210": ("FT", Machine._beep),
    **{name: ("V", lambda m, w: None) for name in ("M2123", "M2124", "M2213", "M2232", "M2233", "M2234")},
    "M2220": ("XYZ", Machine._inverse),
    "M2221": ("BLR", lambda m, w: "ok X{:.4f} Y{:.4f} Z{:.4f}".format(*m._cup_mm((w["B"], w["L"], w["R"])))),
    "M2222": ("XYZP", Machine._reachable),
    "M2231": ("V", Machine._pump),
    **{name: ("NV", lambda m, w: None) for name in ("M2240", "M2241")},
    "M2400": ("S", Machine._set_tool),
    "P2200": ("", lambda m, w: "ok B{:.4f} L{:.4f} R{:.4f}".format(*m.encoders())),
    "P2201": ("", lambda m, w: "ok SwiftPro"),
    "P2202": ("", lambda m, w: "ok V3.3.1"),
    "P2203": ("", lambda m, w: f"ok {m.settings.firmware}"),
    "P2204": ("", lambda m, w: f"ok {m.settings.api}"),
    "P2205": ("", lambda m, w: "ok V508CB17684DE"),
    "P2206": ("N", Machine._angle),
    "P2220": ("", lambda m, w: "ok " + m.cup_text()),
    "P2221": ("", lambda m, w: "ok " + m._polar_text()),
    "P2231": ("", lambda m, w: f"ok V{m.pump_state()}"),
    "P2232": ("", lambda m, w: "ok V0"),
    "P2233": ("", lambda m, w: f"ok V{int(m.joints.tip_pressed())}"),
    "P2234": ("", lambda m, w: f"ok V{int(m.power_12v)}"),
    "P2235": ("", lambda m, w: "ok V0"),
    "P2236": ("N", lambda m, w: "ok V1"),  # a button of the base: released
    **{name: ("N", lambda m, w: "ok V0") for name in ("P2240", "P2241")},
    "P2242": ("", lambda m, w: _counts(geometry.POINT_B_DEG)),
    "P2243": ("", lambda m, w: _counts(m.encoders())),
    "P2244": ("", lambda m, w: "ok V0"),
    "P2400": ("", lambda m, w: f"ok V{m.tool_mode}"),
    "S1000": ("V", lambda m, w: m._hold(w["V"] == 0)),
}
