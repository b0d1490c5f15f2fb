"""The link: right reply to the right request, or a typed error within the deadline, whatever comes."""

from __future__ import annotations

import math
import os
import random
import threading
import time
import tracemalloc
import tty
from contextlib import suppress
from dataclasses import dataclass, field

import pytest
import serial
from hypothesis import given, settings
from hypothesis import strategies as st

from uarm_rl.real import gcode, ports
from uarm_rl.real.link import (
    AlarmError,
    BadReplyError,
    CommandRefusedError,
    Event,
    Link,
    LinkLostError,
    NoReplyError,
    open_link,
)
from uarm_rl.task.arm import ArmError

READ_S = 0.02


@dataclass
class Script:
    """A port that answers each write with the next of ``answers`` and lets virtual time pass while it is read."""

    answers: list[bytes] = field(default_factory=list)
    endless: bytes = b""  # comes again and again
    error: Exception | None = None  # raised by read
    now_s: float = 0.0
    written: bytearray = field(default_factory=bytearray)
    inbox: bytes = b""
    closed: int = 0

    @property
    def in_waiting(self):
        return len(self.inbox)

    def read(self, size=1):
        if self.error:
            raise self.error
        if not self.inbox:
            self.inbox = self.endless
        self.now_s += 0.001 if self.inbox else READ_S
        data, self.inbox = self.inbox[:size], self.inbox[size:]
        return data

    def write(self, data):
        self.written += data
        if self.answers:
            self.inbox += self.answers.pop(0)
        return len(data)

    def close(self):
        self.closed += 1


def connect(*answers, **keywords):
    script = Script(list(answers), **keywords)
    return script, Link(script, "test port", clock=lambda: script.now_s)


def test_requests_are_numbered_and_answered():
    script, arm = connect(b"$1 ok V4.10.0\n", b"$2 ok B1 L2 R3\n", b"$3 ok V1\n")
    assert arm.request(gcode.READ_FIRMWARE).text == "V4.10.0"
    assert arm.read_values(gcode.READ_ANGLES, "BLR") == [1.0, 2.0, 3.0]
    assert arm.read_value(gcode.READ_PUMP, "V") == 1.0
    assert script.written == b"#1 P2203\n#2 P2200\n#3 P2231\n"


def test_numbers_start_over_before_they_grow_too_long():
    script, arm = connect()
    for _ in range(gcode.MAX_NUMBER + 1):
        arm.send(gcode.READ_PUMP)
    assert script.written.endswith(b"#9999 P2231\n#1 P2231\n")


@pytest.mark.parametrize(
    "noise",
    [
        b"@3 X1 Y2 Z3 R4\n",
        b"$7 ok V9\n",  # somebody else's
        b"\xff\xfe\x00garbage\n",
        b"$1 ok V9",  # fused with the next line, hence no reply
        b"value:0      value2:0",
        5000 * b"x" + b"\n",
        b"\n\r\n\r",
        b"",
    ],
)
def test_noise_before_the_reply_is_skipped(noise):
    ending = b"\n" if noise.startswith(b"$1") else b""
    _, arm = connect(b"", noise + ending + b"$2 ok V1\r\n")
    arm.send(gcode.MOTORS_ON)
    assert arm.read_value(gcode.READ_PUMP, "V") == 1.0


def test_late_and_repeated_replies_answer_nothing():
    _, arm = connect(b"", b"$1 ok V0\n$2 ok V1\n$2 ok V0\n$1 E22\n", b"$2 ok V0\n$3 ok V2\n")
    with pytest.raises(NoReplyError):
        arm.request(gcode.READ_PUMP)
    assert arm.read_value(gcode.READ_PUMP, "V") == 1.0
    assert arm.read_value(gcode.READ_PUMP, "V") == 2.0


def test_the_first_of_repeated_replies_counts():
    _, arm = connect(b"", b"$1 ok V1\n$1 ok V0\n$2 ok V2\n")
    first, second = arm.send(gcode.READ_PUMP), arm.send(gcode.READ_PUMP)
    assert arm.wait(second, 1.0).value("V") == 2.0
    assert arm.wait(first, 1.0).value("V") == 1.0


def test_replies_may_come_in_any_order():
    _, arm = connect(b"", b"$2 ok V2\n$1 ok V1\n")
    first, second = arm.send(gcode.READ_PUMP), arm.send(gcode.READ_PUMP)
    assert arm.wait(first, 1.0).value("V") == 1.0
    assert arm.wait(second, 1.0).value("V") == 2.0


@pytest.mark.parametrize(
    ("answer", "error", "words"),
    [
        (b"", NoReplyError, r"asked to read the state of the pump \(P2231\) and did not answer within 1.0 s on test port"),
        (b"hello\n", NoReplyError, "instead it sent 'hello'"),
        (b"$1 ok V1", NoReplyError, "did not answer"),  # half a line
        (b"#1 P2231\n", NoReplyError, "#1 P2231"),  # an echo
        (b"$1 E22\n", CommandRefusedError, "outside the limits"),
        (b"$1 ok E22 unreachable\r\n", CommandRefusedError, "outside the limits"),
        (b"$1 E27\n", CommandRefusedError, "motor is switched off"),
        (b"$1\n", CommandRefusedError, "no reason"),
        (b"$1 E77\n", CommandRefusedError, "E77"),
        (b"$1 ok\n", BadReplyError, "a number after each of V"),
        (b"$1 ok Vnan\n", BadReplyError, "a number after each of V"),
        (b"E23 buffer full\r\n", BadReplyError, "buffer is full"),
        (b"ALARM: Abort during cycle\r\n", AlarmError, "off and on"),
    ],
)
def test_what_goes_wrong_has_a_type_and_a_sentence(answer, error, words):
    script, arm = connect(answer)
    with pytest.raises(error, match=words):
        arm.read_value(gcode.READ_PUMP, "V")
    assert script.now_s <= 1.0 + 2 * READ_S


