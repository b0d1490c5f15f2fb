"""The cameras: one trustworthy picture or one sentence within the deadline, whatever comes down the line."""

from __future__ import annotations

import itertools
import json
import os
import random
import runpy
import subprocess
import sys
import termios
import threading
import tty
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import serial
from hypothesis import given, settings
from hypothesis import strategies as st

from uarm_rl.real.vision.camera import (
    OPENMV_SCRIPT,
    CameraError,
    OpenMVCamera,
    StillImages,
    Webcam,
    picture_files,
    read_picture,
)

READ_S = 0.02
TIMEOUT_S = 15.0


def picture(seed=0, shape=(240, 320)):
    """A coarse pattern, a different one for every seed."""
    pattern = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), np.uint8)
    return cv2.resize(pattern, shape[::-1], interpolation=cv2.INTER_CUBIC)


def jpeg(seed=0, noise=0, shape=(240, 320)):
    grain = np.random.default_rng(noise).normal(0.0, 3.0, (*shape, 3)) if noise else 0.0
    noisy = np.clip(picture(seed, shape) + grain, 0, 255).astype(np.uint8)
    return cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


def reply(data):
    return len(data).to_bytes(4, "little") + data


JPEG = jpeg()
GOOD = reply(JPEG)
TEXT = b"Traceback (most recent call last):\r\n"


class SnapPort:
    """A camera with the stock script, in virtual time: requests are groups of four bytes, a short one is given up after 5 s.

    ``replies`` are sent one per request, the last again and again. Reads return up to ``piece`` bytes.
    """

    def __init__(self, *replies, piece=64, stray=b"", pending=b"", starts_s=0.0, chatter=b""):
        self.replies = list(replies)
        self.piece, self.group, self.inbox, self.starts_s, self.chatter = piece, stray, pending, starts_s, chatter
        self.now_s, self.last_byte_s = 0.0, 0.0
        self.requests, self.closed, self.written = 0, 0, b""

    def clock(self):
        return self.now_s

    @property
    def in_waiting(self):
        return len(self.inbox)

    def write(self, data):
        self.written += data
        if self.now_s < self.starts_s:
            return len(data)
        if self.now_s - self.last_byte_s >= 5.0:
            self.group = b""
        self.last_byte_s = self.now_s
        self.group += data
        while len(self.group) >= 4:
            group, self.group = self.group[:4], self.group[4:]
            if group == b"snap":
                self.inbox += self.replies[min(self.requests, len(self.replies) - 1)]
                self.requests += 1
        return len(data)

    def read(self, size=1):
        self.inbox = self.inbox or self.chatter
        self.now_s += 0.001 if self.inbox else READ_S
        size = min(size, self.piece)
        data, self.inbox = self.inbox[:size], self.inbox[size:]
        return data

    def close(self):
        self.closed += 1


def connect(*replies, timeout_s=TIMEOUT_S, **keywords):
    port = SnapPort(*replies, **keywords)
    return port, OpenMVCamera(port, timeout_s=timeout_s, clock=port.clock)


def same(seen, seed=0):
    return cv2.absdiff(seen, picture(seed)).mean() < 4.0


# The snap protocol


@pytest.mark.parametrize("piece", [7, 64, 65536])
def test_two_pictures_that_agree_make_one(piece):
    port, openmv = connect(reply(jpeg(noise=1)), reply(jpeg(noise=2)), piece=piece)
    seen = openmv.read()
    assert seen.shape == (240, 320, 3)
    assert seen.dtype == np.uint8
    assert same(seen)
    assert port.written == b"snapsnap"
    assert not openmv.frozen


def test_a_picture_is_taken_after_the_call():
    port, openmv = connect(reply(jpeg(1)), pending=reply(jpeg(0)))  # the answer to a request of an earlier program
    assert same(openmv.read(), 1)
    assert port.requests == 2


@pytest.mark.parametrize(
    "first",
    [
        reply(b""),
        reply(b"")[:2],
        b"\xff\xff\xff\xff" + JPEG,
        TEXT + GOOD,
        GOOD[:3000],
        reply(JPEG[:-2] + b"??"),
        reply(b"??" + JPEG[2:]),
        reply(b"\xff\xd8" + bytes(600) + b"\xff\xd9"),  # the marks of a JPEG and nothing in between
        len(JPEG).to_bytes(4, "big") + JPEG,
        reply(jpeg(seed=7)),  # another scene
        reply(jpeg(shape=(120, 160))),
        b"",
    ],
)
def test_one_bad_answer_is_survived(first):
    _, openmv = connect(first, GOOD)
    assert same(openmv.read())


