"""The real uArm Swift Pro behind the ``Arm`` protocol."""

from __future__ import annotations

import enum
import logging
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import TracebackType
from typing import Final, NamedTuple

from uarm_rl import checks, signals
from uarm_rl.real import gcode
from uarm_rl.real.audit import KnownObject, Limits, audit, way
from uarm_rl.real.handshake import PUMP_S, NotReadyError, greet
from uarm_rl.real.link import BadReplyError, CommandRefusedError, Event, Link, NoReplyError
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError, JointPositions
from uarm_rl.task.obstacles import Box

log = logging.getLogger(__name__)

_FLUSH_FIRMWARE: Final = (4, 10, 0)  # before, 0x18 is a bare reset of grbl, which locks it

#: Folded onto itself (L 118, R 50 degrees): the pose from which an arm without power does not fall.
PARK_JOINTS_RAD: Final[JointPositions] = (0.0, math.radians(90.0 - 118.0), math.radians(118.0 + 50.0 - 90.0))

_STRAY_RAD: Final = math.radians(2.0)  # an encoder is a tenth of that off
_MOTION_SLACK_S: Final = 2.0  # on top of the time that a move takes by the firmware's speed law
_MOTORS_S: Final = 2.0
_PUMP_POLL_S: Final = 0.05
# The questions of the safe end, which together stay below 1 s.
_END_S: Final = 0.2
_END_LOOK_S: Final = 0.1
_END_LOOKS: Final = 3
_PUMP_UNKNOWN: Final = "the arm did not confirm that the pump is off; if it still runs, unplug the 12 V power supply"


class ResetError(ArmError):
    """The controller restarted by itself."""


class PumpError(ArmError):
    """The pump does not do what it was told."""


class PumpState(enum.IntEnum):
    """What the firmware concludes from the pump's current (P2231)."""

    STOPPED = 0
    PUMPING = 1
    HOLDING = 2  # the cup is sealed


class ArmState(NamedTuple):
    """What is known of the arm without asking it: for who looks on."""

    joints_rad: JointPositions
    reference_rad: JointPositions
    moving: bool
    pump: PumpState | None
    target_m: tuple[float, float, float] | None  # the upper surface of the object that stands in the way


