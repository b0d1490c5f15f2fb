"""``run-real`` and ``jog`` on real terminals, as a user meets them."""

from __future__ import annotations

import csv
import hashlib
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from tests.bench import Tap, Workbench, judge
from tests.conftest import CARD, uarm_rl
from uarm_rl import cli, configuration
from uarm_rl.columns import TRIALS
from uarm_rl.commands.words import as_overrides
from uarm_rl.emulator.faults import Fault
from uarm_rl.emulator.pty import PtyServer
from uarm_rl.emulator.realism import Settings
from uarm_rl.real import live, session
from uarm_rl.real.vision.camera_model import nominal
from uarm_rl.task.policy import encode

ROOT = Path(__file__).parents[2]


# The command line


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--port", "/dev/ttyACM0"], ["port=/dev/ttyACM0"]),
        (["--trials=50", "seed=1"], ["trials=50", "seed=1"]),
        (["--dry-run"], ["dry_run=true"]),
        (["--dry-run", "--trials", "5"], ["dry_run=true", "trials=5"]),
        (["--target", "0.2", "-0.1", "0.03", "camera=none"], ["target=[0.2,-0.1,0.03]", "camera=none"]),
        (["--target", "0.2", "-.1", "3e-2", "-m"], ["target=[0.2,-.1,3e-2]", "-m"]),
        (
            ["--obstacle", "1", "0", "0", "1", "1", "1", "--trials", "1", "--obstacle", "2", "0", "0", "1", "1", "1"],
            ["trials=1", "obstacle=[[1,0,0,1,1,1],[2,0,0,1,1,1]]"],
        ),
        (["--obstacle=[1,0,0,1,1,1]", "--dry-run"], ["dry_run=true", "obstacle=[1,0,0,1,1,1]"]),
        (["--camera.port", "/dev/pts/1"], ["camera.port=/dev/pts/1"]),
        (["--out", "a (b)'s"], ["out='a (b)\\'s'"]),
        (["--seed", "0,1", "--multirun"], ["seed=0,1", "--multirun"]),
        (["--cfg", "job", "--help"], ["--cfg", "job", "--help"]),
        (["--config-dir=.", "--info", "all"], ["--config-dir=.", "--info", "all"]),
        (["--run", "results/C/seed0"], ["run=results/C/seed0"]),
        (["--hydra.run.dir=x"], ["hydra.run.dir=x"]),  # which is refused as such
        (["trials=5", "-h", "+x=1"], ["trials=5", "-h", "+x=1"]),
    ],
)
def test_options_are_overrides(words, expected):
    assert as_overrides(words) == expected


def test_a_quoted_value_arrives_as_it_was():
    for value in ("a (b)'s", 'quo"te', "back\\slash", "#1", "ümlaut"):
        assert configuration.compose("run-real", tuple(as_overrides(["--out", value])))["out"] == value
        assert configuration.compose("run-real", tuple(as_overrides([f"--out={value}=x"])))["out"] == f"{value}=x"


@pytest.fixture
def run(monkeypatch, tmp_path, capsys):
    """Call the command line in this process, in a folder of its own: (exit code, output, error)."""
    monkeypatch.chdir(tmp_path)

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["uarm-rl", *map(str, words)])
        code = 0
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code
        output, error = capsys.readouterr()
        return code, output, error

    return call


@pytest.fixture
def served():
    """An emulated arm with an object on a real terminal, 50 times as fast as real."""
    firmware = Tap(Settings(boot_s=1.0), Workbench())
    with PtyServer(firmware, speed=50.0) as server:
        yield server, firmware


FAST = ("--speed", 50, "--policy", "ik", "camera=none")


