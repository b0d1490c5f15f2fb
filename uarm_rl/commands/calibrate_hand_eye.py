"""Measure where the camera sits on the arm.

Examples:
  uarm-rl calibrate-hand-eye                          touch marks with the cup and look at them from above
  uarm-rl calibrate-hand-eye camera=none observations=seen.csv what was touched and seen already
"""

from __future__ import annotations

from contextlib import ExitStack

from uarm_rl import checks, signals
from uarm_rl.commands.arm_settings import ask, motion, open_camera
from uarm_rl.configuration import Settings, build
from uarm_rl.real import collecting, session
from uarm_rl.real.vision.camera_model import Intrinsics, nominal
from uarm_rl.real.vision.hand_eye_fit import calibrate_hand_eye


def run(settings: Settings) -> None:
    """Measure where the camera sits on the arm with touched marks, touched now or in a file already."""
    detector = build("detector", settings["detector"])
    path, out, lens_file = (checks.path(name, settings[name]) for name in ("observations", "out", "lens"))
    how = motion(settings)
    lens = Intrinsics.load(lens_file)
    with ExitStack() as stack:
        camera = stack.enter_context(open_camera(settings))
        if camera is not None:
            stack.enter_context(signals.interrupt_once())
            lens.check_size(camera.read())
            arm = stack.enter_context(session.connect(settings["port"], **how))
            arm.home()
            collecting.collect_observations(arm, camera, detector, nominal(lens.image_size), path, ask)
    calibration, report = calibrate_hand_eye(collecting.read_observations(path, lens, detector), lens)
    calibration.save(out)
    print(f"{report}\n{out}: lens and mount, what run-real needs")