@pytest.mark.parametrize("stray", [b"s", b"na", b"\x00\x01\x02"])
def test_a_camera_out_of_step_falls_into_step_after_a_silence(stray):
    port, openmv = connect(GOOD, stray=stray)
    assert same(openmv.read())
    assert port.now_s > 5.0


def test_a_camera_that_still_starts_is_waited_for():
    _, openmv = connect(GOOD, starts_s=6.0)
    assert same(openmv.read())


def test_a_changed_picture_is_not_believed_at_once():
    """A JPEG with a byte lost in the middle decodes without complaint."""
    middle = JPEG.index(b"\xff\xda") + 1000
    torn = JPEG[:middle] + JPEG[middle + 1 :]
    assert not same(cv2.imdecode(np.frombuffer(torn, np.uint8), cv2.IMREAD_COLOR))
    _, openmv = connect(reply(torn), GOOD)
    assert same(openmv.read())


def refusal(openmv):
    with pytest.raises(CameraError) as caught:
        openmv.read()
    return str(caught.value)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"", "sent nothing"),
        (b"\x00\x00\x00\x00", "announced 0 bytes"),
        (GOOD[:3000], f"stopped after 2996 of {len(JPEG)} bytes"),
        (reply(b"??" + JPEG[2:]), "no JPEG"),
        (reply(b"\xff\xd8" + bytes(600) + b"\xff\xd9"), "does not decode"),
        (TEXT, "its script is not running"),
        (b"snap", "its script is not running"),  # the prompt of MicroPython echoes
    ],
)
def test_bad_answers_for_ever_are_one_sentence_within_the_deadline(answer, words):
    port, openmv = connect(answer)
    message = refusal(openmv)
    assert words in message
    assert "main.py" in message
    assert port.now_s <= TIMEOUT_S + READ_S


def test_pictures_that_never_agree():
    _, openmv = connect(*(reply(jpeg(seed)) for seed in range(20)))
    assert "hold still" in refusal(openmv)


def test_a_flood_ends_at_the_deadline():
    port, openmv = connect(GOOD, chatter=bytes(range(256)), timeout_s=1.0)
    assert "no picture within 1 s" in refusal(openmv)
    assert port.now_s <= 1.0 + READ_S


@pytest.mark.parametrize("banner", [b"@1\r\n@5 V1\r\n", b"$1 ok V4.10.0\n", b"E20\n", b"uArm Swift Pro\r\n"])
def test_the_arms_port_is_recognised_by_its_talk(banner):
    port, openmv = connect(b"", pending=banner)
    assert "answers like the arm" in refusal(openmv)
    assert port.written == b""


def test_a_frozen_camera_is_noticed():
    _, openmv = connect(reply(jpeg(noise=1)), reply(jpeg(noise=2)))
    openmv.read()
    assert not openmv.frozen
    openmv.read()
    assert openmv.frozen


def test_closing_twice_is_fine_and_a_closed_camera_says_so():
    port, openmv = connect(GOOD)
    with openmv:
        pass
    openmv.close()
    assert port.closed == 1
    assert "closed" in refusal(openmv)


@pytest.mark.parametrize("error", [serial.SerialException("gone"), OSError(5, "I/O"), termios.error(5, "I/O")])
@pytest.mark.parametrize("call", ["read", "write"])
def test_a_port_that_vanishes(error, call, monkeypatch):
    port, openmv = connect(GOOD)
    monkeypatch.setattr(port, call, lambda data: (_ for _ in ()).throw(error))
    assert "is gone" in refusal(openmv)


@given(
    st.lists(
        st.one_of(
            st.binary(max_size=80),
            st.binary(max_size=900).map(reply),
            st.binary(min_size=508, max_size=900).map(lambda data: reply(b"\xff\xd8" + data + b"\xff\xd9")),
            st.integers(0, len(GOOD)).map(lambda cut: GOOD[:cut]),
            st.just(GOOD),
        ),
        min_size=1,
        max_size=6,
    ),
    st.integers(8, 4096),
    st.binary(max_size=8),
)
@settings(max_examples=150)
def test_any_answers_give_a_picture_or_one_error_within_the_deadline(answers, piece, stray):
    port, openmv = connect(*answers, piece=piece, stray=stray[:3], pending=stray)
    with suppress(CameraError):
        assert openmv.read().shape[2] == 3
    assert port.now_s <= TIMEOUT_S + READ_S


