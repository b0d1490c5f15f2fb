"""Move one joint of the real arm by a few degrees.

Examples:
  uarm-rl jog --joint 1 --degrees 5                   turn the base by 5 degrees and tell which way is right
  uarm-rl jog joint=2 degrees=-5 port=/dev/ttyACM0    the same notation as everywhere
"""

from __future__ import annotations

from uarm_rl.configuration import Settings
from uarm_rl.real import session


def run(settings: Settings) -> None:
    """Move one joint of the real arm by a few degrees."""
    arm_settings = {"limits": session.limits(settings["limits"]), "feed": settings["feed"], "speed": settings["speed"]}
    print("\n".join(session.jog(settings["port"], settings["joint"], settings["degrees"], **arm_settings)))
