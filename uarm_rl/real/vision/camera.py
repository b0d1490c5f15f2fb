"""Cameras: an OpenMV over USB serial, any webcam that OpenCV can open, and still images.

The OpenMV runs ``openmv/main.py`` and speaks the "snap" protocol: the host sends the four bytes ``snap``, the camera
answers with a length (four bytes, little endian) and so many bytes of JPEG. There is no checksum and nothing that marks
the beginning of an answer, so this end bounds the length, looks at the JPEG's first and last bytes, and believes a
picture when the next one agrees with it.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks, files
from uarm_rl.real.ports import BROKEN, CAMERA, READ_S, Port, PortError, find_port, open_port

log = logging.getLogger(__name__)

Picture = NDArray[np.uint8]


class CameraError(Exception):
    """There is no camera or no trustworthy picture; the message is a sentence with the remedy."""


class Camera(Protocol):
    """What takes pictures; a context manager that closes. ``name`` appears in messages."""

    name: str

    def read(self) -> Picture:
        """One BGR picture, shape (h, w, 3), taken after the call. Ends within a bounded time, maybe with ``CameraError``."""
        ...

    def close(self) -> None:
        """Give the camera back; closing twice is fine."""
        ...

    def __enter__(self) -> Camera: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...


#: What has to run on the camera; its docstring says how to put it there.
OPENMV_SCRIPT: Final = Path(__file__).with_name("openmv") / "main.py"

_WRITE_S: Final = 0.5
_CHUNK_BYTES: Final = 65536
_BYTES: Final = (512, 512 * 1024)  # what a JPEG from this camera may have
_ANSWER_S: Final = 2.0  # between a request and the first byte, or between two pieces of a picture
_GAP_S: Final = 0.25  # of silence after nonsense, before the next request
#: The camera reads requests four bytes at a time and gives a shorter one up after 5 s: a lost byte is forgotten after
#: such a silence. Together with the waiting before it this also covers the 6 s that a camera takes to start.
_SILENCE_S: Final = 5.3
#: Two pictures agree if no field of this grid differs by more grey levels on average. Noise averages out; a byte lost in
#: a JPEG shifts or tints what follows, and a hand at work moves more.
_GRID: Final = (20, 15)
_MAX_DIFFERENCE: Final = 12
_MAX_FRAMES: Final = 6  # tried in one read until two agree

_HEARD_BYTES: Final = 200  # kept of what is thrown away, to tell who is speaking
_ARM_TALK: Final = re.compile(rb"[@$]\d|uArm|uarm|^ok|E2[0-9]\b")

_LOG_ERRORS: Final = 2
_STORED_PICTURES: Final = 4  # by Video4Linux
_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".bmp")


class _BadAnswerError(Exception):
    """An answer that is no picture; says what it was."""


class _NoAnswerError(Exception):
    """Silence."""


class OpenMVCamera:
    """An OpenMV camera that runs ``openmv/main.py``, at ``port``, or the one that is plugged in.

    ``read`` asks for pictures until two that follow each other agree, and returns the later one. It ends within
    ``timeout_s`` (plus one read of 20 ms or one blocked write of 0.5 s), which is enough for a camera that was plugged in
    a moment ago. An open port in place of a name is used as it is; the clock is a parameter for tests in virtual time.

    A camera can freeze and go on sending the same picture. Two equal pictures are possible only in perfect darkness or
    overexposure, because of the sensor's noise; ``frozen`` tells whether the last ``read`` gave the same bytes as the
    one before it.
    """

    def __init__(
        self,
        port: str | Port | None = None,
        *,
        timeout_s: float = 15.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._timeout_s = checks.number("timeout_s", timeout_s, low=0.0, high=600.0, open_low=True)
        self._clock = clock
        try:
            if port is None:
                port = find_port(CAMERA)
            self._port: Port | None = open_port(CAMERA, port, write_timeout_s=_WRITE_S) if isinstance(port, str) else port
        except PortError as error:
            raise CameraError(str(error)) from error
        self.name = f"the OpenMV camera at {port}" if isinstance(port, str) else "the OpenMV camera"
        self.frozen = False
        self._last_jpeg = b""
        self._heard = b""

    def read(self) -> Picture:
        deadline_s = self._clock() + self._timeout_s
        self._heard = b""
        before, _ = self._frame(deadline_s)
        for _ in range(_MAX_FRAMES - 1):
            picture, jpeg = self._frame(deadline_s)
            if _agree(picture, before):
                self.frozen, self._last_jpeg = jpeg == self._last_jpeg, jpeg
                if self.frozen:
                    log.warning("%s sent the very same bytes as last time; it may have frozen: plug it in anew", self.name)
                return picture
            log.warning("two pictures in a row do not agree; asking for another")
            before = picture
        raise CameraError(
            f"no two pictures in a row from {self.name} agree: either the arm or the object moves, or the light flickers, or "
            "bytes get lost on the way; hold still, use a short cable, and try again"
        )

    def _frame(self, deadline_s: float) -> tuple[Picture, bytes]:
        """The next picture that decodes, and its bytes."""
        complaint, silence_s = "", READ_S
        while True:
            self._drain(silence_s, deadline_s)
            if self._clock() >= deadline_s:
                raise self._no_picture(complaint or "it sent nothing")
            try:
                self._write(b"snap")
                jpeg = self._jpeg(deadline_s)
            except _NoAnswerError:
                silence_s = _SILENCE_S
                continue
            except _BadAnswerError as error:
                if not complaint or self._clock() < deadline_s:  # an answer that the deadline cut says less
                    complaint = str(error)
                silence_s = _GAP_S
                continue
            if (picture := _decode(jpeg)) is not None:
                return picture, jpeg
            complaint, silence_s = "it sent a picture that does not decode", _GAP_S

    def _jpeg(self, deadline_s: float) -> bytes:
        header = self._exactly(4, deadline_s)
        length = int.from_bytes(header, "little")
        if not _BYTES[0] <= length <= _BYTES[1]:
            self._heard += header
            raise _BadAnswerError(f"it announced {length} bytes, which no picture has")
        jpeg = self._exactly(length, deadline_s)
        if not (jpeg.startswith(b"\xff\xd8") and jpeg.endswith(b"\xff\xd9")):
            raise _BadAnswerError(f"it sent {length} bytes that are no JPEG")
        return jpeg

    def _exactly(self, size: int, deadline_s: float) -> bytes:
        data = b""
        give_up_s = self._clock() + _ANSWER_S
        while len(data) < size:
            if self._clock() >= min(give_up_s, deadline_s):
                if data:
                    raise _BadAnswerError(f"it stopped after {len(data)} of {size} bytes")
                raise _NoAnswerError
            if piece := self._read(size - len(data)):
                data += piece
                give_up_s = self._clock() + _ANSWER_S
        return data

    def _drain(self, silence_s: float, deadline_s: float) -> None:
        """Throw away what comes, until nothing has come for ``silence_s``."""
        quiet_s = self._clock() + silence_s
        while self._clock() < min(quiet_s, deadline_s):
            if data := self._read(_CHUNK_BYTES):
                self._heard = (self._heard + data)[-_HEARD_BYTES:]
                quiet_s = self._clock() + silence_s
        if _is_text(self._heard) and _ARM_TALK.search(self._heard):
            raise CameraError(
                f"{self.name} answers like the arm ({_quote(self._heard)}); name the camera's port, or leave it out to find "
                "the camera by its USB id"
            )

    def _no_picture(self, complaint: str) -> CameraError:
        if _is_text(self._heard):
            complaint = f"it sent the text {_quote(self._heard)}, so its script is not running"
        return CameraError(
            f"{self.name} gave no picture within {self._timeout_s:g} s: {complaint}; check that this is the camera's port, "
            f"that {OPENMV_SCRIPT} is on the camera as main.py and that OpenMV IDE is closed, then plug it in anew"
        )

    def _read(self, size: int) -> bytes:
        try:
            return self._open_port().read(min(size, _CHUNK_BYTES))
        except BROKEN as error:
            raise self._lost(error) from error

    def _write(self, data: bytes) -> None:
        try:
            self._open_port().write(data)
        except BROKEN as error:
            raise self._lost(error) from error

    def _open_port(self) -> Port:
        if self._port is None:
            raise CameraError(f"{self.name} is closed; open it again")
        return self._port

    def _lost(self, error: Exception) -> CameraError:
        return CameraError(f"{self.name} is gone ({error}); check the USB cable, then start again")

    def close(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            with suppress(*BROKEN):
                port.close()

    def __enter__(self) -> OpenMVCamera:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _is_text(data: bytes) -> bool:
    return len(data) >= 4 and all(byte in b"\t\r\n" or 32 <= byte < 127 for byte in data)


def _quote(data: bytes) -> str:
    return repr(data[:40].decode("ascii"))


def _decode(data: bytes) -> Picture | None:
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if picture is None else picture.astype(np.uint8, copy=False)


def _agree(picture: Picture, other: Picture) -> bool:
    if picture.shape != other.shape:
        return False
    coarse, other_coarse = (cv2.resize(each, _GRID, interpolation=cv2.INTER_AREA) for each in (picture, other))
    return int(cv2.absdiff(coarse, other_coarse).max()) <= _MAX_DIFFERENCE


class Webcam:
    """A camera that OpenCV can open, by its number or by the path of its device (or of a film), at a fixed picture size."""

    def __init__(self, index: int | str | None = None, *, width: int = 640, height: int = 480) -> None:
        width, height = checks.integer("width", width, low=16), checks.integer("height", height, low=16)
        index = 0 if index is None else index
        self.name = f"webcam {index}"
        level = cv2.utils.logging.setLogLevel(_LOG_ERRORS)  # a missing camera is explained better below
        self._capture = cv2.VideoCapture(index)
        cv2.utils.logging.setLogLevel(level)
        try:
            if not self._capture.isOpened():
                raise CameraError(
                    f"{self.name} cannot be opened; check the cable and the number (0 is the first camera; on Linux ls "
                    "/dev/video*), and that no other program uses it"
                )
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
            self._shape = (height, width, 3)
            self.read()
        except BaseException:
            self.close()
            raise

    def read(self) -> Picture:
        # The driver has pictures in store that are older than this call; it waits 10 s at most for a new one.
        for _ in range(_STORED_PICTURES):
            self._capture.grab()
        good, picture = self._capture.read()
        if not good or picture is None:
            raise CameraError(f"{self.name} gives no picture; check the cable, then start again")
        if picture.shape != self._shape:
            raise CameraError(
                f"{self.name} gives pictures of {picture.shape[1]} x {picture.shape[0]} where {self._shape[1]} x "
                f"{self._shape[0]} were asked for; ask for a size that it has, and calibrate at that size"
            )
        return picture.astype(np.uint8, copy=False)

    def close(self) -> None:
        self._capture.release()

    def __enter__(self) -> Webcam:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class StillImages:
    """A picture file, again and again, or the pictures of a folder, one after another in the order of their names."""

    def __init__(self, path: str | Path) -> None:
        path = Path(path)
        self.name = f"the pictures in {path}"
        self._repeat = not path.is_dir()
        self._paths = [path] if self._repeat else picture_files(path)
        self._next = 0

    def read(self) -> Picture:
        if self._next == len(self._paths):
            raise CameraError(f"{self.name} are used up ({self._next}); put more into the folder")
        picture = read_picture(self._paths[self._next])
        self._next += not self._repeat
        return picture

    def close(self) -> None:
        pass

    def __enter__(self) -> StillImages:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        pass


def picture_files(folder: Path) -> list[Path]:
    """The picture files of a folder, in the order of their names; ``CameraError`` if there are none."""
    if not folder.is_dir():
        raise CameraError(f"there is no folder {folder}; name the folder that holds the pictures")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES)
    if not paths:
        raise CameraError(f"{folder} holds no pictures ({', '.join(_SUFFIXES)}); put some there, or name another folder")
    return paths


def write_picture(path: Path, picture: Picture) -> None:
    """Write a picture (BGR) as PNG, whole or not at all."""
    files.replace(path, png(picture))


def png(picture: Picture) -> bytes:
    """A picture (BGR) as PNG."""
    _, data = cv2.imencode(".png", picture)
    return data.tobytes()


def read_picture(path: Path) -> Picture:
    """A picture file as BGR, shape (h, w, 3); ``CameraError`` if there is none or it is damaged."""
    try:
        picture = _decode(path.read_bytes())
    except OSError as error:
        raise CameraError(f"the picture {path} cannot be read ({error.strerror}); check the path") from error
    if picture is None:
        raise CameraError(f"{path} is not a picture that can be read, or it is damaged; take it anew")
    return picture