def test_ten_thousand_random_streams_never_hang_the_camera():
    generator = random.Random(1)
    refused = 0
    for _ in range(10_000):
        answers = [generator.randbytes(generator.choice((0, 3, 4, 8, 700))) for _ in range(3)]
        if generator.random() < 0.3:
            answers[0] = reply(answers[0])
        port, openmv = connect(
            *answers,
            piece=generator.choice((7, 64, 4096)),
            chatter=generator.choice((b"", b"", b"\xff", generator.randbytes(9))),
            timeout_s=0.2,
        )
        try:
            openmv.read()
        except CameraError:
            refused += 1
        assert port.now_s <= 0.2 + READ_S
    assert refused == 10_000


# Real terminals


def test_a_port_that_does_not_open_is_the_cameras_error(tmp_path):
    with pytest.raises(CameraError, match="there is no port"):
        OpenMVCamera(str(tmp_path / "nothing"))


@contextmanager
def terminal():
    """A raw pseudo-terminal: its camera side as a file number, its computer side as a path."""
    master, slave = os.openpty()
    tty.setraw(slave)
    try:
        yield master, os.ttyname(slave)
    finally:
        os.close(slave)
        with suppress(OSError):
            os.close(master)


def serve(master, replies):
    """Answer requests as a camera does, until the terminal goes."""
    with suppress(OSError):
        for answer in replies:
            request = b""
            while len(request) < 4:
                request += os.read(master, 4 - len(request))
            assert request == b"snap"
            sent = 0
            while sent < len(answer):
                sent += os.write(master, answer[sent : sent + 512])


def test_a_picture_over_a_real_terminal():
    with terminal() as (master, path):
        threading.Thread(target=serve, args=(master, itertools.repeat(GOOD)), daemon=True).start()
        for _ in range(2):  # and once more after closing
            with OpenMVCamera(path) as openmv:
                assert same(openmv.read())
                assert path in openmv.name


def test_the_speed_is_none_that_has_a_meaning_for_the_camera():
    with terminal() as (master, path), OpenMVCamera(path):
        assert termios.tcgetattr(master)[4:6] == [termios.B115200, termios.B115200]


def test_an_unplugged_cable_is_one_sentence():
    with terminal() as (master, path), OpenMVCamera(path) as openmv:

        def unplug():
            os.read(master, 4)
            os.write(master, GOOD[:100])
            os.close(master)

        threading.Thread(target=unplug, daemon=True).start()
        assert "is gone" in refusal(openmv)


# The script on the camera, run by this Python with stand-ins for the modules of its firmware

FIRMWARE = '''
import json, os, runpy, sys, types

script, generation, jpeg, fd, stray = sys.argv[1:]
fd = int(fd)
calls = []

class Jpeg:
    def __init__(self, data): self.data = data
    def size(self): return len(self.data)

class Image:
    def to_jpeg(self, quality):
        calls.append(["to_jpeg", [], {"quality": quality}])
        return Jpeg(open(jpeg, "rb").read())

class OldImage:
    def compress(self, quality):
        calls.append(["compress", [], {"quality": quality}])
        return Jpeg(open(jpeg, "rb").read())

class Recorder(types.ModuleType):
    """Any function: records how it was called; reads of gains and exposure give a value."""
    RGB565 = "RGB565"
    QVGA = "QVGA"
    failed = False
    def __getattr__(self, name):
        if name.startswith("__"): raise AttributeError(name)
        def call(*args, **keywords):
            calls.append([name, list(args), keywords])
            if name == "CSI": return self
            if name == "snapshot" and "time" not in keywords:
                if not self.failed:
                    self.failed = True
                    raise RuntimeError("Capture timeout")
                return Image() if generation == "csi" else OldImage()
            return f"value of {name}"
        return call

class USB_VCP:
    received = bytes.fromhex(stray)
    def setinterrupt(self, character): assert character == -1
    def recv(self, size, timeout):
        if self.received:
            data, self.received = self.received[:size], self.received[size:]
            return data
        data = os.read(fd, size)
        return data
    def send(self, data):
        with open(jpeg + ".calls", "w") as log: json.dump(calls, log)
        data = getattr(data, "data", data)
        while data: data = data[os.write(fd, data):]

pyb = types.ModuleType("pyb")
pyb.USB_VCP = USB_VCP
sys.modules |= {"pyb": pyb, generation: Recorder(generation)}
runpy.run_path(script)
'''


