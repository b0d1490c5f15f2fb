"""What kind of arm is emulated, and how far from perfect arm, mount and camera are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks
from uarm_rl.emulator.motion import MotorAngles


@dataclass(frozen=True)
class Settings:
    """The firmware's version and the arm's imperfections. The defaults are a flawless V4.10.0; V4.5.0 differs as it should.

    V3.2.0 is another firmware: see ``marlin``.
    """

    firmware: str = "V4.10.0"
    power_12v: bool = True
    tool_mode: int = 0
    encoder_offset_deg: MotorAngles = (0.0, 0.0, 0.0)  # what the encoders read beyond the truth (calibration)
    encoder_noise_deg: float = 0.0  # standard deviation of a reading, before it becomes a count
    noise_seed: int = 0
    boot_s: float = 1.0  # boot loader; 1 to 2 s are said, not measured
    latency_s: float = 0.0  # of cable and host, added to every byte sent
    false_ok: bool = True  # encoder queries in motion answer the move's ok too early, as the firmware does
    debug_prefix: bool = True  # V4.10.0 prints debug text before the reply to P2231 while the pump runs
    motors_on_at_boot: bool = True  # not documented
    tick_s: float = 1.0 / 240.0  # of the mechanics

    @property
    def version(self) -> tuple[int, ...]:
        """The numbers of ``firmware``."""
        return tuple(int(part) for part in self.firmware.removeprefix("V").split("."))

    @property
    def api(self) -> str:
        """The API version that belongs to the firmware."""
        return self.firmware if self.version < (4,) else "V4.0.5" if self.version >= (4, 10, 0) else "V4.0.4"


#: Where each kind of imperfection may be at most: a level beyond it is another arm, or a mistake.
_HIGHEST: Final = {
    "serial_latency_s": 1.0,
    "boot_s": 10.0,
    "backlash_deg": 5.0,
    "joint_offset_deg": 5.0,
    "encoder_noise_deg": 1.0,
    "grip_s": 5.0,
    "mount_offset_mm": 50.0,
    "mount_tilt_deg": 30.0,
    "snap_s": 4.0,
    "blur_px": 10.0,
    "noise": 100.0,
    "light_gradient": 1.0,
}


@dataclass(frozen=True)
class Realism:
    """The levels of ``conf/realism``, which names their sources. Errors of one arm or mount are drawn from a generator."""

    serial_latency_s: float
    boot_s: float
    backlash_deg: float
    joint_offset_deg: float
    encoder_noise_deg: float
    suction_n: float
    grip_s: float
    mount_offset_mm: float
    mount_tilt_deg: float
    snap_s: float
    jpeg_quality: int
    blur_px: float
    noise: float
    light: float
    light_gradient: float

    def __post_init__(self) -> None:
        for name, high in _HIGHEST.items():
            checks.number(f"realism.{name}", getattr(self, name), low=0.0, high=high)
        checks.number("realism.suction_n", self.suction_n, low=0.0, high=100.0, open_low=True)
        checks.number("realism.light", self.light, low=0.1, high=3.0)
        checks.integer("realism.jpeg_quality", self.jpeg_quality, low=60, high=100)

    def draw_joint_offset_deg(self, generator: np.random.Generator) -> MotorAngles:
        """What the encoders of one arm read beyond the truth."""
        b, left, right = generator.normal(0.0, 1.0, 3) * self.joint_offset_deg
        return float(b), float(left), float(right)

    def draw_mount_error(self, generator: np.random.Generator) -> NDArray[np.float64]:
        """Where one camera is, seen from where its calibration says it is, (4, 4) in metres."""
        x, y, z = np.radians(self.mount_tilt_deg) * generator.normal(0.0, 1.0, 3)
        error = np.eye(4)
        error[:3, :3] = _turn(0, x) @ _turn(1, y) @ _turn(2, z)
        error[:3, 3] = 0.001 * self.mount_offset_mm * generator.normal(0.0, 1.0, 3)
        return error


def _turn(axis: int, angle_rad: float) -> NDArray[np.float64]:
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = math.cos(angle_rad)
    matrix[second, first] = math.sin(angle_rad)
    matrix[first, second] = -matrix[second, first]
    return matrix
