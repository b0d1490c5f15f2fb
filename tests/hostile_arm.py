"""Hostile wishes for the arm and hostile answers from it, as many as wanted; judged by the bytes on the wire and by the clock.

    python -c "from tests import hostile_arm; print(hostile_arm.references(1_000_000), hostile_arm.streams(10_000))"

Both return (trials, failures). ``references`` puts joint commands of every kind, and most of all those near a limit, to
the driver in front of an emulated arm; each line that reaches the wire is judged by ``bench.judge``, which
has limits and geometry of its own. ``streams`` lets the arm answer with random bytes, replies and reports.
"""

from __future__ import annotations

import logging
import math
import random
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from unittest import mock

import numpy as np

from tests.bench import judge, spares
from uarm_rl.emulator.firmware import PARKED_DEG, Firmware
from uarm_rl.emulator.memory_port import MemoryPort
from uarm_rl.emulator.motion import KinematicJoints
from uarm_rl.emulator.realism import Settings
from uarm_rl.real import audit
from uarm_rl.real.audit import KnownObject, UnsafeCommandError
from uarm_rl.real.link import Link
from uarm_rl.real.ports import READ_S
from uarm_rl.real.swift_arm import SwiftArm
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError

NO_NUMBERS = (math.nan, math.inf, -math.inf, 1e308, 10**400, "1", None, 1j, b"0", [], Fraction(10**9, 7), np.nan, 2.0**64)
NO_REFERENCES = (None, 0.0, "abc", {}, (), np.zeros((3, 3)), np.array([None, 0, 0]), np.zeros(3, np.complex64), object())


def quick_port() -> MemoryPort:
    """An emulated arm at coarse time: nothing is measured here but what is written to it."""
    return MemoryPort(emulated(), quantum_s=READ_S)


def emulated() -> Firmware:
    return Firmware(Settings(tick_s=1.0), KinematicJoints(PARKED_DEG))


#: In the middle of where hostile wishes lead.
OBJECT = KnownObject((0.21, 0.02, 0.12), (0.06, 0.06, 0.12), 0.005)


def wishes(generator: random.Random, joints: tuple[float, ...]) -> object:
    """One hostile reference, given where the arm is."""
    kind = generator.randrange(12)
    if kind == 0:
        return generator.choice(NO_REFERENCES)
    if kind == 1:  # a wrong length
        return [generator.uniform(-0.2, 0.2) for _ in range(generator.choice((0, 1, 2, 4, 5, 100)))]
    if kind == 2:  # one number that is none, in a good place otherwise
        wish: list[object] = list(joints)
        wish[generator.randrange(3)] = generator.choice(NO_NUMBERS)
        return wish
    if kind == 3:
        return [generator.uniform(-4.0, 4.0) for _ in range(3)]
    if kind == 4:
        return [math.ldexp(generator.uniform(-1.0, 1.0), generator.randrange(-60, 60)) for _ in range(3)]
    if kind == 5:  # at a limit, or a hair beside it
        joint = generator.randrange(3)
        wish = list(joints)
        wish[joint] = generator.choice(kinematics.JOINT_LIMITS_RAD[joint].tolist()) + generator.choice(
            (-1, 0, 1)
        ) * 10.0 ** -generator.randrange(2, 9)
        return wish
    if kind == 6:  # at the coupled limit
        depression = generator.choice(kinematics.FOREARM_LIMITS_RAD) + generator.uniform(-1e-3, 1e-3)
        return joints[0], joints[1], depression - joints[1]
    if kind == 7:  # towards the table, the base, the edge
        return joints[0], joints[1] + 0.25 * generator.random(), joints[2] + 0.25 * generator.random()
    scale = generator.choice((0.01, 0.1, 0.25, 0.2501, 0.3))
    wish = [joint + generator.uniform(-scale, scale) for joint in joints]
    return np.array(wish) if generator.random() < 0.2 else wish


_WALK = 500  # commands from the home pose on; a longer walk ends in a corner


@contextmanager
def silence() -> Iterator[None]:
    """No log: it would have a line for each command."""
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)


