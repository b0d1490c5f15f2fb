"""``calibrate-camera`` and ``calibrate-hand-eye`` as commands; the fits themselves are in ``test_calibration``."""

from __future__ import annotations

import io

import numpy as np
import pytest

from tests.real.test_calibration import LENS, board_pictures, scene
from tests.real.test_run_real import Tap, run  # noqa: F401 (a fixture)
from uarm_rl.emulator.firmware import PARKED_DEG
from uarm_rl.emulator.motion import KinematicJoints
from uarm_rl.emulator.pty import PtyServer
from uarm_rl.real.collecting import append_observations, write_picture
from uarm_rl.real.vision.camera_model import Calibration, Intrinsics


def test_the_lens_then_the_mount(run, tmp_path):  # noqa: F811
    (tmp_path / "board").mkdir()
    for number, picture in enumerate(board_pictures(35.0)):
        write_picture(tmp_path / "board" / f"{number:02d}.png", picture)
    code, output, error = run("calibrate-camera", "camera=none")
    assert (code, error) == (0, "")
    assert "RMS" in output
    assert output.splitlines()[-1] == "lens.json: the lens; go on with uarm-rl calibrate-hand-eye"
    assert Intrinsics.load(tmp_path / "lens.json").camera_matrix[0, 0] == pytest.approx(LENS.camera_matrix[0, 0], rel=0.01)

    true, observations = scene(1)
    append_observations(tmp_path / "marks" / "observations.csv", observations)
    code, output, error = run("calibrate-hand-eye", "camera=none")
    assert (code, error) == (0, "")
    assert "held out" in output
    found = Calibration.load(tmp_path / "calibration.json")
    assert found.cup_from_camera[:3, 3] == pytest.approx(true.cup_from_camera[:3, 3], abs=0.004)


@pytest.mark.parametrize(
    ("words", "code", "part"),
    [
        (["calibrate-camera", "camera=none"], 1, "there is no folder board"),
        (["calibrate-camera"], 1, "no serial port has the USB id of an OpenMV camera"),
        (["calibrate-camera", "camera=none", "count=0"], 2, "count must be a whole number of at least 1"),
        (["calibrate-camera", "camera=none", "board.rows=1"], 2, "rows must be a whole number from 3 to 50"),
        (["calibrate-hand-eye"], 1, "lens.json cannot be read"),
        (["calibrate-hand-eye", "camera=none", "lens=good.json"], 1, "observations cannot be read"),
        (["calibrate-hand-eye", "lens=good.json", "camera=file", "camera.path=small.png"], 1, "is for 320 x 240"),
    ],
)
def test_what_is_missing_is_named(run, tmp_path, words, code, part):  # noqa: F811
    LENS.save(tmp_path / "good.json")
    write_picture(tmp_path / "small.png", np.zeros((120, 160, 3), np.uint8))
    before = sorted(tmp_path.rglob("*"))
    done, _, error = run(*words)
    assert (done, part in error, error.count("error: ")) == (code, True, 1), error
    assert sorted(tmp_path.rglob("*")) == before


def test_marks_are_touched_at_the_terminal(run, tmp_path, monkeypatch):  # noqa: F811
    """The arm goes home, follows a move, and nobody answering ends it with the arm parked."""
    LENS.save(tmp_path / "lens.json")
    write_picture(tmp_path / "table.png", np.full((240, 320, 3), 120, np.uint8))
    firmware = Tap(None, KinematicJoints(PARKED_DEG))
    monkeypatch.setattr("sys.stdin", io.StringIO("x 20\nz -400\n"))
    with PtyServer(firmware, speed=50.0) as server:
        words = ("camera=file", "camera.path=table.png", "--port", server.path, "--speed", 50)
        code, output, error = run("calibrate-hand-eye", *words, "feed=20")
        firmware.wait_until_parked()
    assert (code, "standard input has ended" in error) == (2, True), error
    assert "The cup is at (" in output
    assert len(firmware.moves()) == 3  # home, forward, and parked; down through the table is refused
    assert firmware.moves()[-1].startswith(b"G2206 B90.000 L118.000 R50.000")
