"""What kind of arm is emulated."""

from __future__ import annotations

from dataclasses import dataclass

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
