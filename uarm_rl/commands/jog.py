"""Move one joint of the real arm by a few degrees.

Examples:
  uarm-rl jog --joint 1 --degrees 5                   turn the base by 5 degrees and tell which way is right
  uarm-rl jog joint=2 degrees=-5 port=/dev/ttyACM0    the same notation as everywhere
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from uarm_rl import checks, signals
from uarm_rl.commands.arm_settings import motion
from uarm_rl.configuration import Settings
from uarm_rl.real import session
from uarm_rl.task import kinematics

_MOST_DEG: Final = 10.0
_STRAY_DEG: Final = 0.5

#: What a joint does when its angle grows (degrees up), and when it falls.
_SIGNS: Final = {
    1: ("the arm turned to its left (counter-clockwise, seen from above)", "the arm turned to its right"),
    2: ("the lower arm leaned forward and the cup sank", "the lower arm leaned back and the cup rose"),
    3: ("the forearm and the cup sank", "the forearm and the cup rose"),
}


def run(settings: Settings) -> None:
    """Move one joint of the real arm by some degrees, and tell what happened."""
    joint = checks.integer("joint", settings["joint"], low=1, high=3)
    degrees = checks.number("degrees", settings["degrees"], low=-_MOST_DEG, high=_MOST_DEG)
    how = motion(settings)
    with signals.interrupt_once(), session.connect(settings["port"], parks=False, **how) as arm:  # parking moves far
        before = arm.read_joints()
        wanted = _inside(before)
        wanted[joint - 1] = before[joint - 1] + math.radians(degrees)
        arm.move_joints(wanted)
        after = arm.read_joints()
    moved = [math.degrees(b - a) for a, b in zip(before, after, strict=True)]
    up, down = _SIGNS[joint]
    print(
        f"joint{joint}: {math.degrees(before[joint - 1]):.2f} degrees before, {math.degrees(after[joint - 1]):.2f} after: "
        f"moved by {moved[joint - 1]:+.2f} of {degrees:+.2f}\n"
        f"right if {up if degrees > 0 else down}; if not, do not run the arm: its motors or encoders are mixed up"
    )
    moved[joint - 1] -= degrees
    if max(map(abs, moved)) > _STRAY_DEG:
        print("warning: the joints are not where they were sent; is something in the way, or are steps lost?")


def _inside(joints: Sequence[float]) -> list[float]:
    """The joints (rad), inside their limits if they are beyond them by a hair, as one with play reads at its stop."""
    inside = kinematics.clip_to_limits(*joints)
    beyond = max(abs(a - b) for a, b in zip(inside, joints, strict=True))
    return list(inside if beyond <= math.radians(_STRAY_DEG) else joints)
