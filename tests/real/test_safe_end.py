"""How a session with the arm ends: every fault in its sentence, every end with the pump off, within a second."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from contextlib import suppress

import numpy as np
import pytest

from tests.bench import HOME, PARKING, Bench
from uarm_rl.emulator.faults import Fault
from uarm_rl.emulator.firmware import PARKED_DEG, Firmware
from uarm_rl.emulator.memory_port import MemoryPort
from uarm_rl.emulator.motion import KinematicJoints
from uarm_rl.emulator.pty import PtyServer
from uarm_rl.emulator.realism import Settings
from uarm_rl.real.link import AlarmError, BadReplyError, CommandRefusedError, LinkLostError, NoReplyError, open_link
from uarm_rl.real.swift_arm import NotReadyError, PumpError, ResetError, SwiftArm
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError


def work(arm):
    """Never stop, by itself."""
    while True:
        work_once(arm)


def work_once(arm):
    arm.home()
    arm.pump_on()
    arm.command_joints((HOME[0] + 0.1, HOME[1], HOME[2]))
    arm.advance()
    arm.read_joints()


METHODS = {
    "home": lambda arm: arm.home(),
    "read_joints": lambda arm: arm.read_joints(),
    "step": lambda arm: (arm.command_joints((HOME[0] + 0.1, HOME[1], HOME[2])), arm.advance()),
    "pump_on": lambda arm: arm.pump_on(),
    "pump_off": lambda arm: arm.pump_off(),
}
ASKS = {"home": "P2200", "read_joints": "P2200", "step": "G2206", "pump_on": "M2231", "pump_off": "M2231"}
EARLIER = {"P2200": 2, "G2206": 2, "M2231": 2}  # the fault strikes at the first request after connecting and homing


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ({"effect": "silence"}, NoReplyError),
        ({"effect": "lost"}, NoReplyError),
        ({"effect": "late", "delay_s": 30.0}, NoReplyError),
        ({"effect": "error", "data": b"E20"}, CommandRefusedError),
        ({"effect": "error", "data": b"E22"}, CommandRefusedError),
        ({"effect": "error", "data": b"E27"}, CommandRefusedError),
        ({"effect": "error", "data": b""}, CommandRefusedError),
        ({"effect": "garbage", "data": b"ALARM: Abort during cycle\r\n"}, AlarmError),
        ({"effect": "garbage", "data": b"E23 buffer full\r\n"}, BadReplyError),
        ({"effect": "garbage", "data": b"@5 V0\n"}, NotReadyError),
        ({"effect": "garbage", "data": b"@1\n"}, ResetError),
        ({"effect": "slow", "delay_s": 1.0}, NoReplyError),
        ({"effect": "reset"}, (ResetError, NoReplyError)),
        ({"effect": "unplug"}, LinkLostError),
        ({"effect": "duplicate"}, None),
        ({"effect": "late", "delay_s": 0.3}, None),
        ({"effect": "garbage", "data": b"\xff\x00$99 ok V1\n@3 X1\n\r\n"}, None),
    ],
)
def test_every_fault_ends_in_its_sentence(method, fault, error):
    name = ASKS[method]
    bench = Bench(faults=(Fault(command=name, nth=EARLIER[name], **fault),))
    arm = bench.connect()
    if name != "P2200":
        arm.home()
    start_s = bench.port.clock()
    if error is None:
        METHODS[method](arm)
        arm.close()
        return
    with pytest.raises(error, match=r"[a-z ]{20}.*[^.!]$") as caught:
        METHODS[method](arm)
    failed_s, written = bench.port.clock(), len(bench.port.written)
    arm.__exit__(type(caught.value), caught.value, None)
    assert failed_s - start_s < 8.0
    assert bench.port.clock() - failed_s <= 1.0
    assert bench.lines(written)[0] == "M2231 V0"
    with pytest.raises(ArmError):
        arm.read_joints()
    bench.judge()


def test_a_restart_in_the_middle_of_a_move():
    bench = Bench(faults=(Fault("reset", "G2206", delay_s=0.5),))
    with pytest.raises(ResetError, match="controller restarted"), bench.connect() as arm:
        arm.home()
    assert not bench.joints.sucking


def test_an_unplugged_cable_in_the_middle_of_a_move_and_the_next_connection():
    for delay_s in np.linspace(0.0, 1.5, 16):
        bench = Bench(faults=(Fault("unplug", "G2206", delay_s=delay_s),))
        arm = bench.connect()
        with pytest.raises(LinkLostError, match="keeps its pose and its pump"), arm:
            work(arm)
        assert "M2231 V0" in bench.lines()[-3:]  # tried, in vain
        start = len(bench.port.written)
        bench.port.firmware.unplugged = False  # the cable is put back, which resets the controller
        bench.port.firmware.reset()
        bench.connect().close()
        assert bench.lines(start)[0] == "M2231 V0"
        assert not bench.joints.sucking


# The safe end


def test_the_end_looks_again_while_the_pump_runs_down():
    bench = Bench(faults=tuple(Fault("error", "P2231", nth=nth, data=b"ok V1") for nth in (2, 3)))
    arm = bench.connect()
    start = len(bench.port.written)
    arm.close()
    assert bench.lines(start) == ["M2231 V0", "P2231", "P2231", "P2231", "P2200", PARKING]


def test_the_end_of_an_arm_at_rest():
    bench = Bench()
    arm = bench.connect()
    arm.home()
    arm.pump_on()
    start, start_s = len(bench.port.written), bench.port.clock()
    arm.close()
    assert bench.port.clock() - start_s <= 1.0
    assert bench.lines(start) == ["M2231 V0", "P2231", "P2200", PARKING]
    written = len(bench.port.written)
    arm.close()
    assert len(bench.port.written) == written
    bench.port.firmware.advance(60.0)
    assert bench.joints.angles == pytest.approx(PARKED_DEG, abs=0.05)


@pytest.mark.parametrize(
    ("firmware", "expected"),
    [
        ("V4.10.0", ["M2231 V0", "\x18", "M2231 V0", "P2231", "P2200", PARKING]),
        ("V4.5.0", ["M2231 V0", "!", "M2231 V0", "P2231"]),  # a flush would lock it, and after a hold it cannot park
    ],
)
def test_the_end_of_an_arm_in_motion(firmware, expected):
    bench = Bench(Settings(firmware=firmware))
    arm = bench.connect()
    bench.joints.suck(True)
    arm.command_joints(kinematics.from_motor_deg(100.0, 118.0, 50.0).tolist())
    arm._link.listen(0.1)
    start, start_s = len(bench.port.written), bench.port.clock()
    arm.close()
    assert bench.port.clock() - start_s <= 1.0
    assert bench.lines(start) == expected
    assert not bench.joints.sucking
    assert bench.joints.angles[0] < 100.0


def test_a_clean_close_tells_that_the_pump_may_still_run(caplog):
    bench = Bench(faults=(Fault("silence", "M2231", nth=2),))
    arm = bench.connect()
    start_s = bench.port.clock()
    with pytest.raises(PumpError, match="unplug the 12 V power supply"):
        arm.close()
    assert bench.port.clock() - start_s <= 1.0
    arm.close()
    assert "unplug the 12 V power supply" in caplog.text


@pytest.mark.parametrize("at", [1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144])
def test_an_interrupt_anywhere_ends_with_the_pump_off(at, monkeypatch):
    """Ctrl-C at the ``at``-th read or write after connecting."""
    bench = Bench()
    arm = bench.connect()
    calls = 0

    def interrupting(use):
        def call(*arguments):
            nonlocal calls
            calls += 1
            if calls == at:
                raise KeyboardInterrupt
            return use(*arguments)

        return call

    monkeypatch.setattr(bench.port, "read", interrupting(bench.port.read))
    monkeypatch.setattr(bench.port, "write", interrupting(bench.port.write))
    with pytest.raises(KeyboardInterrupt) as caught:
        work(arm)
    written, stopped_s = len(bench.port.written), bench.port.clock()
    arm.__exit__(KeyboardInterrupt, caught.value, None)
    assert bench.lines(written)[0] == "M2231 V0"
    assert bench.port.clock() - stopped_s <= 1.0
    assert not bench.joints.sucking


def _exit_143(number, frame):
    raise SystemExit(143)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_interrupt_does_not_skip_the_pump(number, monkeypatch):
    bench = Bench()
    arm = bench.connect()
    arm.pump_on()
    write = bench.port.write

    def interrupted_write(data):
        os.kill(os.getpid(), number)
        return write(data)

    monkeypatch.setattr(bench.port, "write", interrupted_write)
    # Of our own, both: a test run in the background inherits a SIGINT that is ignored.
    ours = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: _exit_143}
    previous = {one: signal.signal(one, handler) for one, handler in ours.items()}
    try:
        with pytest.raises((KeyboardInterrupt, SystemExit)):
            arm.close()
    finally:
        for one, handler in previous.items():
            signal.signal(one, handler)
    assert not bench.joints.sucking
    assert bench.lines()[-1].startswith("G2206 B90.000 L118.000")


def test_closing_from_another_thread():
    arm = Bench().connect()
    thread = threading.Thread(target=arm.close)
    thread.start()
    thread.join(20.0)
    assert not thread.is_alive()


# On real terminals, and against nonsense


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (Fault("silence", "P2200", nth=2), NoReplyError),
        (Fault("reset", "G2206", delay_s=0.3), ResetError),
        (Fault("unplug", "G2206", delay_s=0.3), LinkLostError),
        (Fault("power", "G2206", delay_s=0.3), NotReadyError),
        (Fault("error", "G2206", data=b"E22"), CommandRefusedError),
    ],
)
def test_faults_on_a_real_terminal(fault, error):
    with PtyServer(Firmware(joints=KinematicJoints(PARKED_DEG), faults=(fault,)), speed=20.0) as server:
        arm = SwiftArm(open_link(server.path))
        with pytest.raises(error) as caught:
            work(arm)
        failed_s = time.monotonic()
        arm.__exit__(error, caught.value, None)
        assert time.monotonic() - failed_s < 5.0  # 1 s, and slack for a busy machine


class NoisyPort(MemoryPort):
    """A line that changes, drops and invents bytes from the arm, more or less often."""

    def __init__(self, firmware, seed):
        super().__init__(firmware)
        self._random = random.Random(seed)
        self._rate = self._random.choice((0.001, 0.01, 0.1))

    def read(self, size=1):
        data = super().read(size)
        if self._random.random() >= self._rate:
            return data
        nonsense = self._random.randbytes(self._random.randrange(20))
        return self._random.choice((b"", nonsense, data + nonsense, nonsense + data, data[::-1], 2 * data))


def test_noise_on_the_line_never_hangs_the_driver():
    for seed in range(200):
        bench = Bench(Settings(tick_s=0.02))
        bench.port = NoisyPort(bench.port.firmware, seed)
        with suppress(ArmError), bench.connect() as arm:
            for _ in range(3):
                work_once(arm)
        assert bench.port.clock() < 100.0
        assert bench.lines()[0] == "M2231 V0"
        bench.judge()


def test_nothing_but_nonsense():
    generator = random.Random(3)

    class Babble(MemoryPort):
        def read(self, size=1):
            super().read(size)
            return generator.randbytes(generator.randrange(30))

    for _ in range(20):
        bench = Bench(Settings(tick_s=0.02))
        bench.port = Babble(bench.port.firmware)
        with pytest.raises(ArmError):
            bench.connect()
        assert bench.port.clock() < 20.0
