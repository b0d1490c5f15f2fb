"""What run-real tells who looks on: one way, and whatever fails there, the arm does not feel it."""

from __future__ import annotations

import json
import logging
import threading
import time

import numpy as np
import pytest

from tests.bench import Bench
from uarm_rl.commands.run_real import rehearse
from uarm_rl.real import live
from uarm_rl.real.live import LiveFile, Watched
from uarm_rl.real.swift_arm import ArmState, PumpState
from uarm_rl.task import kinematics

SIDES = (0.06, 0.03, 0.02)
STATE = ArmState((0.1, 0.2, 0.3), (0.1, 0.2, 0.4), True, PumpState.HOLDING, (0.2, 0.1, 0.03))


def test_the_newest_moment_is_read_back_and_the_end_is_told(tmp_path):
    with LiveFile(tmp_path / "real", emulated=True, object_size_m=SIDES, encode=lambda picture: bytes(picture)) as file:
        file.moved(STATE._replace(moving=False))
        file.looked(np.array([1, 2, 3], np.uint8))
        file.tried("  1 held")
        file.moved(STATE)
    last = live.read(tmp_path / "real")
    assert last.ended
    assert (last.joints_rad, last.reference_rad, last.target_m) == (STATE.joints_rad, STATE.reference_rad, STATE.target_m)
    assert (last.moving, last.pump, last.said, last.trials, last.emulated) == (True, "holding", "  1 held", 1, True)
    assert last.object_size_m == SIDES
    assert abs(last.written_s - time.time()) < 60
    assert live.read_picture(tmp_path / "real") == b"\1\2\3"
    assert {path.name for path in (tmp_path / "real").iterdir()} == {"live.json", "live.png"}


@pytest.mark.parametrize(
    "change",
    [
        {"joints_rad": [0.1, 0.2]},
        {"joints_rad": [0.1, 0.2, "x"]},
        {"reference_rad": [0.1, 0.2, float("nan")]},
        {"target_m": 3},
        {"object_size_m": [0.03, 0.03]},
        {"object_size_m": [0.03, 0.03, 0]},
        {"moving": 1},
        {"pump": "<b>"},
        {"trials": -1},
        {"said": 7},
        {"said": "x" * 501},
        {"surprise": 1},
    ],
)
def test_what_is_no_moment_is_passed_over(tmp_path, change):
    good = {"joints_rad": [0.1, 0.2, 0.3], "reference_rad": [0.1, 0.2, 0.3]}
    (tmp_path / live.LIVE).write_text(json.dumps(good))
    assert live.read(tmp_path).joints_rad == (0.1, 0.2, 0.3)
    (tmp_path / live.LIVE).write_text(json.dumps(good | change))
    assert live.read(tmp_path) is None


@pytest.mark.parametrize("text", ["", "[]", "null", "{", "[" * 10_000, "\0"])
def test_what_is_no_json_is_passed_over(tmp_path, text):
    (tmp_path / live.LIVE).write_text(text)
    assert live.read(tmp_path) is None
    assert live.read(tmp_path / "nowhere") is None


def test_a_disk_that_takes_nothing_is_a_warning_once(tmp_path, caplog):
    (tmp_path / "real").write_text("no folder")
    with caplog.at_level(logging.WARNING), LiveFile(tmp_path / "real", emulated=False, object_size_m=SIDES) as file:
        for _ in range(4):
            file.moved(STATE)
            time.sleep(0.06)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "the trials go on without" in caplog.text


def test_the_end_waits_for_no_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(live, "_END_S", 0.05)
    comes_back = threading.Event()
    hangs = LiveFile(tmp_path, emulated=False, object_size_m=SIDES, encode=lambda picture: b"x" * comes_back.wait(10.0))
    with hangs as file:
        file.looked(None)
        file.moved(STATE)
    assert hangs._thread.is_alive()
    comes_back.set()
    hangs._thread.join()


def test_the_arm_tells_its_state_and_does_not_feel_who_hears_it():
    bench, told = Bench(), []
    with bench.connect() as arm:
        arm.on_state = told.append
        arm.home()
        arm.pump_on()
        arm.command_joints(np.array(arm.read_joints()) + (0.05, 0.0, 0.0))
        assert told[-1].moving
        assert told[-1].reference_rad[0] == pytest.approx(kinematics.HOME_JOINTS_RAD[0] + 0.05, abs=0.01)
        arm.wait_until_idle()
        assert (told[-1].moving, told[-1].pump) == (False, PumpState.PUMPING)
    said = bench.lines()

    def raises(state):
        raise RuntimeError("nobody listens")

    again = Bench()
    with again.connect() as arm:
        arm.on_state = raises
        arm.home()
        arm.pump_on()
        arm.command_joints(np.array(arm.read_joints()) + (0.05, 0.0, 0.0))
        arm.wait_until_idle()
    assert again.lines() == said  # to the last command of the safe end


def test_a_rehearsal_tells_too_and_a_watched_camera_is_the_camera():
    with rehearse(lambda line: None) as arm:
        told = []
        arm.on_state = told.append
        arm.home()
        assert told

    class Camera:
        name = "a camera"
        closed = False

        def read(self):
            return "picture"

        def close(self):
            self.closed = True

    camera, pictures = Camera(), []
    with Watched(camera, pictures.append) as watched:
        assert (watched.read(), watched.name, pictures) == ("picture", "a camera", ["picture"])
    assert camera.closed
