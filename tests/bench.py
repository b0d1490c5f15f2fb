"""An emulated arm on the bench, in memory and virtual time; and an independent judge of what is written to it."""

from __future__ import annotations

import math
import re
import time

import numpy as np

from uarm_rl.emulator.firmware import PARKED_DEG, Firmware
from uarm_rl.emulator.memory_port import MemoryPort
from uarm_rl.emulator.motion import KinematicJoints
from uarm_rl.real.link import Link
from uarm_rl.real.swift_arm import SwiftArm
from uarm_rl.real.trials import Task
from uarm_rl.task import kinematics
from uarm_rl.task.hold import UntilSteady

HOME = tuple(kinematics.HOME_JOINTS_RAD.tolist())
PARKING = "G2206 B90.000 L118.000 R50.000 F20.0"


class Bench:
    """``port.written`` has every byte that the driver wrote, or tried to."""

    def __init__(self, settings=None, start=PARKED_DEG, faults=(), firmware=Firmware, **keywords):
        self.joints = KinematicJoints(start)
        self.port = MemoryPort(firmware(settings, self.joints, faults=faults))
        self.keywords = keywords

    def connect(self):
        return SwiftArm(Link(self.port, "emulated arm", clock=self.port.clock), **self.keywords)

    def lines(self, start=0):
        """The requests from byte ``start`` on without their numbers, and the immediate bytes."""
        text = re.sub("([!\x18])", r"\1\n", self.port.written[start:].decode("latin-1"))
        return [re.sub(r"^#\d+ ", "", line) for line in text.split("\n") if line]

    def judge(self, last_deg=None):
        """Judge every line; moves are single steps if ``last_deg`` says where the first one starts (B, L, R)."""
        for line in re.sub(b"[!\x18]", b"", self.port.written).decode("ascii").split("\n"):
            goal_deg = judge(line, last_deg) if line else None
            if goal_deg and last_deg:
                last_deg = goal_deg


_OTHERS = {"M17", "P2200", "P2203", "P2231", "P2234", "P2400", "M2231 V0", "M2231 V1", "M2400 S0"}
_MOVE = re.compile(r"G2206 B(\d+\.\d{3}) L(-?\d+\.\d{3}) R(-?\d+\.\d{3}) F(\d+\.\d)")


def judge(line, last_deg=None):
    """Raise unless a line may be sent, by limits and geometry of its own; return the B, L, R that it goes to, if any.

    With ``last_deg`` the move is a single step from there.
    """
    number, command = re.fullmatch(r"#(\d{1,4}) (.*)", line).groups()
    assert len(line) < 50
    assert int(number) > 0
    if command in _OTHERS:
        return None
    move = _MOVE.fullmatch(command)
    assert move, line
    b, left, right, feed = map(float, move.groups())
    assert 0.0 <= b <= 180.0
    assert -4.0 <= left <= 135.6
    assert -4.0 <= right <= 119.9
    assert 29.0 <= left + right <= 170.0
    assert 0.0 < feed <= 30.0
    radius = 142.07 * math.cos(math.radians(left)) + 158.81 * math.cos(math.radians(right)) + 13.2 + 56.65
    height = 142.07 * math.sin(math.radians(left)) - 158.81 * math.sin(math.radians(right)) + 107.4 - 74.55
    x, y = radius * math.sin(math.radians(b)), -radius * math.cos(math.radians(b))
    assert -10.1 <= x <= 370.0
    assert abs(y) <= 370.0
    assert 2.9 <= height <= 200.0
    assert abs(x) > 75.4 or abs(y) > 75.4 or height > 86.9  # the base
    if last_deg is not None:
        allowed = math.degrees(0.25) + 0.2  # the encoders read up to half a count away from the last command
        assert abs(b - last_deg[0]) <= allowed
        assert abs(left - last_deg[1]) <= allowed
        assert abs(left + right - last_deg[1] - last_deg[2]) <= allowed  # joint3
    return b, left, right


def spares(start_deg, goal_deg, top_mm, half_diagonal_mm, press_mm):
    """Whether the cup stays out of an object all along a straight line in motor angles, but for what it may press.

    With geometry of its own, every 0.05 degrees; a cup that began inside may not come deeper.
    """
    pieces = max(2, int(max(abs(np.subtract(goal_deg, start_deg))) / 0.05))
    b, left, right = (np.linspace(start, goal, pieces) for start, goal in zip(start_deg, goal_deg, strict=True))
    radius = 142.07 * np.cos(np.radians(left)) + 158.81 * np.cos(np.radians(right)) + 13.2 + 56.65
    height = 142.07 * np.sin(np.radians(left)) - 158.81 * np.sin(np.radians(right)) + 107.4 - 74.55
    x, y = radius * np.sin(np.radians(b)), -radius * np.cos(np.radians(b))
    aside = np.hypot(x - top_mm[0], y - top_mm[1])
    inside = np.minimum(top_mm[2] - press_mm - height, half_diagonal_mm + 9.5 - aside)
    return inside.max() <= max(inside[0], 0.0) + 0.15  # the angles on the wire have three digits


PLACE = np.array([0.2, 0.05, 0.03])
TASK = Task(
    hold=UntilSteady(0.001, 2, 40),
    control_hz=20,
    max_delta_rad=0.15,
    tolerance_m=0.005,
    dwell_s=0.5,
    time_limit_s=10.0,
    press_m=0.002,
    max_press_m=0.005,
    object_size_m=(0.03, 0.03, 0.03),
)


class Workbench(KinematicJoints):
    """Joints with an object: it hangs from the cup once the cup was near its top with the pump on."""

    def __init__(self, top=PLACE, *, seals_below_m=0.003, slips_at_m=math.inf):
        super().__init__(PARKED_DEG)
        self.top = np.array(top, float)
        self.seals_below_m, self.slips_at_m = seals_below_m, slips_at_m

    def drive(self, motor_deg, dt_s):
        super().drive(motor_deg, dt_s)
        cup = kinematics.cup_position(kinematics.from_motor_deg(*self.angles))
        aside, above = math.dist(cup[:2], self.top[:2]), cup[2] - self.top[2]
        if not self.sealed:
            self.sealed = self.sucking and aside < 0.0055 and above < self.seals_below_m
        if not self.sucking or (self.sealed and cup[2] > self.slips_at_m):
            self.sealed = False
            self.top[2] = 0.03
        if self.sealed:
            self.top = cup


class Tap(Firmware):
    """Keeps what it hears."""

    heard = b""

    def advance(self, to_s, received=b""):
        self.heard += received
        return super().advance(to_s, received)

    def moves(self):
        return re.findall(rb"G\d+[^\n]*", self.heard)

    def wait_until_parked(self):
        """The driver does not wait for its last move, so the emulator may hear of it later."""
        end_s = time.monotonic() + 20.0
        while not self.heard.endswith(b"G2206 B90.000 L118.000 R50.000 F20.0\n"):
            assert time.monotonic() < end_s, f"never parked: {self.heard[-200:]!r}"
            time.sleep(0.005)
