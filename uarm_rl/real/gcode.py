"""The arm's G-code as pure functions: commands to bytes, lines of bytes to replies. Nothing here touches a port.

A request is ``#<number> <command>\\n``; the arm answers ``$<number> ok ...`` or ``$<number> E<code>``, in any order
and at any time, mixed with reports that start with ``@``. Firmware 4 (grbl) and 3.2 (Marlin) frame their replies
differently; ``decode`` reads both. There is no checksum: a line is believed when it has exactly the expected form.

Sources: the protocol sheet "uArm Swift Pro Protocol V4.2.0" and the observed output of the released firmware
binaries 4.10.0, 4.5.0 and 3.2.0.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from uarm_rl.task.kinematics import MOTOR_LIMITS_DEG

#: Speed of the motor angles (Euclidean norm of dB, dL, dR) per unit of F in deg/s, firmware 4. The protocol sheet
#: calls F mm/min; the firmware hands degrees to grbl's planner, and 80 of them count as one of grbl's millimetres.
FEED_DEG_S: Final = 4.0 / 3.0
#: Acceleration of the fastest motor in deg/s^2, firmware 4: its default of 10 planner units of 80 degrees.
ACCELERATION_DEG_S2: Final = 800.0

#: Single bytes that act at once, even inside a line. The byte ``@`` would lock the firmware up; it is never sent.
FEED_HOLD: Final = b"!"  # decelerate and wait
FLUSH: Final = b"\x18"  # stop at once, forget the queue, read the encoders (in full from firmware 4.10 on)

#: Highest request number. The firmware allows nine digits, but a line should stay under 50 bytes.
MAX_NUMBER: Final = 9999
_MAX_LINE_BYTES: Final = 49  # the packet buffers of firmware 4 hold 50 and are not checked


class Word(NamedTuple):
    """One parameter of a command: its letter, unit, allowed range and decimals on the wire."""

    letter: str
    unit: str
    low: float
    high: float
    decimals: int = 0


class Form(NamedTuple):
    """What a command does (completes "to ...") and its words; firmware 4 wants all of them, in this order."""

    purpose: str
    words: tuple[Word, ...] = ()


_B, _L, _R = (Word(letter, "deg", *limits, decimals=3) for letter, limits in MOTOR_LIMITS_DEG.items())

#: The white list: no other command can be encoded. Dangerous neighbours that are left out on purpose: M2401, M2410
#: and M2500 (destroy or redo the calibration), M2215 and M204 (rewrite the EEPROM), S1100 (locks up), G0 and G1
#: (an axis left out is not where the arm is).
COMMANDS: Final[Mapping[str, Form]] = {
    "G2206": Form("move the three motors", (_B, _L, _R, Word("F", "1.333 deg/s", 0.1, 250.0, decimals=1))),
    "M17": Form("switch the motors on and read the encoders"),
    "M2231": Form("switch the pump", (Word("V", "1 = on, 0 = off", 0, 1),)),
    "M2400": Form("set the tool mode", (Word("S", "0 = suction cup", 0, 0),)),
    "P2200": Form("read the motor angles"),
    "P2202": Form("read the hardware version"),
    "P2203": Form("read the firmware version"),
    "P2205": Form("read the serial number"),
    "P2231": Form("read the state of the pump"),
    "P2233": Form("read the tip switch"),
    "P2234": Form("read whether 12 V power is present"),
    "P2400": Form("read the tool mode"),
}


@dataclass(frozen=True)
class Command:
    """A command of the white list with the values of its words, e.g. ``Command("M2231", 1)``."""

    name: str
    values: tuple[float, ...]

    def __init__(self, name: str, *values: float) -> None:
        if name not in COMMANDS:
            raise ValueError(f"{name!r} is not among the commands that may be sent: {', '.join(COMMANDS)}")
        words = COMMANDS[name].words
        if len(values) != len(words):
            raise ValueError(f"{name} takes {len(words)} values ({' '.join(w.letter for w in words)}), got {values!r}")
        for word, value in zip(words, values, strict=True):
            if not (math.isfinite(value) and word.low <= value <= word.high):
                raise ValueError(f"{name} {word.letter} is {word.low:g} to {word.high:g} ({word.unit}), got {value!r}")
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "values", tuple(float(value) for value in values))

    @property
    def purpose(self) -> str:
        return COMMANDS[self.name].purpose

    def __str__(self) -> str:
        words = zip(COMMANDS[self.name].words, self.values, strict=True)
        # Adding zero turns -0.0 into 0.0.
        return " ".join([self.name, *(f"{w.letter}{round(v, w.decimals) + 0.0:.{w.decimals}f}" for w, v in words)])


MOTORS_ON: Final = Command("M17")
PUMP_ON: Final = Command("M2231", 1)
PUMP_OFF: Final = Command("M2231", 0)
SUCTION_MODE: Final = Command("M2400", 0)
READ_ANGLES: Final = Command("P2200")
READ_FIRMWARE: Final = Command("P2203")
READ_PUMP: Final = Command("P2231")
READ_POWER: Final = Command("P2234")
READ_MODE: Final = Command("P2400")


def encode(number: int, command: Command) -> bytes:
    """The line that asks for ``command`` under ``number`` (1 to 9999)."""
    if not 1 <= number <= MAX_NUMBER:
        raise ValueError(f"a request number is 1 to {MAX_NUMBER}, got {number!r}")
    line = f"#{number} {command}\n".encode("ascii")
    if len(line) > _MAX_LINE_BYTES:
        raise ValueError(f"a line has at most {_MAX_LINE_BYTES} bytes, got {line!r}")
    return line


@dataclass(frozen=True)
class Reply:
    """An answer. ``number`` is ``None`` when the arm did not say which request it answers."""

    number: int | None
    ok: bool
    code: str | None = None  # e.g. "E22"; None for success, and for a failure that the arm does not explain
    text: str = ""  # what follows the status
    words: Mapping[str, str] = field(default_factory=dict)  # letter -> the text that follows it

    def value(self, letter: str) -> float | None:
        """The number behind ``letter``, or ``None`` if there is none or it is not finite."""
        try:
            value = float(self.words[letter])
        except (KeyError, ValueError):
            return None
        return value if math.isfinite(value) else None


@dataclass(frozen=True)
class Report:
    """An unasked line, e.g. ``@5 V0``: 12 V lost."""

    kind: int
    words: Mapping[str, str] = field(default_factory=dict)


READY: Final = 1  # the firmware has started (4.x)
POWER: Final = 5  # V1: 12 V is present, V0: it is gone


@dataclass(frozen=True)
class Boot:
    """A line that the firmware prints while it starts; ``firmware`` is the version if the line tells it."""

    firmware: str | None = None


@dataclass(frozen=True)
class Alarm:
    """grbl has locked itself and will ignore motion until it is reset."""

    text: str


@dataclass(frozen=True)
class Noise:
    """A line that is none of the others."""

    text: str


Message = Reply | Report | Boot | Alarm | Noise

_MAX_QUOTE: Final = 60  # characters of a strange line that are kept
# Firmware 4.10 prints debug text without a line end before the reply to P2231 while the pump runs.
_DEBUG: Final = r"value: *-?\d+ +value2: *-?\d+"
_REPLY: Final = re.compile(rf"(?:{_DEBUG})?\$(\d{{1,9}})(?: +(.*))?")
_UNNUMBERED: Final = re.compile(r"(?:error: )?(ok|E\d{1,3})(?: +(.*))?")
_STATUS: Final = re.compile(r"(ok|E\d{1,3})(?: +(.*))?")
_REPORT: Final = re.compile(r"@(\d{1,3})(?: +(.*))?")
_WORD: Final = re.compile(r"([A-Z])(\S*)")
_FIRMWARE: Final = re.compile(r"soft ver ?: ?(V[\d.]+)")
_BOOT: Final = re.compile(r"(?:angle offset|device name|soft ver|api ver|work mode) ?:.*|start|echo: *Marlin.*")
_ALARM: Final = re.compile(r"ALARM:.*|\['\$H'\|'\$X' to unlock\]")
_VERSION: Final = re.compile(r"V?(\d{1,4})\.(\d{1,4})(?:\.(\d{1,4}))?")


def decode(line: bytes) -> Message:
    """What one line from the arm means; never fails."""
    text = line.decode("ascii", errors="replace").strip(" \t\r\n\0")
    if match := _REPLY.fullmatch(text):
        return _reply(int(match[1]), match[2] or "")
    if match := _REPORT.fullmatch(text):
        return Report(int(match[1]), _words(match[2] or ""))
    if _UNNUMBERED.fullmatch(text):
        return _reply(None, text.removeprefix("error: "))
    if _BOOT.fullmatch(text):
        version = _FIRMWARE.fullmatch(text)
        return Boot(version[1] if version else None)
    if _ALARM.fullmatch(text):
        return Alarm(text)
    return Noise(text[:_MAX_QUOTE])


def _reply(number: int | None, body: str) -> Reply:
    status = _STATUS.fullmatch(body)
    if status is None:  # "$7" alone: firmware 4 does this for grbl's parser errors
        return Reply(number, False, None, body)
    word, text = status[1], status[2] or ""
    if word == "ok" and (hidden := _STATUS.fullmatch(text)) and hidden[1] != "ok":
        word, text = hidden[1], hidden[2] or ""  # firmware 3.2: "$7 ok E22 unreachable"
    if word == "ok":
        return Reply(number, True, None, text, _words(text))
    return Reply(number, False, word, text)


def _words(text: str) -> dict[str, str]:
    return {match[1]: match[2] for match in map(_WORD.fullmatch, text.split()) if match}


def version(text: str) -> tuple[int, int, int] | None:
    """``(4, 10, 0)`` of ``"V4.10.0"``; ``None`` if that is no version."""
    match = _VERSION.fullmatch(text.strip())
    return (int(match[1]), int(match[2]), int(match[3] or 0)) if match else None


_EXPLANATIONS: Final = {
    None: "the arm gave no reason (its parser did not understand the line)",
    "E20": "E20: this firmware does not know the command",
    "E21": "E21: the command has a wrong or missing parameter",
    "E22": "E22: the target is outside the limits of the arm",
    "E23": "E23: the arm's buffer is full and it dropped a command",
    "E24": "E24: there is no 12 V power; plug in the power supply and press the arm's power button",
    "E25": "E25: the operation failed",
    "E26": "E26: an encoder does not answer (firmware 3.2: the path crosses the arm's own base)",
    "E27": "E27: a motor is switched off; reconnect, which switches the motors on",
}


def explain(code: str | None) -> str:
    """An error code as a clause."""
    return _EXPLANATIONS.get(code, f"{code}: an error code that the protocol does not list")