def references(count: int, seed: int = 0) -> tuple[int, int]:
    """Put ``count`` joint commands to the driver; how many put something on the wire that may not be there."""
    generator = random.Random(seed)
    failures = 0
    with silence():
        for first in range(0, count, _WALK):
            port = quick_port()
            with SwiftArm(Link(port, "hostile", clock=port.clock)) as arm:
                arm.home()
                arm.known = OBJECT
                for _ in range(first, min(first + _WALK, count)):
                    joints = arm.read_joints()
                    port.written.clear()
                    with suppress(UnsafeCommandError):
                        arm.command_joints(wishes(generator, joints))  # type: ignore[arg-type]
                        arm.advance()
                    failures += not harmless(bytes(port.written), kinematics.to_motor_deg(joints))
    return count, failures


def harmless(written: bytes, standing_deg: tuple[float, float, float]) -> bool:
    try:
        for line in written.decode("ascii").splitlines():
            goal_deg = judge(line, standing_deg)
            assert goal_deg is None or spares(standing_deg, goal_deg, (210.0, 20.0, 120.0), 42.4, 5.0)
    except (AssertionError, AttributeError, ValueError):
        return False
    return True


def blind() -> mock._patch:
    """A control that ``references`` must catch: an audit that does not look where the cup goes."""
    return mock.patch.object(audit, "_check_path", return_value=None)


def careless() -> mock._patch:
    """Another: an audit that forgets the object."""
    return mock.patch.object(audit, "_spares", return_value=True)


class Liar(MemoryPort):
    """An arm that does as it is told but does not always say so: now and then, or always, it answers something else."""

    def __init__(self, seed: int) -> None:
        super().__init__(emulated(), quantum_s=READ_S)
        self._random = random.Random(seed)
        self._honesty = self._random.choice((0.0, 0.5, 0.9, 0.97, 0.99))
        self._asked = b"1"

    def write(self, data: bytes) -> int:
        self._asked = data[1:].split(b" ")[0]
        return super().write(data)

    def read(self, size: int = 1) -> bytes:
        said = super().read(size)
        if self._random.random() < self._honesty:
            return said
        self._now_s += self._random.choice((0.0005, 0.02))
        return self._lie(said)[:4096]

    def _lie(self, truth: bytes) -> bytes:
        generator = self._random
        number = generator.choice((self._asked, self._asked, b"%d" % generator.randrange(10**9)))
        status = generator.choice(
            (b"ok", b"ok V1", b"ok V0", b"ok V4.10.0", b"ok B90 L118 R50", b"ok Vnan", b"E22", b"", b"ok B1 L")
        )
        return generator.choice(
            (
                b"",
                truth + truth,
                truth[::-1],
                generator.randbytes(generator.randrange(300)),
                b"$" + number + b" " + status + b"\n",
                b"@%d V%d\n" % (generator.randrange(12), generator.randrange(3)),
                b"value:0      value2:0$" + number + b" " + status + b"\n",
                generator.choice((b"\n", b"\n", b"@1\n", b"ALARM: Abort during cycle\r\n", b"E23 buffer full\r\n")),
                bytes([generator.randrange(256)]) * generator.randrange(5000),
            )
        )


#: Longer than all deadlines of connecting, homing, one step and closing together (s).
PATIENCE_S = 60.0


def streams(count: int, seed: int = 0) -> tuple[int, int]:
    """Let ``count`` arms answer nonsense; how many kept the driver longer than its deadlines, or broke it otherwise."""
    failures = 0
    with silence():
        for number in range(count):
            port = Liar(seed + number)
            try:
                with suppress(ArmError), SwiftArm(Link(port, "liar", clock=port.clock)) as arm:
                    work(arm)
            except Exception:
                failures += 1
            failures += port.clock() > PATIENCE_S
    return count, failures


def work(arm: SwiftArm) -> None:
    arm.home()
    one, two, three = arm.read_joints()
    arm.command_joints((one + 0.1, two, three))
    arm.advance()
    arm.pump_on()
    arm.pump_off()