def read(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_trials_on_a_terminal(run, served, tmp_path):
    server, firmware = served
    code, output, error = run("run-real", "--port", server.path, "--target", 0.2, 0.05, 0.03, "--trials", 2, *FAST)
    assert (code, error) == (0, "")
    assert "2 of 2 held after the lift: 100% (95 % interval 34% to 100%, Wilson); the arm was emulated" in output
    folder = tmp_path / "results" / "ik" / "seed0" / "real"
    rows = read(folder / "trials.csv")
    assert tuple(rows[0]) == tuple(TRIALS)
    assert [(row["trial"], row["success"], row["emulated"]) for row in rows] == [("1", "1", "1"), ("2", "1", "1")]
    assert f"port: {server.path}" in (folder / "config.yaml").read_text()
    firmware.wait_until_parked()
    assert firmware.heard.count(b"M2231 V1") == 2
    for line in filter(None, re.sub("[!\x18]", "", firmware.heard.decode()).splitlines()):
        judge(line)
    before = (folder / "trials.csv").read_bytes()
    heard = len(firmware.heard)
    code, _, error = run("run-real", "--port", server.path, "--target", 0.2, 0.05, 0.03, *FAST)
    assert (code, "out=FOLDER writes elsewhere" in error) == (2, True)
    assert ((folder / "trials.csv").read_bytes(), len(firmware.heard)) == (before, heard)


@pytest.mark.parametrize("disk", ["takes it", "takes nothing"])
def test_who_looks_on_sees_the_trial_and_changes_nothing(run, served, tmp_path, disk):
    server, firmware = served
    if disk == "takes nothing":
        (tmp_path / "series" / "live.json" / "in the way").mkdir(parents=True)
    words = ("--target", 0.2, 0.05, 0.03, "--trials", 1, "--out", "series", *FAST)
    code, output, _ = run("run-real", "--port", server.path, *words, "watch=true")
    assert (code, "1 of 1 held after the lift" in output) == (0, True)
    firmware.wait_until_parked()
    assert [row["success"] for row in read(tmp_path / "series" / "trials.csv")] == ["1"]
    last = live.read(tmp_path / "series")
    if disk == "takes it":
        assert (last.ended, last.trials, last.emulated, "held" in last.said) == (True, 1, True, True)
    else:
        assert last is None


def test_a_series_that_was_interrupted_goes_on(run, tmp_path):
    firmware = Tap(Settings(), Workbench(), faults=(Fault("unplug", "G2206", nth=40, delay_s=0.1),))
    series = ("run-real", *TARGET, "--trials", 5, "--out", "series", *FAST)
    with PtyServer(firmware, speed=50.0) as server:
        assert run(*series, "--port", server.path)[0] == 1
    path = tmp_path / "series" / "trials.csv"
    before = path.read_bytes()
    assert 1 <= len(read(path)) < 5
    with PtyServer(Tap(Settings(), Workbench()), speed=50.0) as server:
        code, _, error = run(*series, "--port", server.path)
        assert (code, "resume=true goes on with them" in error, path.read_bytes()) == (2, True, before)
        code, _, error = run(*series, "--port", server.path, "resume=true", "press_m=0.001")
        assert (code, "press_m=0.002, not 0.001" in error, path.read_bytes()) == (2, True, before)
        code, _, error = run(*series, "--port", server.path, "resume=true", "overwrite=true")
        assert (code, "give one of them" in error, path.read_bytes()) == (2, True, before)
        config = path.with_name("config.yaml")
        config.write_text(re.sub(r"^ *obstacle.*\n", "", config.read_text(), flags=re.MULTILINE))  # of before there were any
        code, output, error = run(*series, "--port", server.path, "resume=true")
    assert (code, error) == (0, "")
    assert path.read_bytes().startswith(before)
    assert [row["trial"] for row in read(path)] == ["1", "2", "3", "4", "5"]
    assert "of 5 held after the lift" in output
    code, output, _ = run(*series, "resume=true")  # needs no arm any more
    assert (code, "of 5 held after the lift" in output) == (0, True)


def test_a_joint_is_jogged_and_nothing_else_moves(run, served):
    server, firmware = served
    code, output, _ = run("jog", "--port", server.path, "--joint", 2, "--degrees", -5, "--speed", 50)
    assert code == 0
    assert re.search(r"joint2: -28\.\d+ degrees before, -33\.\d+ after: moved by -[45]\.\d+ of -5.00", output)
    assert "right if the lower arm leaned back and the cup rose" in output
    assert len(firmware.moves()) == 1  # it does not park either
    code, output, _ = run("jog", "--port", server.path, "--joint", 1, "--degrees", 4, "--speed", 50)
    assert "turned to its left" in output


def test_a_dry_run_needs_nothing_and_sends_nothing(run, tmp_path):
    code, output, error = run("run-real", "--dry-run", "--policy", "ik", "--trials", 2)
    assert (code, error) == (0, "")
    lines = re.findall(r"^would send: (.*?)  ", output, re.MULTILINE)
    assert lines[0] == "M2231 V0"
    assert lines[-1].startswith("G2206 B90.000 L118.000 R50.000")
    assert len(lines) > 50
    for line in lines:
        judge(f"#1 {line.strip()}")
    assert "nothing was sent" in output
    assert list(tmp_path.iterdir()) == []


def policy_file(path, **changed):
    """A policy for the arm whose card is changed; a value of ``None`` leaves the key out."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ones = np.ones(20, np.float32)
    tensors = {"offset": ones, "scale": ones, "weight0": np.full((20, 3), 0.01, np.float32), "bias0": np.zeros(3, np.float32)}
    card = {key: value for key, value in (asdict(CARD) | changed).items() if value is not None}
    path.write_bytes(encode(tensors, card))


TARGET = ("--target", 0.2, 0.05, 0.03)


@pytest.mark.parametrize(
    ("words", "code", "parts"),
    [
        (["port=/dev/nowhere", *TARGET, *FAST[2:]], 1, ["there is no port /dev/nowhere"]),
        (["port=/dev/nowhere", *FAST[2:4]], 1, ["there is no port /dev/nowhere; plug in the USB cable and the power"]),
        ([*TARGET, *FAST[2:]], 1, ["no serial port has the USB id of the uArm", "--port"]),
        (
            ["port=PORT", *TARGET, "policy=away"],
            2,
            ["there is no policy away", "--policy takes default", "experiment=real_arm"],
        ),
        (["port=PORT", *TARGET, "policy=wide"], 1, ["action scale", "max_delta_rad", "0.25, got 0.3"]),
        (["port=PORT", *TARGET, "policy=poor"], 1, ["lacks", "tolerance_m"]),
        (["port=PORT", *TARGET, "policy=torn/policy.safetensors"], 1, ["truncated, damaged"]),
        (["port=PORT", "--policy", "ik", "--target", "0.6", "0", "0.03"], 2, ["cannot come down onto (600, 0, 30) mm"]),
        (["port=PORT", "--policy", "ik", "--target", "200", "0", "30"], 2, ["in metres, e.g. --target 0.2 0 0.03"]),
        (["port=PORT", "--policy", "ik", "--target", "0.2", "0"], 2, ["target must be three numbers", "[0.2, 0]"]),
        (["port=PORT", "--policy", "ik", "--target", "0.2", "0", "nan"], 2, ["target must be a finite number"]),
        (["port=PORT", "--policy", "ik", "--target", "0.2", "0", "0.005"], 2, ["5 mm above the table is too low"]),
        (["port=PORT", "--policy", "ik", "camera=none"], 2, ["--target X Y Z", "camera"]),
        (["port=PORT", "--policy", "ik", "camera.port=/dev/nowhere"], 1, ["there is no port /dev/nowhere", "camera"]),
        (["port=PORT", "--policy", "ik", "camera=webcam", "camera.index=99"], 1, ["webcam 99 cannot be opened"]),
        (["port=PORT", "--policy", "ik", "camera=file", "camera.path=nothing.png"], 1, ["nothing.png cannot be read"]),
        (["port=PORT", "--policy", "ik", "camera=file"], 2, ["camera.path=VALUE is needed"]),
        (["port=PORT", "--policy", "ik", "camera=file", "camera.path=small.png", "calibration=good.json"], 1, ["320 x 240"]),
        (
            ["port=PORT", "--policy", "ik", "camera=file", "camera.path=small.png", "calibration=torn.json"],
            1,
            ["torn.json is damaged"],
        ),
        (["port=PORT", *TARGET, "--policy", "ik", "--trials", "0"], 2, ["trials must be a whole number of at least 1"]),
        (["port=PORT", *TARGET, "--policy", "ik", "--feed", "99"], 2, ["feed must be a number from 0.1 to 30"]),
        (["port=PORT", *TARGET, "--policy", "ik", "limits.z_m=[0.1]"], 2, ["limits.z_m must be two numbers"]),
        (["port=PORT", *TARGET, "--policy", "ik", "--nonsense", "1"], 2, ["run-real has no setting 'nonsense'"]),
        (["port=PORT", *TARGET, "--policy", "ik", "max_press_m=0.001"], 2, ["max_press_m must be a number from 0.002"]),
    ],
)
def test_bad_input_is_one_sentence_and_nothing_moves(run, served, tmp_path, words, code, parts):
    import cv2

    server, firmware = served
    policy_file(tmp_path / "wide" / "policy.safetensors", max_delta_rad=0.3)
    policy_file(tmp_path / "poor" / "policy.safetensors", tolerance_m=None)
    policy_file(tmp_path / "torn" / "policy.safetensors")
    torn = (tmp_path / "torn" / "policy.safetensors").read_bytes()
    (tmp_path / "torn" / "policy.safetensors").write_bytes(torn[:-5])
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((120, 160, 3), np.uint8))
    nominal().save(tmp_path / "good.json")
    (tmp_path / "torn.json").write_text("{")
    before = sorted(tmp_path.rglob("*"))
    done, _, error = run("run-real", *(str(word).replace("PORT", server.path) for word in words))
    lines = [line for line in error.splitlines() if line.startswith("error: ")]
    assert (done, len(lines)) == (code, 1), error
    for part in parts:
        assert part in lines[0], lines[0]
    assert firmware.moves() == []
    assert sorted(tmp_path.rglob("*")) == before


def test_a_real_arm_needs_a_calibration(run, tmp_path):
    """A port that is no pseudo-terminal is no emulated arm's; the calibration is read before it is opened."""
    import cv2

    cv2.imwrite(str(tmp_path / "picture.png"), np.zeros((240, 320, 3), np.uint8))
    code, _, error = run("run-real", "port=/dev/null", "--policy", "ik", "camera=file", "camera.path=picture.png")
    assert (code, "calibration.json cannot be read" in error, "calibrate-hand-eye" in error) == (1, True, True)


def test_a_busy_port_is_named(run, served):
    server, firmware = served
    arm = session.connect(server.path, speed=50.0, parks=False)
    code, _, error = run("run-real", "--port", server.path, *TARGET, *FAST)
    arm.close()
    assert (code, "in use by another program" in error) == (1, True)
    assert firmware.moves() == []


def test_the_cameras_port_is_not_the_arms(run, monkeypatch, served):
    from types import SimpleNamespace

    server, firmware = served
    camera = SimpleNamespace(device=server.path, vid=0x37C5, pid=0x1204)
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [camera])
    code, _, error = run("run-real", "--port", server.path, *TARGET, *FAST)
    assert (code, "is the port of an OpenMV camera, not of the uArm" in error) == (1, True)
    assert firmware.heard == b""


