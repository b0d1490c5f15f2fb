"""The doctor: every finding says what is wrong and what to do, and looking at the arm moves nothing."""

from __future__ import annotations

import datetime
import re
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.bench import Tap
from tests.real.test_run_real import policy_file, run  # noqa: F401 (a fixture)
from uarm_rl.emulator.faults import Fault
from uarm_rl.emulator.firmware import PARKED_DEG
from uarm_rl.emulator.firmware_3_2 import MarlinFirmware
from uarm_rl.emulator.motion import KinematicJoints
from uarm_rl.emulator.pty import PtyServer
from uarm_rl.emulator.realism import Settings
from uarm_rl.real import doctor
from uarm_rl.real.vision.camera import CameraError
from uarm_rl.real.vision.camera_model import nominal


def listed(device, vid=None, pid=None):
    return SimpleNamespace(device=str(device), vid=vid, pid=pid)


def findings_of(firmware):
    with PtyServer(firmware, speed=50.0) as server:
        return list(doctor.arm(server.path))


def firmware(settings=None, kind=Tap, **keywords):
    return kind(settings, KinematicJoints(PARKED_DEG), **keywords)


def test_what_is_plugged_in(tmp_path):
    arm, camera, other = (tmp_path / name for name in ("ttyACM0", "ttyACM1", "ttyS0"))
    for path in (arm, camera, other):
        path.touch()
    ports = [listed(other), listed(arm, 0x2341, 0x0042), listed(camera, 0x37C5, 0x1204)]
    assert [str(finding) for finding in doctor.ports(ports)] == [
        f"ok       ports        {arm} is the uArm",
        f"ok       ports        {camera} is an OpenMV camera",
        f"note     ports        {other} is something else",
    ]
    (none,) = doctor.ports([])
    assert (none.state, "plug in the USB cables" in none.words) == ("warning", True)


def test_a_port_without_permission(monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)
    (finding,) = doctor.ports([listed("/dev/ttyACM0", 0x2341, 0x0042)])
    assert (finding.state, "usermod -aG dialout" in finding.words) == ("problem", True)
    (other,) = doctor.ports([listed("/dev/ttyS0")])
    assert other.state == "note"


def test_a_healthy_arm_is_not_moved():
    emulated = firmware()
    findings = findings_of(emulated)
    assert [(finding.state, finding.what) for finding in findings] == [
        ("ok", "firmware"),
        ("ok", "12 V"),
        ("ok", "tool mode"),
        ("ok", "encoders"),
    ]
    assert "the cup should be at (105, 0, 37) mm" in findings[-1].words
    sent = [line.split(" ", 1)[1] for line in emulated.heard.decode().splitlines()]
    assert sent == ["M2231 V0", "P2203", "P2234", "P2400", "P2200"]


@pytest.mark.parametrize(
    ("emulated", "state", "what", "words"),
    [
        (firmware(Settings(power_12v=False)), "problem", "12 V", "plug in the power supply"),
        (firmware(Settings(firmware="V4.4.0")), "problem", "firmware", "V4.4.0; this driver needs V4.5.0"),
        (
            firmware(Settings(firmware="V3.2.0"), MarlinFirmware),
            "problem",
            "firmware",
            "V3.2.0; this driver needs V4.5.0",
        ),
        (firmware(Settings(firmware="V4.11.0")), "warning", "firmware", "newer than"),
        (firmware(Settings(tool_mode=3)), "warning", "tool mode", "3; run-real sets it to 0"),
        (firmware(Settings(encoder_offset_deg=(0.0, 40.0, 0.0))), "warning", "encoders", "outside the joint limits"),
        (firmware(faults=(Fault("error", "P2200", data=b"ok"),)), "problem", "arm", "check the cable"),
        (firmware(faults=(Fault("unplug", "P2234"),)), "problem", "arm", "check the USB cable"),
    ],
)
def test_an_arm_with_a_problem(emulated, state, what, words):
    finding = next(finding for finding in findings_of(emulated) if finding.state != "ok")
    assert (finding.state, finding.what) == (state, what)
    assert words in finding.words


def test_a_port_that_does_not_open():
    (finding,) = doctor.arm("/dev/nowhere")
    assert (finding.state, "there is no port" in finding.words) == ("problem", True)


class Pictures:
    name = "a camera"

    def __init__(self, grey):
        self.grey = grey

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def read(self):
        if self.grey is None:
            raise CameraError("a camera gives no picture; check the cable, then start again")
        return np.full((240, 320, 3), self.grey, np.uint8)


@pytest.mark.parametrize(
    ("grey", "state", "words"),
    [(120, "ok", "320 x 240"), (3, "warning", "too dark"), (252, "warning", "too bright"), (None, "problem", "camera=none")],
)
def test_the_camera(grey, state, words):
    (finding,), picture = doctor.camera(lambda: Pictures(grey))
    assert (finding.state, words in finding.words, picture is None) == (state, True, grey is None)


def test_the_calibration(tmp_path):
    path, picture = tmp_path / "calibration.json", np.zeros((240, 320, 3), np.uint8)
    assert doctor.calibration(path, picture).state == "problem"
    nominal().save(path)
    text = path.read_text()
    finding = doctor.calibration(path, picture)
    assert (finding.state, "days old" in finding.words) == ("warning", True)
    today = datetime.date.today().isoformat()
    path.write_text(re.sub(r"\d{4}-\d\d-\d\d", today, text))
    assert doctor.calibration(path, picture).state == "ok"
    finding = doctor.calibration(path, picture[:120])
    assert (finding.state, "320 x 120" in finding.words) == ("problem", True)
    path.write_text(text[:-20])
    assert "damaged" in doctor.calibration(path, picture).words


def test_the_command(run, tmp_path):  # noqa: F811
    """Exit code 1 and what to do about each problem; 0 when all is well."""
    code, output, error = run("doctor")
    assert (code, error) == (1, "")
    for words in ("USB id of the uArm", "OpenMV", "calibration.json cannot be read"):
        assert words in output
    assert output.splitlines()[-1] == "3 problems"
    assert re.search(r"ok +policy +default, 1500 episodes", output)
    _, output, _ = run("doctor", "policy=away")
    assert re.search(r"problem +policy +there is no policy away", output)
    policy_file(tmp_path / "run" / "policy.safetensors")
    nominal().save(tmp_path / "calibration.json")
    cv2.imwrite(str(tmp_path / "picture.png"), np.full((240, 320, 3), 99, np.uint8))
    with PtyServer(firmware(), speed=50.0) as server:
        code, output, _ = run("doctor", "--port", server.path, "--policy", "run", "camera=file", "camera.path=picture.png")
    assert (code, output.splitlines()[-1]) == (0, "0 problems"), output
    assert "which restarts the controller: the arm may sag" in output
    policy_file(tmp_path / "run" / "policy.safetensors", max_delta_rad=0.3)
    code, output, _ = run("doctor", "port=/dev/nowhere", "--policy", "run", "camera=none")
    assert (code, output.splitlines()[-1]) == (1, "2 problems")
    assert re.search(r"problem +policy +.*action scale", output)
