"""How the simulated joints respond to a command: three models behind one small interface, and motors without a controller.

A servo answers, before every physics step, with the joint velocities that its controller asks of the motors; the
motors, with limited torque, then meet gravity and contact in the engine. Joints are joint1..joint3, radians, rad/s.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple, Protocol

from uarm_rl import checks
from uarm_rl.sim.trapezoid import Trapezoid, trapezoid
from uarm_rl.task.arm import JointPositions

RAD_PER_DEG = math.pi / 180.0


class Servo(Protocol):
    """What the simulated arm asks of a servo model."""

    def reset(self, joints: JointPositions) -> None:
        """At rest at ``joints``, with nothing commanded."""
        ...

    def command(self, reference: JointPositions, joints: JointPositions) -> None:
        """Accept a new reference while the joints are at ``joints``."""
        ...

    def velocity(self, joints: JointPositions, velocity: JointPositions, dt: float) -> JointPositions:
        """Velocities to drive the joints with over the next ``dt`` seconds."""
        ...


def rise_time_s(servo: Servo, *, step_rad: float = 0.15, dt: float = 0.001) -> float:
    """How long a commanded step of joint1 takes from 10 % to 90 %, for joints that follow the servo exactly.

    Raises :class:`ValueError` if that is more than a minute.
    """
    joints: JointPositions = (0.0, 0.0, 0.0)
    velocity = joints
    servo.reset(joints)
    servo.command((step_rad, 0.0, 0.0), joints)
    begun = 0
    for step in range(round(60.0 / dt)):
        velocity = servo.velocity(joints, velocity, dt)
        joints = joints[0] + velocity[0] * dt, 0.0, 0.0
        if joints[0] < 0.1 * step_rad:
            begun = step + 1
        elif joints[0] >= 0.9 * step_rad:
            return (step - begun) * dt
    raise ValueError(f"the servo takes more than a minute for {step_rad:g} rad; choose a faster one")


class SecondOrder:
    """A position controller that answers like a damped oscillator: PID joints, as in the paper's Gazebo model.

    ``x'' = w^2 (reference - x) - 2 d w x'``, integrated semi-implicitly at the physics rate. A new reference replaces
    the old one at once.
    """

    def __init__(self, *, natural_frequency_rad_s: float, damping: float, speed_limit_rad_s: float) -> None:
        frequency = checks.number("servo.natural_frequency_rad_s", natural_frequency_rad_s, low=0.0, high=50.0, open_low=True)
        self._stiffness = frequency**2
        self._damping = 2.0 * checks.number("servo.damping", damping, low=0.0, high=2.0, open_low=True) * frequency
        self._limit = checks.number("servo.speed_limit_rad_s", speed_limit_rad_s, low=0.0, open_low=True)
        self._reference: JointPositions = (0.0, 0.0, 0.0)

    def reset(self, joints: JointPositions) -> None:
        self._reference = joints

    def command(self, reference: JointPositions, joints: JointPositions) -> None:
        self._reference = reference

    def velocity(self, joints: JointPositions, velocity: JointPositions, dt: float) -> JointPositions:
        r1, r2, r3 = self._reference
        q1, q2, q3 = joints
        v1, v2, v3 = velocity
        stiffness, damping, limit = self._stiffness * dt, self._damping * dt, self._limit
        v1 += stiffness * (r1 - q1) - damping * v1
        v2 += stiffness * (r2 - q2) - damping * v2
        v3 += stiffness * (r3 - q3) - damping * v3
        if -limit <= v1 <= limit and -limit <= v2 <= limit and -limit <= v3 <= limit:  # as nearly always
            return v1, v2, v3
        return max(-limit, min(limit, v1)), max(-limit, min(limit, v2)), max(-limit, min(limit, v3))


class Instant:
    """Reaches every reference within one control step: where waiting for a steady state must stop to matter."""

    def __init__(self, *, reach_time_s: float) -> None:
        self._reach_time_s = checks.number("servo.reach_time_s", reach_time_s, low=0.0, open_low=True)
        self._reference: JointPositions = (0.0, 0.0, 0.0)
        self._left_s = 0.0

    def reset(self, joints: JointPositions) -> None:
        self._reference, self._left_s = joints, 0.0

    def command(self, reference: JointPositions, joints: JointPositions) -> None:
        self._reference, self._left_s = reference, self._reach_time_s

    def velocity(self, joints: JointPositions, velocity: JointPositions, dt: float) -> JointPositions:
        left_s = max(self._left_s, dt)
        self._left_s = left_s - dt
        (r1, r2, r3), (q1, q2, q3) = self._reference, joints
        return (r1 - q1) / left_s, (r2 - q2) / left_s, (r3 - q3) / left_s


#: What F is worth, 4/3 deg/s, rounded as in the published runs.
_FEED_DEG_S: Final = 1.333


class _Move(NamedTuple):
    """A straight line in joint space."""

    start: JointPositions
    end: JointPositions
    profile: Trapezoid

    def position(self, time_s: float) -> JointPositions:
        share = self.profile.share(time_s)
        if share >= 1.0:
            return self.end
        (s1, s2, s3), (e1, e2, e3) = self.start, self.end
        return s1 + share * (e1 - s1), s2 + share * (e2 - s2), s3 + share * (e3 - s3)


class Stepper:
    """What the arm's own firmware (V4) does: coordinated trapezoids, a dead time, and moves that queue.

    The speed of the motor angles (dL, dR, dB), as a Euclidean norm, is ``1.333 feed`` deg/s; the fastest motor
    accelerates with ``acceleration_deg_s2``; the first step pulse comes ``dead_time_s`` after the command. There is
    no preemption: with ``queue`` a move starts when the one before has ended (the firmware holds 18 blocks in its
    planner and 20 packets before it, further ones are lost). Without ``queue`` a command stops the arm and replaces
    the target. Consecutive queued moves stop between each other; the firmware would blend them.
    """

    _CAPACITY = 38

    def __init__(self, *, feed: float, acceleration_deg_s2: float, dead_time_s: float, queue: bool) -> None:
        self._speed = _FEED_DEG_S * checks.number("servo.feed", feed, low=0.0, high=250.0, open_low=True)
        self._acceleration = checks.number("servo.acceleration_deg_s2", acceleration_deg_s2, low=0.0, open_low=True)
        self._dead_time_s = checks.number("servo.dead_time_s", dead_time_s, low=0.0, high=1.0)
        self._queues = checks.boolean("servo.queue", queue)
        self._moves: deque[_Move] = deque()
        self._planned: JointPositions = (0.0, 0.0, 0.0)  # where the last planned move ends
        self._now_s = 0.0

    def reset(self, joints: JointPositions) -> None:
        self._moves.clear()
        self._planned, self._now_s = joints, 0.0

    def command(self, reference: JointPositions, joints: JointPositions) -> None:
        begins_s = self._now_s + self._dead_time_s
        if not self._queues:
            self._moves.clear()
            self._planned = joints
        elif self._moves:
            begins_s = max(begins_s, self._moves[-1].profile.ends_s)
        if len(self._moves) < self._CAPACITY:
            self._moves.append(self._plan(self._planned, reference, begins_s))
            self._planned = reference

    def _plan(self, start: JointPositions, end: JointPositions, begins_s: float) -> _Move:
        d1, d2, d3 = ((b - a) / RAD_PER_DEG for a, b in zip(start, end, strict=True))
        motors = (d1, d2, d2 + d3)  # |dB|, |dL|, |dR|
        distance = math.hypot(*motors)
        if distance == 0.0:
            return _Move(start, end, Trapezoid(begins_s, 0.0, 0.0))
        acceleration = self._acceleration * distance / max(abs(d) for d in motors)
        return _Move(start, end, trapezoid(begins_s, distance, self._speed, acceleration))

    def velocity(self, joints: JointPositions, velocity: JointPositions, dt: float) -> JointPositions:
        self._now_s += dt
        while len(self._moves) > 1 and self._moves[0].profile.ends_s <= self._now_s:
            self._moves.popleft()
        p1, p2, p3 = self._moves[0].position(self._now_s) if self._moves else self._planned
        if self._moves and self._moves[0].profile.ends_s <= self._now_s:
            self._moves.popleft()
        q1, q2, q3 = joints
        return (p1 - q1) / dt, (p2 - q2) / dt, (p3 - q3) / dt


class Torque:
    """No controller: a command is a torque for each joint, as a share of ``torque_nm``, and acts until the next one.

    A motor that stands gives what it is told, one that turns less, in a straight line down to nothing at
    ``no_load_speed_rad_s``: what it is told of its whole torque is the share of that speed at which it ends up, where nothing
    else acts. With ``gravity_compensation`` it holds the arm's weight besides. It never has more than ``torque_nm``.
    """

    def __init__(self, *, torque_nm: float, no_load_speed_rad_s: float, gravity_compensation: bool) -> None:
        self._torque_nm = checks.number("servo.torque_nm", torque_nm, low=0.0, high=100.0, open_low=True)
        speed = checks.number("servo.no_load_speed_rad_s", no_load_speed_rad_s, low=0.0, high=100.0, open_low=True)
        self._braking = self._torque_nm / speed
        self.gravity_compensation = checks.boolean("servo.gravity_compensation", gravity_compensation)
        self._told = (0.0, 0.0, 0.0)

    def reset(self, joints: JointPositions) -> None:
        """With nothing told."""
        self._told = (0.0, 0.0, 0.0)

    def command(self, shares: JointPositions, joints: JointPositions) -> None:
        """Accept new torques, each as a share of ``torque_nm`` from -1 to 1."""
        one, two, three = shares
        self._told = self._torque_nm * one, self._torque_nm * two, self._torque_nm * three

    def torques_nm(self, velocity: JointPositions, held_nm: JointPositions) -> JointPositions:
        """What the motors give at these velocities (rad/s); ``held_nm``: what holds the arm's weight, or nothing."""
        (t1, t2, t3), (v1, v2, v3), (h1, h2, h3), most = self._told, velocity, held_nm, self._torque_nm
        t1, t2, t3 = t1 - self._braking * v1 + h1, t2 - self._braking * v2 + h2, t3 - self._braking * v3 + h3
        return max(-most, min(most, t1)), max(-most, min(most, t2)), max(-most, min(most, t3))