def test_speed_is_for_emulators(run, tmp_path):
    code, _, error = run("run-real", "--port", "/dev/null", *TARGET, *FAST)
    assert (code, "speed=50 is for an emulator" in error) == (2, True)


def test_an_obstacle_that_is_told_is_not_approached(run, served, tmp_path):
    server, firmware = served
    words = ("--port", server.path, *TARGET, "--trials", 1, *FAST, "--obstacle")
    code, _, error = run("run-real", *words, 0.2, 0.03, 0.1, 0.03, 0.03, 0.2)
    assert (code, "is too near an obstacle for the arm to come down onto it" in error) == (2, True)
    code, _, error = run("run-real", *words, 0.2, 0.03, 0.1)
    assert (code, "obstacle must be x y z and the three sides, in metres" in error) == (2, True)
    assert firmware.heard == b""
    code, _, error = run("run-real", *words, -0.07, 0, 0.3, 0.04, 0.1, 0.04)  # it hangs where the elbow is at home
    assert (code, "mm of an obstacle, and 10 mm are to be kept; choose another target" in error) == (1, True)
    assert set(firmware.moves()) <= {b"G2206 B90.000 L118.000 R50.000 F20.0"}  # where it stands, the folded pose
    assert b"M2231 V0" in firmware.heard
    two = (0.22, 0.2, 0.1, 0.03, 0.03, 0.2, "--obstacle", 0.22, -0.2, 0.1, 0.03, 0.03, 0.2)
    code, output, error = run("run-real", *words, *two, "overwrite=true")
    assert (code, error, "1 of 1 held" in output) == (0, "", True)