def test_a_refusal_carries_its_code():
    _, arm = connect(b"$1 E22\n")
    with pytest.raises(CommandRefusedError) as caught:
        arm.request(gcode.MOTORS_ON)
    assert caught.value.code == "E22"


def test_events_reach_the_callback_and_its_error_ends_the_call():
    seen: list[Event] = []
    _, arm = connect(b"@5 V1\nsoft ver : V4.10.0\r\n$1 ok\n", b"@5 V0\n$2 ok V1\n")
    arm.on_event = seen.append
    arm.request(gcode.MOTORS_ON)
    assert seen == [gcode.Report(5, {"V": "1"}), gcode.Boot("V4.10.0")]

    def stop(event):
        raise ArmError("12 V lost")

    arm.on_event = stop
    with pytest.raises(ArmError, match="12 V lost"):
        arm.request(gcode.READ_PUMP)


@pytest.mark.parametrize("endless", [b"x", b"\n", b"@3 X1 Y2 Z3 R4\n", b"$9 ok\n", bytes(range(256)), 300 * b"@"])
def test_a_flood_neither_hangs_nor_fills_the_memory(endless):
    script, arm = connect(endless=4096 // len(endless) * endless)
    tracemalloc.start()
    with pytest.raises(NoReplyError):
        arm.request(gcode.READ_PUMP, 0.2)
    assert tracemalloc.get_traced_memory()[1] < 500_000
    tracemalloc.stop()
    assert script.now_s <= 0.2 + 2 * READ_S


def _termios_error():
    return ports.termios_error(5, "Input/output error")


@pytest.mark.parametrize("error", [serial.SerialException("gone"), OSError(5, "I/O"), _termios_error()])
def test_an_unplugged_cable_is_one_typed_error(error):
    _, arm = connect(error=error)
    with pytest.raises(LinkLostError, match="check the USB cable"):
        arm.request(gcode.READ_PUMP)


@pytest.mark.parametrize("error", [serial.SerialTimeoutException("full"), OSError(5, "I/O"), _termios_error()])
def test_a_port_that_takes_no_bytes_is_one_typed_error(error, monkeypatch):
    script, arm = connect()
    monkeypatch.setattr(script, "write", lambda data: (_ for _ in ()).throw(error))
    with pytest.raises(LinkLostError, match="accepts no more bytes"):
        arm.request(gcode.READ_PUMP)


def test_closing_twice_is_fine_and_a_broken_port_closes_too():
    script, arm = connect()
    arm.close()
    arm.close()
    assert script.closed == 1
    script, arm = connect()
    script.close = lambda: (_ for _ in ()).throw(OSError(5, "I/O"))
    arm.close()


@settings(max_examples=2000)
@given(st.lists(st.binary(max_size=80) | st.sampled_from((b"$1 ok V1\n", b"$2 ok", b"@5 V0\n", b"\n", b"$1 E2")), max_size=9))
def test_random_bytes_from_the_arm(chunks):
    script, arm = connect(b"".join(chunks))
    for _ in range(2):
        start_s = script.now_s
        with suppress(ArmError):
            assert math.isfinite(arm.read_value(gcode.READ_PUMP, "V", timeout_s=0.1))
        assert script.now_s - start_s <= 0.1 + 2 * READ_S + 0.01


# Real terminals


@pytest.fixture
def terminal():
    """A raw pseudo-terminal: the master's descriptor and the name of the slave."""
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(slave)
    os.close(master)


def _answer(master, reply):
    """Answer what comes on ``master`` once."""

    def run():
        os.read(master, 100)
        os.write(master, reply())

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def test_over_a_real_terminal(terminal):
    arm = open_link(terminal[1])
    thread = _answer(terminal[0], lambda: b"@5 V1\n$1 ok V2\n")
    assert arm.read_value(gcode.READ_PUMP, "V", timeout_s=10.0) == 2.0
    thread.join()
    arm.close()


def test_random_bytes_over_a_real_terminal(terminal):
    generator = random.Random(7)
    arm = open_link(terminal[1])
    for _ in range(30):
        data = generator.randbytes(generator.randrange(400)) + generator.choice((b"", b"$1 ok V1", b"\n$"))
        thread = _answer(terminal[0], lambda data=data: data)
        start_s = time.monotonic()
        with pytest.raises(ArmError):
            arm.read_value(gcode.READ_PUMP, "V", timeout_s=0.05)
        assert time.monotonic() - start_s < 5.0
        thread.join()
    arm.close()


def test_a_real_terminal_that_is_not_read_does_not_block_for_ever(terminal):
    arm = open_link(terminal[1])
    start_s = time.monotonic()
    with pytest.raises(LinkLostError, match="accepts no more bytes"):
        arm.write(1_000_000 * b"\n")
    assert time.monotonic() - start_s < 10.0
    arm.close()


def test_a_real_terminal_that_goes_away():
    master, slave = os.openpty()
    tty.setraw(slave)
    arm = open_link(os.ttyname(slave))
    os.close(slave)
    os.close(master)
    with pytest.raises(LinkLostError):
        arm.request(gcode.READ_PUMP)
    arm.close()
