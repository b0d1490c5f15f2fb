"""Serial ports: which one is the arm's, which one the camera's, and why one does not open."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterable
from typing import Any, Final, NamedTuple, Protocol

import serial
from serial.tools import list_ports

from uarm_rl import checks
from uarm_rl.task.arm import ArmError

try:
    from termios import error as termios_error
except ImportError:  # Windows has none
    termios_error = OSError  # type: ignore[misc, assignment]

#: What a vanished device raises, depending on the call and on how it vanished.
BROKEN: Final = (serial.SerialException, OSError, termios_error)
#: The rate of the arm's board. The OpenMV takes any but 921600 and 12000000, which switch it to the protocol of its IDE.
BAUD: Final = 115200
READ_S: Final = 0.02  # how long a read waits


class PortError(ArmError):
    """No port, several, or one that cannot be opened."""


class Port(Protocol):
    """What is needed of ``serial.Serial``: ``read`` returns after a short while, with fewer bytes or none."""

    @property
    def in_waiting(self) -> int: ...

    def read(self, size: int = 1) -> bytes: ...

    def write(self, data: bytes) -> int | None: ...

    def close(self) -> None: ...


class Device(NamedTuple):
    """A kind of device: its USB ids, and what its user is told. ``vendors`` make no other device with a port like it."""

    name: str
    ids: frozenset[tuple[int, int]]
    vendors: frozenset[int]
    plug_in: str
    name_it: str
    rivals: str  # programs that may hold its port


ARM: Final = Device(
    "the uArm",
    frozenset({(0x2341, 0x0042)}),  # the Arduino Mega 2560's bridge on the arm's board
    frozenset(),  # Arduino's boards are many things, cameras among them
    "plug in the USB cable and the power supply",
    "name the arm's port with --port",
    "uArm Studio, a serial monitor",
)
CAMERA: Final = Device(
    "an OpenMV camera",
    # All boards before firmware 5; then M4, M7, H7, Pure Thermal, H7 Plus, RT1062, N6, AE3. From OpenMV's board configurations.
    frozenset(
        {(0x1209, 0xABD1)} | {(0x37C5, product) for product in (0x1202, 0x1203, 0x1204, 0x1205, 0x124A, 0x1060, 0x1206, 0x16E3)}
    ),
    frozenset({0x1209, 0x37C5}),
    "plug in the camera and wait 6 s",
    "name the camera's port with camera.port=PORT",
    "OpenMV IDE",
)


def device_at(port: Any) -> Device | None:
    """The kind of device at a port of pyserial's list, by its USB id; ``None`` for another."""
    return next((device for device in (ARM, CAMERA) if (port.vid, port.pid) in device.ids), None)


def find_port(device: Device, ports: Iterable[Any] | None = None) -> str:
    """The name of the one port with such a device; ``ports`` as pyserial lists them. Raises :class:`PortError`."""
    present = list(list_ports.comports() if ports is None else ports)
    found = sorted(str(port.device) for port in present if device_at(port) is device)
    if len(found) == 1:
        return found[0]
    if found:
        raise PortError(f"several ports have the USB id of {device.name}: {', '.join(found)}; {device.name_it}")
    others = ", ".join(sorted(str(port.device) for port in present)) or "none"
    raise PortError(
        f"no serial port has the USB id of {device.name}; {device.plug_in}, or {device.name_it} (serial ports present: "
        f"{others})"
    )


def named_port(device: Device, name: str | None) -> str:
    """``name``, or that of the one port with such a device. Raises :class:`PortError` if there is none, and opens nothing."""
    if name is None:
        return find_port(device)
    checks.text("port", name)
    if name.startswith("/") and not os.path.exists(name):
        raise PortError(_missing(device, name))
    return name


#: The file beside an emulated arm's port that says how fast the emulator runs.
SPEED: Final = "speed"
#: Pseudo-terminals, of Linux and of macOS.
_PTY: Final = re.compile(r"/dev/(?:pts/\d+|ttys\d{3})")


def is_emulated(name: str) -> bool:
    """Whether a port is a pseudo-terminal: then no real arm is behind it."""
    return os.path.exists(name) and _PTY.fullmatch(os.path.realpath(name)) is not None


def camera_beside(name: str) -> str | None:
    """The port of the emulated camera that lies beside an emulated arm's; ``None`` for others (see ``emulator.emulate``)."""
    path = os.path.join(os.path.dirname(name), "camera")
    return path if is_emulated(name) and is_emulated(path) else None


def emulated_speed(name: str) -> float | None:
    """How many times as fast as real the emulator runs whose arm is at a port; ``None`` if nothing says so."""
    try:
        with open(os.path.join(os.path.dirname(name), SPEED), encoding="ascii") as file:
            return float(file.read()) if is_emulated(name) else None
    except (OSError, ValueError):
        return None


def open_port(device: Device, name: str, *, write_timeout_s: float) -> Port:
    """Open the device's port for this process alone. Raises :class:`PortError`.

    A port of the other device is refused before it is opened: opening the arm's restarts the arm.
    """
    other = CAMERA if device is ARM else ARM
    for port in list_ports.comports():
        if port.device == os.path.realpath(name) and (device_at(port) is other or port.vid in other.vendors):
            raise PortError(f"{name} is the port of {other.name}, not of {device.name}; {device.name_it}")
    try:
        # Opening raises DTR: without it an OpenMV believes that nobody listens.
        opened: Port = serial.Serial(name, BAUD, timeout=READ_S, write_timeout=write_timeout_s, exclusive=True)
    except (*BROKEN, ValueError) as error:
        raise PortError(_why_not_open(device, name, error)) from error
    return opened


def _why_not_open(device: Device, name: str, error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code == errno.EACCES:
        return (
            f"no permission to open {name}, the port of {device.name}; add yourself to the port's group (sudo usermod -aG "
            "dialout $USER), then log out and in again"
        )
    if code in (errno.EBUSY, errno.EAGAIN):
        return (
            f"{name}, the port of {device.name}, is in use by another program; close it ({device.rivals}, another run) and "
            "try again"
        )
    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return _missing(device, name)
    return f"{name} cannot be opened as the port of {device.name} ({error}); {device.name_it}"


def _missing(device: Device, name: str) -> str:
    return f"there is no port {name}; {device.plug_in}, or leave the port out to find {device.name} by its USB id"