def test_an_emulator_says_its_speed_itself(run, served, tmp_path):
    server, firmware = served
    (tmp_path / "arm").symlink_to(server.path)
    (tmp_path / "speed").write_text("50.0\n")
    words = ("jog", "--port", tmp_path / "arm", "--joint", 1, "--degrees", 4)
    code, _, error = run(*words, "--speed", 20)
    assert code == 2
    assert error.endswith(f"speed=20, and the emulator at {tmp_path / 'arm'} runs with 50; leave speed out\n")
    assert firmware.heard == b""
    assert session.connect(str(tmp_path / "arm"), parks=False)._speed == 50.0
    assert run(*words)[0] == 0
    (tmp_path / "speed").write_text("no number")
    assert run(*words, "--speed", 50)[0] == 0


def test_a_policy_of_another_servo_is_warned_of(run, tmp_path):
    policy_file(
        tmp_path / "run" / "policy.safetensors", servo={"name": "second_order"}, hold={"name": "fixed", "control_steps": 1}
    )
    code, _, error = run("run-real", "--dry-run", "--policy", "run", "--trials", 1)
    assert code == 0
    assert re.search(r"warning: the policy was trained with servo=second_order", error)
    assert re.search(r"warning: the policy was not trained to wait", error)


def test_a_policy_that_may_lean_is_warned_of(run, tmp_path):
    policy_file(tmp_path / "run" / "policy.safetensors", cup={"name": "rigid"})
    _, _, error = run("run-real", "--dry-run", "--policy", "run", "--trials", 1)
    assert re.search(r"warning: the policy was trained with a rigid cup and may lean", error)