class SwiftArm:
    """A uArm Swift Pro with firmware 4.5 or later and the suction cup, over a link that was just opened.

    Opening the port resets the controller: the motors go limp for a moment and the arm may sag, so let it rest folded
    or hold it. The constructor waits for the firmware to start, switches the pump off, checks 12 V, firmware and tool
    mode, and switches the motors on; nothing moves yet.

    **Time.** The firmware cannot replace a target: moves queue, and "ok" comes when the arm stands still. So
    ``command_joints`` sends one G2206, and the following ``advance`` returns at its ok, which may be many control
    periods later, and says how many: on this arm every decision lasts until steady. An ``advance`` with nothing to
    wait for lets ``1 / control_hz`` seconds pass. Joints are read at standstill only: reading the encoders in motion
    makes the firmware stumble and answer "ok" too early. An emulator may run faster than real time: ``speed`` is how
    many seconds of the arm pass in one of the program, so that control periods mean the same there.

    ``feed`` is the firmware's F: 1.333 deg/s of the norm of the motors' speeds, each. ``parks``: at the end the arm
    folds itself, so that it does not fall when it loses power.
    """

    def __init__(
        self,
        link: Link,
        *,
        limits: Limits | None = None,
        feed: float = 20.0,
        control_hz: float = 20.0,
        speed: float = 1.0,
        parks: bool = True,
    ) -> None:
        self._link = link
        self._parks = parks
        #: Name of the port.
        self.port = link.name
        self._limits = limits or Limits()
        #: Firmware version, and how many references were pulled inside a limit so far.
        self.firmware = (0, 0, 0)
        self.clamps = 0
        #: What stands in the way, and how many references were raised to spare it so far.
        self.known: KnownObject | None = None
        self.pull_ups = 0
        #: Length, width and height (m) of what hangs from the cup.
        self.carried_m: tuple[float, float, float] | None = None
        #: Who is told of every new state; what it raises is not felt here, and it must not wait.
        self.on_state: Callable[[ArmState], None] | None = None
        self._pump: PumpState | None = None  # as it was read last
        self._in_motion = False  # as far as is known
        self._awaited: int | None = None  # number of the move whose "ok" is due
        self._sent_s = 0.0  # when the last move was sent
        self._arrives_within_s = 0.0
        self._working = False  # the firmware has started, and is not expected to start again
        self._closed = False
        try:
            self._period_s = 1.0 / checks.number("control_hz", control_hz, low=1.0, high=1000.0)
            self._speed = checks.number("speed", speed, low=0.1, high=1000.0)
            top = self._limits.max_speed_deg_s / gcode.FEED_DEG_S
            self._feed = checks.number("feed", feed, low=0.1, high=top)
            link.on_event = self._notice
            self._connect()
            self._joints = self._target = self._read_encoders()
            self._working = True
        except BaseException as error:
            self._end(error)
            raise

    # Connecting

    def _connect(self) -> None:
        link = self._link
        arm = greet(link)
        self.firmware = arm.firmware
        if arm.is_new:
            log.warning("firmware V%d.%d.%d is newer than the newest that this driver knows", *arm.firmware)
        if not arm.has_power:
            raise NotReadyError("the arm has no 12 V power; plug in the power supply and press the arm's power button")
        if arm.tool_mode != 0:  # ask first: setting the mode writes the EEPROM
            link.request(gcode.SUCTION_MODE)
            if (mode := link.read_value(gcode.READ_MODE, "V")) != 0:
                raise NotReadyError(f"the arm stays in tool mode {mode:g}; mode 0 (suction cup) is needed: restart the arm")
            log.info("tool mode set to 0 (suction cup)")
        self._await_pump((PumpState.STOPPED,), "did not stop")
        link.request(gcode.MOTORS_ON, _MOTORS_S)

    def _notice(self, event: Event) -> None:
        if isinstance(event, gcode.Report) and event.kind == gcode.POWER and event.words.get("V") == "0":
            raise NotReadyError("the arm lost its 12 V power; check the power supply, then start again")
        if self._working and (isinstance(event, gcode.Boot) or event.kind == gcode.READY):
            raise ResetError(
                "the arm's controller restarted; check the power supply and let the arm cool down, then start again"
            )

    # The Arm protocol

    def home(self) -> None:
        """Go to the home pose from wherever the arm is, and wait."""
        self.wait_until_idle()
        self._link.request(gcode.MOTORS_ON, _MOTORS_S)  # reads the encoders: steps lost so far do not add up
        self.move_joints(kinematics.HOME_JOINTS_RAD.tolist())

    def move_joints(self, reference_rad: Sequence[float]) -> None:
        """Go to ``reference_rad``, however far, and wait: in a straight line of joint angles, or with an obstacle in its way
        drawn in, turned and stretched out again. Raises ``UnsafeCommandError`` before anything is sent.
        """
        self.wait_until_idle()
        self._joints = self._read_encoders()
        for joints_rad in way(reference_rad, self._joints, feed=self._feed, limits=self._bounds, known=self.known):
            self._move(joints_rad, single_step=False)
            self.wait_until_idle()

    def read_joints(self) -> JointPositions:
        """The encoders' joint1..joint3 (rad, steps of 0.0015 rad), after the arm has come to rest; takes 40 ms."""
        self.wait_until_idle()
        sent_to, self._joints = self._joints, self._read_encoders()
        off_rad = max(abs(a - b) for a, b in zip(sent_to, self._joints, strict=True))
        if off_rad > _STRAY_RAD:
            log.warning("a joint stands %.1f degrees from where it was sent: blocked, or lost steps", math.degrees(off_rad))
        self._tell()
        return self._joints

    def command_joints(self, reference_rad: Sequence[float]) -> None:
        """Start one step to ``reference_rad``, after the last one has ended.

        Raises ``UnsafeCommandError`` (see ``audit``) before anything is sent.
        """
        self.wait_until_idle()
        self._move(reference_rad, single_step=True)

    def stand_at(self, joints_rad: Sequence[float]) -> None:
        """Raises :class:`ArmError`: it takes a way to get there."""
        raise ArmError("a real arm goes to a pose on a way; it cannot begin there")

    def command_torques(self, shares: Sequence[float]) -> None:
        """Raises :class:`ArmError`: the firmware takes no torques."""
        raise ArmError("this arm's firmware takes no torques, only places to go to")

    def advance(self) -> int:
        """Wait until the arm stands still, or if it does already one control period; returns the periods that passed."""
        began_s = self._link.now_s()
        if self._in_motion:
            began_s = self._sent_s
            self.wait_until_idle()
        else:
            self.rest(self._period_s)
        return max(1, round((self._link.now_s() - began_s) * self._speed / self._period_s))

    def contact_n(self) -> float:
        """Nothing here feels it."""
        return 0.0

    def place_obstacles(self, obstacles: Sequence[Box]) -> None:
        """They stand there already, and the audit was told of them."""

    def touch_n(self) -> float:
        """Nothing here feels it; the audit keeps the arm away from obstacles."""
        return 0.0

    @property
    def at_rest(self) -> bool:
        """Whether the firmware has confirmed the last move."""
        return not self._in_motion

    def rest(self, seconds: float) -> None:
        """Let ``seconds`` of the arm's time pass, and hear what it has to say."""
        self._link.listen(seconds / self._speed)

    def time_s(self) -> float:
        """Seconds on the arm's clock, from an arbitrary start."""
        return self._link.now_s() * self._speed

    def wait_until_idle(self) -> None:
        """Wait for the "ok" of the last move."""
        if not self._in_motion:
            return
        if self._awaited is None:
            raise NoReplyError("the arm never confirmed its last move; close the connection and connect again")
        number, self._awaited = self._awaited, None
        try:
            self._link.wait(number, self._arrives_within_s)
        except CommandRefusedError:
            self._in_motion = False  # it stays where it was
            raise
        self._in_motion = False
        self._joints = self._target
        self._tell()

    def _tell(self) -> None:
        if self.on_state is None:
            return
        with suppress(Exception):
            top_m = self.known.top_m if self.known else None
            self.on_state(ArmState(self._joints, self._target, self._in_motion, self._pump, top_m))

    # The pump

    def pump_on(self) -> None:
        """Suck, after the arm has come to rest (the firmware would switch the pump in motion), and read back."""
        self.wait_until_idle()
        self._link.request(gcode.PUMP_ON, PUMP_S)
        self._await_pump((PumpState.PUMPING, PumpState.HOLDING), "did not start")

    def pump_off(self) -> None:
        """Let go, after the arm has come to rest, and read back."""
        self.wait_until_idle()
        self._link.request(gcode.PUMP_OFF, PUMP_S)
        self._await_pump((PumpState.STOPPED,), "did not stop")

    def pump_state(self) -> PumpState:
        value = self._link.read_value(gcode.READ_PUMP, "V")
        if value not in (0, 1, 2):
            raise BadReplyError(f"the arm reports pump state {value:g}; known are 0 (stopped), 1 (pumping), 2 (holding)")
        self._pump = PumpState(int(value))
        self._tell()
        return self._pump

    def _await_pump(self, wanted: tuple[PumpState, ...], what: str) -> None:
        for _ in range(round(PUMP_S / _PUMP_POLL_S)):
            if (state := self.pump_state()) in wanted:
                return
            self._link.listen(_PUMP_POLL_S)
        raise PumpError(f"the pump {what}: it reports {state.name.lower()}; check the hose, the pump and its plug")

    # Motion

    def _read_encoders(self, timeout_s: float = 1.0) -> JointPositions:
        base, left, right = self._link.read_values(gcode.READ_ANGLES, "BLR", timeout_s)
        if not (-45.0 <= base <= 225.0 and -60.0 <= left <= 190.0 and -60.0 <= right <= 190.0):
            raise BadReplyError(
                f"the encoders report B {base:g}, L {left:g}, R {right:g} degrees, which this arm cannot reach; "
                "restart the arm, and if that does not help calibrate its encoders in uArm Studio"
            )
        first, second, third = kinematics.from_motor_deg(base, left, right).tolist()
        return first, second, third

    @property
    def _bounds(self) -> Limits:
        return self._limits.carrying(self.carried_m)

    def _move(self, reference_rad: Sequence[float], *, single_step: bool) -> None:
        audited = audit(
            reference_rad, self._joints, feed=self._feed, limits=self._bounds, single_step=single_step, known=self.known
        )
        self.clamps += audited.clamped
        self.pull_ups += audited.pulled_up_m > 0.0
        speed = gcode.FEED_DEG_S * self._feed
        # An upper bound of the trapezoid's and the triangle's duration alike.
        duration_s = audited.distance_deg / speed + speed / gcode.ACCELERATION_DEG_S2
        self._arrives_within_s = 1.5 * duration_s + _MOTION_SLACK_S
        self._target = audited.joints_rad
        self._in_motion, self._awaited, self._sent_s = True, None, self._link.now_s()
        self._awaited = self._link.send(audited.command)
        self._tell()

    # The safe end

    def close(self) -> None:
        """Stop, switch the pump off, start to park if it ``parks``, give the port back, within 1 s; closing twice is fine.

        Raises ``PumpError`` if the arm does not confirm that the pump is off. Parking is not waited for: the arm
        ends its last move without the program.
        """
        self._end(None)

    def _end(self, reason: BaseException | None) -> None:
        if self._closed:
            return
        with signals.deferred():
            self._closed = True
            # A flush leaves the arm ready for another move. A feed hold, all that older firmware has, does not.
            may_park = self._parks and self._working and (not self._in_motion or self.firmware >= _FLUSH_FIRMWARE)
            try:
                confirmed = self._stop_and_release()
                if confirmed and may_park:
                    self._park()
            finally:
                self._link.close()
            if not confirmed:
                log.error("%s", _PUMP_UNKNOWN)
        if not confirmed and reason is None:
            raise PumpError(_PUMP_UNKNOWN)

    def _stop_and_release(self) -> bool:
        """Pump off, stop, pump off again; true if the arm confirms that the pump is off."""
        self._working = False  # from here on a restart is no surprise
        urgent = b"\n"  # ends a line that may have been cut short
        if self._in_motion:
            # The firmware obeys the pump in motion. A flush may drop a line that is not parsed yet: hence once more.
            urgent += gcode.encode(gcode.MAX_NUMBER, gcode.PUMP_OFF)
            urgent += gcode.FLUSH if self.firmware >= _FLUSH_FIRMWARE else gcode.FEED_HOLD
        with suppress(ArmError):
            self._link.write(urgent)
        with suppress(ArmError):  # after a feed hold the firmware holds this answer back
            self._link.request(gcode.PUMP_OFF, _END_S)
        try:
            for _ in range(_END_LOOKS):  # the firmware tells the state from a current, which takes a moment to fall
                if self._link.read_value(gcode.READ_PUMP, "V", _END_LOOK_S) == PumpState.STOPPED:
                    return True
                self._link.listen(_PUMP_POLL_S)
        except ArmError as error:
            log.warning("during the safe end: %s", error)
        return False

    def _park(self) -> None:
        try:
            self._joints = self._read_encoders(_END_S)
            self._move(PARK_JOINTS_RAD, single_step=False)
        except ArmError as error:
            log.warning("the arm is not parked: %s", error)

    def __enter__(self) -> SwiftArm:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._end(error)
