"""The arm's controller as a state machine: bytes and time in, bytes out. Firmware V4.

Framing, order and latencies are those seen when the released binaries (V4.10.0, V4.5.0) run on a simulated controller.
The point that matters most: commands with G and M answer only when the machine stands still, all together, while
commands with P answer at once; and there is no preemption. Nothing here knows threads, ports or real time.
"""

from __future__ import annotations

import heapq
import re
from typing import Final

from uarm_rl.emulator.controller import Machine, RefusalError
from uarm_rl.emulator.faults import Fault, Faults
from uarm_rl.emulator.motion import Joints, KinematicJoints, MotorAngles
from uarm_rl.emulator.realism import Settings

PARKED_DEG: Final[MotorAngles] = (90.0, 118.0, 50.0)

_RX_BYTES: Final = 128
_LINE_BYTES: Final = 80
_PENDING: Final = 20  # replies that wait for standstill
_BEEP_S: Final = 0.26  # after boot; replies to G and M wait for its end
_STALL_S: Final = 0.03  # reading all encoders in motion: a standstill of 15 to 53 ms
_UNLOCK_S: Final = 0.5
_MPOS_DEG: Final = 80.0  # grbl's unit
_LATENCY_S: Final = {
    **dict.fromkeys(("P2200", "P2220", "P2221", "P2243", "M17", "M2123", "M2201", "M2401"), 0.04),  # 13 ms an encoder
    **dict.fromkeys(("M2220", "M2221", "M2222"), 0.0055),
    "P2206": 0.0143,
}
_ENCODER_QUERIES: Final = ("P2200", "P2220", "P2221")
_REQUEST: Final = re.compile(r"(?:#(\d+))?([A-Z$].*)?")