def test_the_packaged_policy_is_found_away_from_any_checkout(run, tmp_path):
    """It is the policy that a folder of the results holds, and its card says which file it is."""
    code, output, error = run("run-real", "--dry-run", "--target", 0.2, 0.05, 0.03, "--trials", 1)
    assert (code, error) == (0, "")
    assert re.search(r"^ +1 .* held ", output, re.MULTILINE)
    assert list(tmp_path.iterdir()) == []
    packaged = resources.files("uarm_rl.real")
    data = (packaged / "default.safetensors").read_bytes()
    card = (packaged / "default.md").read_text(encoding="utf-8")
    assert hashlib.sha256(data).hexdigest() in card
    (source,) = re.findall(r"`results/(real_arm/seed\d+)`", card)
    assert (ROOT / "results" / source / "policy.safetensors").read_bytes() == data


def test_the_feed_is_that_of_the_training(run, tmp_path):
    policy_file(tmp_path / "run" / "policy.safetensors")
    _, output, _ = run("run-real", "--dry-run", "--policy", "run", "--trials", 1)
    assert set(re.findall(r"G2206 .*? F(\S+)", output)) == {"15.0"}


def test_a_camera_that_ends_keeps_the_rows(run, served, tmp_path):
    """Pictures of an empty table for one search and a half."""
    import cv2

    server, firmware = served
    for number in range(20):
        cv2.imwrite(str(tmp_path / f"table{number:02d}.png"), np.full((240, 320, 3), 120, np.uint8))
    words = ("camera=file", f"camera.path={tmp_path}", "--policy", "ik", "--speed", 50, "--out", "here", "--port", server.path)
    code, output, error = run("run-real", *words)
    assert (code, "are used up" in error) == (1, True)
    rows = read(tmp_path / "here" / "trials.csv")
    assert [row["success"] for row in rows] == ["0"]
    assert "was not found in 12 pictures" in rows[0]["reason"]
    assert "0 of 1 held" in output
    assert [line for line in firmware.heard.decode().splitlines() if "M2231" in line][-1].endswith("V0")