@pytest.mark.parametrize("generation", ["csi", "sensor"])
def test_the_cameras_script_with_both_generations_of_firmware(generation, tmp_path):
    (tmp_path / "shot").write_bytes(JPEG)
    with terminal() as (master, path):
        firmware = [sys.executable, "-c", FIRMWARE, OPENMV_SCRIPT, generation, tmp_path / "shot", str(master), b"sn".hex()]
        with subprocess.Popen(firmware, pass_fds=[master]) as running:
            try:
                with OpenMVCamera(path) as openmv:
                    assert same(openmv.read())
            finally:
                running.kill()
    calls = [
        (name, [str(argument) for argument in arguments], keywords)
        for name, arguments, keywords in json.loads((tmp_path / "shot.calls").read_text())
    ]
    names = [name for name, _, _ in calls]
    prefix, getter = ("", "") if generation == "csi" else ("set_", "get_")
    settled = names.index("snapshot" if generation == "csi" else "skip_frames")
    assert calls[settled][2]["time"] >= 2000
    for control, value in (("auto_gain", "gain_db"), ("auto_whitebal", "rgb_gain_db"), ("auto_exposure", "exposure_us")):
        fixed = names.index(prefix + control)
        assert fixed > settled
        assert calls[fixed][1:] == (["False"], {value: f"value of {getter}{value}"})
    compressions = [keywords["quality"] for name, _, keywords in calls if name in ("to_jpeg", "compress")]
    assert compressions
    assert min(compressions) >= 60


def test_the_script_is_small_enough_for_micropython():
    """No syntax or modules that MicroPython does not have: no annotations, no f-strings, four modules."""
    source = OPENMV_SCRIPT.read_text()
    assert "->" not in source
    assert 'f"' not in source
    assert {line.split()[1] for line in source.splitlines() if line.strip().startswith(("import", "from"))} == {
        "struct",
        "pyb",
        "csi",
        "sensor",
    }


def test_the_script_needs_the_camera():
    with pytest.raises(ModuleNotFoundError, match="pyb"):
        runpy.run_path(str(OPENMV_SCRIPT))


# Webcams and files


@pytest.fixture
def film(tmp_path):
    path = str(tmp_path / "film.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for number in range(12):
        writer.write(np.full((240, 320, 3), 20 * number, np.uint8))
    writer.release()
    return path


def test_a_webcam_gives_new_pictures_of_one_size(film):
    with Webcam(film, width=320, height=240) as webcam:
        seen = webcam.read()  # opening took one, and each leaves the stored ones behind
        assert seen.shape == (240, 320, 3)
        assert abs(float(seen.mean()) - 20 * 9) < 5
        with pytest.raises(CameraError, match="gives no picture"):
            webcam.read()


def test_a_webcam_of_another_size(film):
    with pytest.raises(CameraError, match="320 x 240 where 640 x 480 were asked for"):
        Webcam(film, width=640, height=480)


def test_no_webcam(capfd):
    with pytest.raises(CameraError, match="webcam 99 cannot be opened"):
        Webcam(99)
    assert capfd.readouterr().err == ""


def test_still_images(tmp_path):
    for name, seed in (("b.png", 2), ("a.png", 1)):
        cv2.imwrite(str(tmp_path / name), picture(seed))
    (tmp_path / "notes.txt").write_text("no picture")
    with StillImages(tmp_path / "b.png") as still:
        assert [same(still.read(), 2) for _ in range(3)] == [True] * 3
    with StillImages(tmp_path) as folder:
        assert same(folder.read(), 1)
        assert same(folder.read(), 2)
        with pytest.raises(CameraError, match="used up"):
            folder.read()
    assert [path.name for path in picture_files(tmp_path)] == ["a.png", "b.png"]


def test_no_still_images(tmp_path):
    with pytest.raises(CameraError, match="holds no pictures"):
        StillImages(tmp_path)
    with pytest.raises(CameraError, match="there is no folder"):
        picture_files(tmp_path / "nowhere")
    with pytest.raises(CameraError, match="cannot be read"):
        StillImages(tmp_path / "nothing.png").read()
    Path(tmp_path / "damaged.png").write_bytes(b"\x89PNG")
    with pytest.raises(CameraError, match="damaged"):
        read_picture(tmp_path / "damaged.png")


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan")])
def test_a_deadline_is_a_positive_number(timeout_s):
    with pytest.raises(ValueError, match="timeout_s must be"):
        OpenMVCamera(SnapPort(GOOD), timeout_s=timeout_s)