class Firmware:
    """Feed it with ``advance``; it starts switched off-and-on at time 0, with its boot text still to come."""

    def __init__(
        self,
        settings: Settings | None = None,
        joints: Joints | None = None,
        *,
        faults: tuple[Fault, ...] = (),
    ) -> None:
        self.settings = settings or Settings()
        self.machine = Machine(self.settings, joints or KinematicJoints(PARKED_DEG))
        self.now_s = 0.0  # the arm's time
        self.unplugged = False
        self._faults = Faults(faults)
        self._sequence = 0
        self._events: list[tuple[float, int, str]] = []  # faults to come
        self._out: list[tuple[float, int, bytes]] = []  # heap: when, order, what
        self.reset()

    def reset(self) -> None:
        """Start anew, as when a program opens the port: motors limp for a moment, pump off, boot text."""
        self.machine.reset()
        self._out = [entry for entry in self._out if entry[0] <= self.now_s]  # sent already
        self._last_byte_s = 0.0
        self._byte_period_s = 0.0
        self._silent = False
        self._rx = bytearray()
        self._skipping = False  # the rest of a line that was too long
        self._held: list[tuple[str, str, float]] = []  # (number, answer, delay) of G and M commands
        self._locked = False
        self._end_due = False
        self._next_report_s = 0.0
        self._tip_pressed = False
        self._booted_s = self.now_s + self.settings.boot_s
        self._busy_until_s = self._booted_s + _BEEP_S
        self._loop_free_s = self._booted_s + 0.05
        self._greet()

    def _greet(self) -> None:
        boot_s, settings = self.settings.boot_s, self.settings
        text = (
            f"angle offset:0.0000\r\ndevice name : SwiftPro\r\nsoft ver : {settings.firmware}\r\napi ver : {settings.api}\r\n"
        )
        self._emit(f"{text}work mode : {self.machine.tool_mode}\r\n@1\n", boot_s + 0.015)
        if self.machine.power_12v:
            self._emit("@5 V1\n", boot_s + 0.04)

    def advance(self, to_s: float, received: bytes = b"") -> bytes:
        """Let time pass until ``to_s``, then receive bytes; returns what was sent meanwhile."""
        while self.now_s < to_s:
            dt_s = min(self.settings.tick_s, to_s - self.now_s)
            self.now_s += dt_s
            self._tick(dt_s)
        if self.now_s >= self._booted_s:  # the boot loader eats what comes before
            for byte in received:
                self._receive(byte)
            self._process()
        sent = bytearray()
        while self._out and self._out[0][0] <= self.now_s:
            sent += heapq.heappop(self._out)[2]
        return b"" if self.unplugged else bytes(sent)

    # Time

    def _tick(self, dt_s: float) -> None:
        machine = self.machine
        if not machine.started and self.now_s >= self._booted_s:
            machine.start()
        was_moving = machine.motion.moving
        machine.drive(dt_s)
        self._end_due |= was_moving and not machine.motion.moving
        while self._events and self._events[0][0] <= self.now_s:
            self._strike(heapq.heappop(self._events)[2])
        if machine.report_period_s > 0.0 and self.now_s >= self._next_report_s:
            self._next_report_s = self.now_s + machine.report_period_s
            self._emit(f"@3 {machine.cup_text()} R{machine.servo_deg:.4f}\n", 0.04)
            self._starve(0.04)
        if machine.joints.tip_pressed() != self._tip_pressed:
            self._tip_pressed = not self._tip_pressed
            self._emit(f"@6 N0 V{int(self._tip_pressed)}\n")
        self._process()
        if self._idle():
            self._release()

    def _idle(self) -> bool:
        return not self.machine.motion.moving and self.now_s >= self._busy_until_s

    def _release(self, delay_s: float = 0.0) -> None:
        """Send the answers that waited for standstill, in one burst."""
        for number, answer, late_s in self._held:
            self._answer(number, answer, delay_s + late_s)
        self._held.clear()
        if self._end_due and self.machine.reports_end:
            self._emit("@9 V0\n", delay_s)
        self._end_due = False

    def _starve(self, delay_s: float) -> None:
        """Reading every encoder in motion drains the step buffer: grbl takes itself for idle and answers."""
        if self.settings.false_ok and self.machine.motion.moving:
            self.machine.motion.stall(_STALL_S)
            self._end_due = True
            self._release(delay_s)

    # Sending

    def _emit(self, text: str, delay_s: float = 0.0) -> None:
        if self._silent:
            return
        when_s = self.now_s + delay_s + self.settings.latency_s
        data = text.encode("latin-1")
        if not self._byte_period_s:
            return self._push(when_s, data)
        for byte in data:
            when_s = self._last_byte_s = max(when_s, self._last_byte_s) + self._byte_period_s
            self._push(when_s, bytes([byte]))
        return None

    def _push(self, when_s: float, data: bytes) -> None:
        self._sequence += 1  # keeps the order of what leaves at the same time
        heapq.heappush(self._out, (when_s, self._sequence, data))

    def _answer(self, number: str, answer: str, delay_s: float = 0.0) -> None:
        *stray, answer = answer.rsplit("\r\n", 1)  # "sscanf 1" comes on a line of its own
        prefix = f"${number} " if number and answer else f"${number}" if number else ""
        self._emit("".join(f"{line}\r\n" for line in stray) + f"{prefix}{answer}\n", delay_s)

    # Receiving

    def _receive(self, byte: int) -> None:
        char = chr(byte)
        motion = self.machine.motion
        if char == "?":
            self._emit(self._status(), 0.0002)
        elif char == "!":
            motion.held = True
            self._emit("ok @9 V0\n")
        elif char == "~":
            motion.held = False
            self._emit("ok\n")
        elif char == "\x18":
            self._flush()
        elif char == "@":
            self._lock()
        elif len(self._rx) < _RX_BYTES:  # no flow control: what does not fit is gone
            self._rx.append(byte)

    def _status(self) -> str:
        motion = self.machine.motion
        state = "Alarm" if self._locked else "Hold" if motion.held else "Run" if motion.moving else "Idle"
        b, left, right = (at - zero for at, zero in zip(motion.position, motion.origin, strict=True))
        position = ",".join(f"{delta / _MPOS_DEG + 0.0:.3f}" for delta in (left, right, b))
        return f"<{state},MPos:{position},WPos:{position}>\r\n"

    def _flush(self) -> None:
        if self.settings.version >= (4, 10, 0):
            self._locked = False
            self.machine.resynchronise()
            self._loop_free_s = max(self._loop_free_s, self.now_s + 0.04)
            self._emit("ok\n", 0.04)
            self._held = [(number, "ok", late_s) for number, _, late_s in self._held]
            self._release(0.041)
        elif self.machine.motion.moving:  # a bare reset of grbl, which locks itself when that comes in motion
            self._lock()

    def _lock(self) -> None:
        self.machine.resynchronise()
        self._locked = True
        self._held.clear()
        self._emit("ALARM: Abort during cycle\r\n")
        self._emit("['$H'|'$X' to unlock]\r\n", _UNLOCK_S)

    def _process(self) -> None:
        """Carry out complete lines while the main loop is free."""
        while self.now_s >= self._loop_free_s:
            ends = [index for index in (self._rx.find(b"\n"), self._rx.find(b"\r")) if index >= 0]
            end = min(ends, default=len(self._rx))
            if end > _LINE_BYTES and not self._skipping:
                self._emit("error: E23\n\r\n")
                self._skipping = True
            if not ends:
                if self._skipping:
                    self._rx.clear()
                return
            line = bytes(self._rx[:end]).decode("latin-1")
            del self._rx[: end + 1]
            if self._skipping:
                self._skipping = False
            else:
                self._line(line)

    def _line(self, line: str) -> None:
        text = re.sub(r"\(.*?\)|;.*|[\x00-\x20\x7f-\xff]", "", line).upper()
        match = _REQUEST.fullmatch(text)
        if match is None or not match[2] or (not match[1] and match[2][0] not in "GMPS$"):
            return
        number, command = match[1] or "", match[2]
        name = re.match(r"[A-Z$]\d*", command)
        self._command(number, command, name[0] if name else "")

    def _command(self, number: str, command: str, name: str) -> None:
        struck = self._faults.strike(name)
        for effect in ("silence", "slow"):
            if effect in struck:
                self._strike(effect, struck[effect])
        for effect in ("reset", "power", "unplug"):
            if effect in struck:
                self._sequence += 1
                heapq.heappush(self._events, (self.now_s + struck[effect].delay_s, self._sequence, effect))
        if command == "$X":
            self._locked = False
            return self._emit("ok\n")
        if self._locked and name.startswith("G"):
            return None  # swallowed without an answer
        deferred = self._defers(name)
        if deferred and len(self._held) >= _PENDING:
            return self._emit("E23 buffer full\r\n")
        moving = self.machine.motion.moving
        try:
            answer = struck["error"].data.decode("latin-1") if "error" in struck else self.machine.execute(command)
        except RefusalError as refusal:
            answer = str(refusal)
        if name == "P2231" and self.machine.pump_state() and self.settings.debug_prefix and self.settings.version >= (4, 10, 0):
            self._emit("value:0      value2:0", 0.0015)
        latency_s = 0.022 if moving and name == "P2206" else _LATENCY_S.get(name, 0.0015)
        self._loop_free_s = self.now_s + latency_s
        busy_until_s, self.machine.busy_s = self.now_s + self.machine.busy_s, 0.0
        if name != "G2004":  # a dwell is answered before it is over, a beep after
            self._busy_until_s = max(self._busy_until_s, busy_until_s)
        if moving and name in _ENCODER_QUERIES:
            self._starve(latency_s)
        self._faulty_answer(number, answer, latency_s, struck, deferred=deferred)
        self._busy_until_s = max(self._busy_until_s, busy_until_s)
        return None

    def _defers(self, name: str) -> bool:
        """Whether the answer waits for standstill."""
        return not name.startswith(("P", "S"))

    def _faulty_answer(self, number: str, answer: str, latency_s: float, struck: dict[str, Fault], *, deferred: bool) -> None:
        if "garbage" in struck:
            self._emit(struck["garbage"].data.decode("latin-1"), latency_s)
        if "lost" in struck:
            return
        late_s = struck["late"].delay_s if "late" in struck else 0.0
        for _ in range(2 if "duplicate" in struck else 1):
            if deferred and (self._held or not self._idle()):
                self._held.append((number, answer, late_s))
            else:
                self._answer(number, answer, latency_s + late_s)

    # Faults

    def _strike(self, effect: str, fault: Fault | None = None) -> None:
        if effect == "silence":
            self._silent = True
        elif effect == "slow" and fault is not None:
            self._byte_period_s = fault.delay_s
        elif effect == "reset":
            self.reset()
        elif effect == "power":
            self.machine.lose_power()
            self._emit("@5 V0\n")
        elif effect == "unplug":
            self.unplugged = True