def test_an_object_that_is_never_in_view_is_an_error(run, served, tmp_path):
    import cv2

    cv2.imwrite(str(tmp_path / "table.png"), np.full((240, 320, 3), 120, np.uint8))
    words = ("camera=file", "camera.path=table.png", "--policy", "ik", "--speed", 50, "--trials", 1, "--port", served[0].path)
    code, output, error = run("run-real", *words)
    assert (code, "0 of 1 held" in output, "error: the object was not found in 12 pictures" in error) == (1, True, True)


def test_an_unplugged_cable_keeps_the_rows(run, tmp_path):
    firmware = Tap(Settings(), Workbench(), faults=(Fault("unplug", "G2206", nth=40, delay_s=0.1),))
    with PtyServer(firmware, speed=50.0) as server:
        code, output, error = run("run-real", "--port", server.path, *TARGET, "--trials", 50, *FAST)
    assert (code, "check the USB cable" in error) == (1, True)
    rows = read(tmp_path / "results" / "ik" / "seed0" / "real" / "trials.csv")
    assert 1 <= len(rows) < 10
    assert f"{len(rows)} of {len(rows)} held" in output


@pytest.mark.parametrize(
    "numbers", [(signal.SIGINT,), (signal.SIGINT, signal.SIGINT), (signal.SIGTERM,), (signal.SIGHUP, signal.SIGTERM)]
)
def test_signals_end_it_with_the_pump_off_and_the_arm_parked(served, tmp_path, numbers):
    server, firmware = served
    words = [sys.executable, "-m", "uarm_rl.cli", "run-real", "--port", server.path, *TARGET, "--trials", "999", *FAST]
    process = subprocess.Popen(list(map(str, words)), cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    end_s = time.monotonic() + 60.0
    while b"M2231 V1" not in firmware.heard:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end_s, "the pump was never switched on"
        time.sleep(0.001)
    for number in numbers:
        os.kill(process.pid, number)
    _, error = process.communicate(timeout=30)
    assert process.returncode in (130, -signal.SIGINT)  # the second may come while Python shuts down
    assert error.splitlines() == [
        "error: interrupted; no file is left half written, and where a command has resume=true it goes on"
    ]
    firmware.wait_until_parked()
    said = [line.split(" ", 1)[1] for line in re.sub("[!\x18]", "", firmware.heard.decode()).splitlines() if " " in line]
    assert said[-1].startswith("G2206 B90.000 L118.000 R50.000")
    assert "M2231 V0" in said[-6:]
    assert not firmware.machine.joints.sucking


def test_neither_torch_nor_pybullet_is_loaded(served, tmp_path):
    port = served[0].path
    commands = (
        ("run-real", "--port", port, *TARGET, "--trials", 1, *FAST),
        ("jog", "--port", port, "--joint", 1, "--degrees", 1, "--speed", 50),
        ("doctor", "--port", port, "camera=file", "camera.path=none.png"),
    )
    code = (
        "import sys; from uarm_rl import cli\n"
        f"for words in {[list(map(str, words)) for words in commands]}:\n"
        "    sys.argv = ['uarm-rl', *words]\n"
        "    try: cli.main()\n"
        "    except SystemExit as stop: print('exit', stop.code)\n"
        "print({'torch', 'pybullet', 'pandas', 'matplotlib'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-2:] == ["exit 1", "set()"], done.stdout + done.stderr
    assert "1 of 1 held" in done.stdout, done.stdout + done.stderr


def test_the_commands_are_in_the_help(tmp_path):
    for command in ("run-real", "jog", "doctor", "calibrate-camera", "calibrate-hand-eye", "emulate"):
        done = uarm_rl(command, "--help", cwd=tmp_path)
        assert (
            done.returncode,
            f"uarm-rl {command}:" in done.stdout,
            "port" in done.stdout or command == "calibrate-camera",
        ) == (0, True, True)
