"""A serial link that asks and gets answers, or raises within a deadline.

Every request carries a number, and only the reply with that number answers it: late, repeated and foreign replies
are dropped. Unasked messages go to a callback. No call outlives its deadline by more than one read (20 ms) or one
blocked write (0.2 s), whatever arrives, and no buffer grows with what arrives.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from uarm_rl.real import gcode, ports
from uarm_rl.real.ports import BROKEN, Port
from uarm_rl.task.arm import ArmError

log = logging.getLogger(__name__)

_WRITE_S: Final = 0.2
_MAX_CHUNK_BYTES: Final = 4096
_MAX_LINE_BYTES: Final = 256  # the arm's longest line has about 60
_MAX_PENDING: Final = 32  # more requests than the arm can hold unanswered


class LinkLostError(ArmError):
    """The port stopped working: cable, power or USB."""


class NoReplyError(ArmError):
    """A deadline passed."""


class BadReplyError(ArmError):
    """A reply without the values that it must have."""


class CommandRefusedError(ArmError):
    """The arm refused a command; ``code`` is its error code, or ``None`` if it gave none."""

    def __init__(self, message: str, code: str | None) -> None:
        super().__init__(message)
        self.code = code


class AlarmError(ArmError):
    """The firmware has locked itself."""


Event = gcode.Report | gcode.Boot


class Link:
    """Numbered requests over an open port, ``name`` in messages. The clock is a parameter for tests in virtual time.

    ``on_event`` receives reports and boot lines while a call waits; what it raises ends that call.
    """

    def __init__(self, port: Port, name: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.name = name
        self.on_event: Callable[[Event], None] = lambda event: None
        self.started = False  # the firmware has said that it is ready
        self._port = port
        self._clock = clock
        self._number = 0
        self._requests: dict[int, gcode.Command] = {}  # sent, and not yet answered to the caller
        self._replies: dict[int, gcode.Reply] = {}  # the first reply to each of them
        self._lines: deque[bytes] = deque()  # complete lines, at most those of one chunk
        self._tail = b""  # the beginning of a line
        self._skipping = False  # inside a line that is too long
        self._last_noise = ""
        self._closed = False

    def now_s(self) -> float:
        """Seconds on the clock that all deadlines are measured with."""
        return self._clock()

    def request(self, command: gcode.Command, timeout_s: float = 1.0) -> gcode.Reply:
        """Send and wait for the answer."""
        return self.wait(self.send(command), timeout_s)

    def read_value(self, command: gcode.Command, letter: str, timeout_s: float = 1.0) -> float:
        """Ask for one number."""
        return self.read_values(command, letter, timeout_s)[0]

    def read_values(self, command: gcode.Command, letters: str, timeout_s: float = 1.0) -> list[float]:
        """Ask for the numbers behind ``letters``."""
        reply = self.request(command, timeout_s)
        values = [value for letter in letters if (value := reply.value(letter)) is not None]
        if len(values) != len(letters):
            raise BadReplyError(
                f"the arm was asked to {command.purpose} ({command}) and answered {reply.text!r}, where a number after "
                f"each of {', '.join(letters)} was expected; check the cable, then reconnect"
            )
        return values

    def send(self, command: gcode.Command) -> int:
        """Write a request and return its number; the answer is asked for with ``wait``."""
        self._number = self._number % gcode.MAX_NUMBER + 1
        number = self._number
        while len(self._requests) >= _MAX_PENDING:
            self._forget(next(iter(self._requests)))  # the oldest: nobody waits for it
        self._requests[number] = command
        self.write(gcode.encode(number, command))
        return number

    def wait(self, number: int, timeout_s: float) -> gcode.Reply:
        """The answer to request ``number``; a refusal raises ``CommandRefusedError``, silence ``NoReplyError``."""
        command = self._requests[number]
        try:
            if not self.listen(timeout_s, until=lambda: number in self._replies):
                noise = f"; instead it sent {self._last_noise!r}" if self._last_noise else ""
                raise NoReplyError(
                    f"the arm was asked to {command.purpose} ({command}) and did not answer "
                    f"within {timeout_s:.1f} s on {self.name}{noise}; {_advice(self.name)}"
                )
            reply = self._replies[number]
        finally:
            self._forget(number)
        if not reply.ok:
            raise CommandRefusedError(
                f"the arm was asked to {command.purpose} ({command}) and refused: {gcode.explain(reply.code)}",
                reply.code,
            )
        return reply

    def listen(self, timeout_s: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Read and dispatch for ``timeout_s``, or until ``until()`` is true; returns ``until()``."""
        deadline_s = self._clock() + timeout_s
        while not until():
            if self._lines:
                self._dispatch(gcode.decode(self._lines.popleft()))
            elif self._clock() >= deadline_s:
                return False
            else:
                self._lines.extend(self._split(self._read()))
        return True

    def write(self, data: bytes) -> None:
        """Write bytes as they are: a request, or one of the firmware's immediate bytes."""
        if self._closed:
            raise LinkLostError(f"the connection to {self.name} is closed; open it again")
        log.debug("%s < %r", self.name, data)
        try:
            self._port.write(data)
        except BROKEN as error:
            raise self._lost("accepts no more bytes", error) from error

    def close(self) -> None:
        """Give the port back; closing twice is fine."""
        if not self._closed:
            self._closed = True
            try:
                self._port.close()
            except BROKEN as error:
                log.debug("closing %s: %s", self.name, error)

    def _forget(self, number: int) -> None:
        self._requests.pop(number, None)
        self._replies.pop(number, None)

    def _read(self) -> bytes:
        try:
            data = self._port.read(1)  # waits up to READ_S
            if data and (waiting := self._port.in_waiting):
                data += self._port.read(min(waiting, _MAX_CHUNK_BYTES))
        except BROKEN as error:
            raise self._lost("stopped answering", error) from error
        return data

    def _lost(self, what: str, error: Exception) -> LinkLostError:
        return LinkLostError(
            f"{self.name} {what} ({error}); check the USB cable and the power supply, then start again: the arm keeps "
            "its pose and its pump until then"
        )

    def _split(self, data: bytes) -> list[bytes]:
        """Complete lines; those longer than any line of the arm are dropped without being stored."""
        *lines, tail = (self._tail + data).replace(b"\r", b"\n").split(b"\n")
        if lines and self._skipping:
            lines, self._skipping = lines[1:], False
        if self._skipping or len(tail) > _MAX_LINE_BYTES:
            tail, self._skipping = b"", True
        self._tail = tail
        return [line for line in lines if line and len(line) <= _MAX_LINE_BYTES]

    def _dispatch(self, message: gcode.Message) -> None:
        log.debug("%s > %s", self.name, message)
        if isinstance(message, gcode.Reply):
            if message.number in self._requests:
                self._replies.setdefault(message.number, message)
            elif message.number is None and not message.ok:
                raise BadReplyError(
                    f"the arm complains about a request that it does not name: {gcode.explain(message.code)}; reconnect"
                )
        elif isinstance(message, gcode.Alarm):
            raise AlarmError(f"the arm's firmware locked itself ({message.text!r}); switch the arm off and on")
        elif isinstance(message, gcode.Noise):
            self._last_noise = message.text
        else:
            # Firmware 3.2 reports its power alone.
            self.started |= isinstance(message, gcode.Report) and message.kind in (gcode.READY, gcode.POWER)
            self.on_event(message)


def _advice(name: str) -> str:
    if ports.is_emulated(name):
        return "the emulator is gone, or too fast for a computer that has other things to do: start it with a smaller --speed"
    return "check the cable, the power and that this is the arm's port, then reconnect"


def open_link(port: str | None = None) -> Link:
    """Open ``port``, or the one uArm that is plugged in, for this process alone.

    On the real arm this pulses DTR and resets the controller: the motors go limp for a moment and the arm may sag.
    """
    name = ports.find_port(ports.ARM) if port is None else port
    log.info("opening %s, which resets the arm: it may sag for a moment", name)
    return Link(ports.open_port(ports.ARM, name, write_timeout_s=_WRITE_S), name)
