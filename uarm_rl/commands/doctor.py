"""Look at everything that the real arm needs.

Examples:
  uarm-rl doctor                                      ports, arm, camera, calibration, policy
  uarm-rl doctor --port /dev/ttyACM0 camera=none      a certain port, and no camera
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from uarm_rl import checks
from uarm_rl.checks import UsageError
from uarm_rl.commands.arm_settings import check_policy, limits, load_policy, open_camera
from uarm_rl.configuration import Settings
from uarm_rl.real import doctor
from uarm_rl.real.doctor import Finding
from uarm_rl.real.ports import ARM, PortError, is_emulated, named_port
from uarm_rl.task.policy import PolicyFileError


def run(settings: Settings) -> None:
    """Look at everything that the real arm needs; exit code 1 if there is a problem."""
    problems = 0
    for finding in _examine(settings):
        print(finding, flush=True)
        problems += finding.state == "problem"
    print(f"{problems} problem{'s' * (problems != 1)}")
    if problems:
        raise SystemExit(1)


def _examine(settings: Settings) -> Iterator[Finding]:
    """Findings as they are made: ports, arm, camera, calibration, policy."""
    max_step_rad = limits(settings["limits"]).max_step_rad
    calibration, policy = checks.path("calibration", settings["calibration"]), settings["policy"]
    yield from doctor.ports()
    name = None
    try:
        name = named_port(ARM, settings["port"])
    except PortError as error:
        yield Finding("problem", "arm", str(error))
    else:
        yield Finding("note", "arm", f"opening {name}, which restarts the controller: the arm may sag for a moment")
        yield from doctor.arm(name)
    if settings["camera"]["name"] == "none":
        yield Finding("note", "camera", "none wanted: run-real needs --target X Y Z")
    else:
        findings, picture = doctor.camera(partial(open_camera, settings))
        yield from findings
        if name is not None and is_emulated(name) and not calibration.exists():
            yield Finding("warning", "calibration", f"there is no {calibration}; an emulated camera is taken to be as drawn")
        else:
            yield doctor.calibration(calibration, picture)
    try:
        card = load_policy(policy).card
        warnings = check_policy(card, max_step_rad)
    except (PolicyFileError, UsageError) as error:
        yield Finding("problem", "policy", str(error))
    else:
        yield Finding("ok", "policy", f"{policy}, {card.episodes} episodes of training")
        yield from (Finding("warning", "policy", warning) for warning in warnings)
