"""Look at everything that the real arm needs.

Examples:
  uarm-rl doctor                                      ports, arm, camera, calibration, policy
  uarm-rl doctor --port /dev/ttyACM0 camera=none      a certain port, and no camera
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from uarm_rl.commands.arm_settings import open_camera
from uarm_rl.configuration import Settings
from uarm_rl.real import session


def run(settings: Settings) -> None:
    """Look at everything that the real arm needs; exit code 1 if there is a problem."""
    findings = []
    for finding in session.examine(
        settings["port"],
        None if settings["camera"]["name"] == "none" else partial(open_camera, settings),
        Path(settings["calibration"]),
        Path(settings["policy"]),
        session.limits(settings["limits"]).max_step_rad,
    ):
        print(finding, flush=True)
        findings.append(finding)
    problems = sum(finding.state == "problem" for finding in findings)
    print(f"{problems} problem{'s' * (problems != 1)}")
    if problems:
        raise SystemExit(1)
