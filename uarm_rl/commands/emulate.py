"""A stand-in for arm and camera on two pseudo-terminals.

Examples:
  uarm-rl emulate --speed 20                          prints the ports of arm and camera, runs until Ctrl-C
  uarm-rl run-real --port PATH --out mine             the trials against it, in another terminal
"""

from __future__ import annotations

from uarm_rl.configuration import Settings
from uarm_rl.emulator.emulate import emulate


def run(settings: Settings) -> None:
    """Emulate the arm and the camera on two pseudo-terminals until Ctrl-C."""
    emulate(**{key: value for key, value in settings.items() if key != "results_dir"})
