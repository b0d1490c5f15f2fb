"""Measure the camera's lens.

Examples:
  uarm-rl calibrate-camera                            take pictures of the board, press Enter for each
  uarm-rl calibrate-camera camera=none pictures=boards pictures that are in a folder already
"""

from __future__ import annotations

from uarm_rl import checks
from uarm_rl.commands.arm_settings import ask
from uarm_rl.configuration import Settings, build
from uarm_rl.real import collecting
from uarm_rl.real.vision.lens_fit import Board


def run(settings: Settings) -> None:
    """Measure the camera's lens with pictures of a board, taken now or in a folder already."""
    board = Board(**settings["board"])
    folder, out = (checks.path(name, settings[name]) for name in ("pictures", "out"))
    count = checks.integer("count", settings["count"], low=1)
    with build("camera", settings["camera"]) as camera:
        if camera is not None:
            collecting.collect_board_pictures(camera, board, folder, ask, count)
    intrinsics, report = collecting.calibrate_intrinsics_from_folder(folder, board, settings["camera"]["name"])
    intrinsics.save(out)
    print(f"{report}\n{out}: the lens; go on with uarm-rl calibrate-hand-eye")
