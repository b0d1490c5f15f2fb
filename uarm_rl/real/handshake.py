"""The first words with an arm, the driver's and the doctor's: pump off, then what it is. Nothing moves."""

from __future__ import annotations

import logging
from typing import Final, NamedTuple

from uarm_rl.real import gcode
from uarm_rl.real.link import Link
from uarm_rl.task.arm import ArmError

log = logging.getLogger(__name__)

OLDEST_FIRMWARE: Final = (4, 5, 0)  # the first with G2206
NEWEST_TESTED_FIRMWARE: Final = (4, 10, 0)
PUMP_S: Final = 2.0  # boards of hardware 3.3.0 pulse the valve for 1 s and answer nothing meanwhile
_BOOT_S: Final = 6.0  # boot loader 1 to 2 s; firmware 3.2 is silent for another 2.5 s


class NotReadyError(ArmError):
    """The arm answers but cannot work: no 12 V, a foreign firmware, the wrong tool mode."""


class Greeting(NamedTuple):
    """What an arm says of itself."""

    firmware: tuple[int, int, int]
    has_power: bool  # 12 V
    tool_mode: float  # 0: the suction cup

    @property
    def is_new(self) -> bool:
        """Whether nobody has tried this firmware with the driver."""
        return self.firmware > NEWEST_TESTED_FIRMWARE


def greet(link: Link) -> Greeting:
    """Wait until the firmware has started, switch the pump off, and ask.

    Raises :class:`NotReadyError` for a firmware that cannot do the work, and what the link raises.
    """
    if not link.listen(_BOOT_S, until=lambda: link.started):
        log.warning("%s: no ready banner; either the arm was running already or this is not its port", link.name)
    link.request(gcode.PUMP_OFF, PUMP_S if link.started else _BOOT_S)  # a running arm may be in the middle of a move
    text = link.request(gcode.READ_FIRMWARE).text
    firmware = gcode.version(text)
    if firmware is None or not OLDEST_FIRMWARE <= firmware < (5, 0, 0):
        raise NotReadyError(
            f"the arm runs firmware {text or '(no version given)'}; this driver needs V4.5.0 or later of the V4 "
            "family, because 3.2 has no command for all three motors and says ok before a move has ended; update "
            "it with UFACTORY's uArm Studio"
        )
    return Greeting(firmware, link.read_value(gcode.READ_POWER, "V") == 1, link.read_value(gcode.READ_MODE, "V"))
