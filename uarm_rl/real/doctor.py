"""What the real arm needs, looked at one by one; each finding says what to do. Nothing moves.

To look at the arm its port has to be opened, which restarts the controller: the motors go limp for a moment and the arm
may sag. The camera and the calibration are examined with a picture.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from serial.tools import list_ports

from uarm_rl.real import gcode, link
from uarm_rl.real.ports import device_at
from uarm_rl.real.swift_arm import NEWEST_TESTED_FIRMWARE, OLDEST_FIRMWARE
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError

if TYPE_CHECKING:
    from uarm_rl.real.vision.camera import Camera, Picture

_BOOT_S: Final = 6.0
_OLD_DAYS: Final = 90


class Finding(NamedTuple):
    """One thing that was looked at."""

    state: Literal["ok", "warning", "problem"]
    what: str
    words: str

    def __str__(self) -> str:
        return f"{self.state:8} {self.what:12} {self.words}"


def ports(present: Iterable[Any] | None = None) -> Iterator[Finding]:
    """What is plugged in, and whether it may be opened; ``present`` as pyserial lists ports."""
    found = sorted(list_ports.comports() if present is None else present, key=lambda port: str(port.device))
    if not found:
        yield Finding("warning", "ports", "no serial port is present; plug in the USB cables of arm and camera")
    for port in found:
        device = device_at(port)
        name = device.name if device else "something else"
        if device is None or os.access(port.device, os.R_OK | os.W_OK):
            yield Finding("ok", "ports", f"{port.device} is {name}")
        else:
            yield Finding(
                "problem",
                "ports",
                f"{port.device} is {name}, and may not be opened by you; add yourself to the port's group (sudo usermod -aG "
                "dialout $USER), then log out and in again",
            )


def arm(name: str) -> Iterator[Finding]:
    """The arm at a port: what it says about itself. The only command that does anything is pump off."""
    try:
        connection = link.open_link(name)
    except ArmError as error:
        yield Finding("problem", "arm", str(error))
        return
    try:
        yield from _examine(connection)
    except ArmError as error:
        yield Finding("problem", "arm", str(error))
    finally:
        connection.close()


def _examine(connection: link.Link) -> Iterator[Finding]:
    ready = False

    def notice(event: link.Event) -> None:
        nonlocal ready
        ready = ready or (isinstance(event, gcode.Report) and event.kind in (gcode.READY, gcode.POWER))

    connection.on_event = notice
    connection.listen(_BOOT_S, until=lambda: ready)
    connection.request(gcode.PUMP_OFF, _BOOT_S)
    text = connection.request(gcode.READ_FIRMWARE).text
    version = gcode.version(text)
    if version is None or not OLDEST_FIRMWARE <= version < (5, 0, 0):
        yield Finding("problem", "firmware", f"{text or 'not given'}; V4.5.0 or later is needed: update it with uArm Studio")
        return
    new = version > NEWEST_TESTED_FIRMWARE
    yield Finding(
        "warning" if new else "ok", "firmware", f"{text}{', newer than what this driver was tested with' if new else ''}"
    )
    if connection.read_value(gcode.READ_POWER, "V") == 1:
        yield Finding("ok", "12 V", "present")
    else:
        yield Finding("problem", "12 V", "missing; plug in the power supply and press the arm's power button")
    mode = connection.read_value(gcode.READ_MODE, "V")
    if mode == 0:
        yield Finding("ok", "tool mode", "0, the suction cup")
    else:
        yield Finding("warning", "tool mode", f"{mode:g}; run-real sets it to 0, the suction cup, for good")
    base, left, right = connection.read_values(gcode.READ_ANGLES, "BLR")
    joints = kinematics.from_motor_deg(base, left, right)
    x, y, z = (1000.0 * kinematics.cup_position(joints)).tolist()
    words = f"B {base:.1f}, L {left:.1f}, R {right:.1f} degrees: the cup should be at ({x:.0f}, {y:.0f}, {z:.0f}) mm"
    legal = kinematics.within_limits(joints, tolerance_rad=math.radians(1.0))
    if legal:
        yield Finding("ok", "encoders", f"{words}; measure once whether it is")
    else:
        yield Finding(
            "warning", "encoders", f"{words}, outside the joint limits; lift the arm by hand, or calibrate its encoders"
        )


def camera(open_camera: Callable[[], Camera]) -> tuple[list[Finding], Picture | None]:
    """The camera, and a picture of it if it gives one."""
    from uarm_rl.real.vision.camera import CameraError

    try:
        with open_camera() as opened:
            picture = opened.read()
    except CameraError as error:
        return [
            Finding("problem", "camera", f"{error} (without a camera: camera=none here, --target X Y Z for run-real)")
        ], None
    height, width = picture.shape[:2]
    brightness = float(picture.mean())
    if 20.0 <= brightness <= 235.0:
        return [Finding("ok", "camera", f"{opened.name} gives pictures of {width} x {height}")], picture
    words = (
        f"{opened.name} gives pictures that are too {'dark' if brightness < 20.0 else 'bright'}; change the light or its lens"
    )
    return [Finding("warning", "camera", words)], picture


def calibration(path: Path, picture: Picture | None) -> Finding:
    """The camera's calibration: whether it is whole, how old it is, and whether it fits the picture."""
    from uarm_rl.real.vision.camera_model import Calibration, CalibrationError

    try:
        loaded = Calibration.load(path)
        if picture is not None:
            loaded.lens.check_size(picture)
    except CalibrationError as error:
        return Finding("problem", "calibration", str(error))
    words = (
        f"{path} is {loaded.age_days()} days old, for pictures of {loaded.lens.image_size[0]} x {loaded.lens.image_size[1]}, "
    )
    words += f"off by {loaded.held_out_mm:.1f} mm where that was tested"
    if loaded.age_days() > _OLD_DAYS:
        return Finding("warning", "calibration", f"{words}; calibrate again if anything was moved or refocused since")
    return Finding("ok", "calibration", words)
