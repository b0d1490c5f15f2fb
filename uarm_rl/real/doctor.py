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
from uarm_rl.real.handshake import NotReadyError, greet
from uarm_rl.real.ports import device_at
from uarm_rl.task import kinematics
from uarm_rl.task.arm import ArmError

if TYPE_CHECKING:
    from uarm_rl.real.vision.camera import Camera, Picture

_OLD_DAYS: Final = 90


class Finding(NamedTuple):
    """One thing that was looked at."""

    state: Literal["ok", "note", "warning", "problem"]
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
            yield Finding("ok" if device else "note", "ports", f"{port.device} is {name}")
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
    try:
        found = greet(connection)
    except NotReadyError as error:
        yield Finding("problem", "firmware", str(error))
        return
    version = "V{}.{}.{}".format(*found.firmware)
    if found.is_new:
        yield Finding("warning", "firmware", f"{version}, newer than what this driver was tested with")
    else:
        yield Finding("ok", "firmware", version)
    if found.has_power:
        yield Finding("ok", "12 V", "present")
    else:
        yield Finding("problem", "12 V", "missing; plug in the power supply and press the arm's power button")
    if found.tool_mode == 0:
        yield Finding("ok", "tool mode", "0, the suction cup")
    else:
        yield Finding("warning", "tool mode", f"{found.tool_mode:g}; run-real sets it to 0, the suction cup, for good")
    base, left, right = connection.read_values(gcode.READ_ANGLES, "BLR")
    joints = kinematics.from_motor_deg(base, left, right)
    x, y, z = (1000.0 * kinematics.cup_position(joints)).tolist()
    words = f"B {base:.1f}, L {left:.1f}, R {right:.1f} degrees: the cup should be at ({x:.0f}, {y:.0f}, {z:.0f}) mm"
    if kinematics.within_limits(joints, tolerance_rad=math.radians(1.0)):
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
    width, height = loaded.lens.image_size
    words = f"{path} is {loaded.age_days()} days old, for pictures of {width} x {height}, "
    words += f"off by {loaded.held_out_mm:.1f} mm where that was tested"
    if loaded.age_days() > _OLD_DAYS:
        return Finding("warning", "calibration", f"{words}; calibrate again if anything was moved or refocused since")
    return Finding("ok", "calibration", words)
