"""What happens at the arm right now, in a file for who looks on: one way, from the arm.

``run-real watch=true`` writes ``live.json``, and ``live.png`` where there is a camera, beside its trials, and ``uarm-rl watch``
reads them. Who works with the arm only puts down what is new; a thread writes it, and what goes wrong there is a warning. So
neither a slow disk nor a full one is felt by the arm.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from uarm_rl import checks, files
from uarm_rl.real.swift_arm import ArmState
from uarm_rl.task.arm import JointPositions

log = logging.getLogger(__name__)

LIVE: Final = "live.json"
LIVE_PICTURE: Final = "live.png"
_EVERY_S: Final = 0.05
_ALIVE_S: Final = 1.0  # so often the file is written where nothing is new
_END_S: Final = 1.0
_MAX_BYTES: Final = 1 << 16
_MAX_PICTURE_BYTES: Final = 1 << 25
_LONGEST: Final = 500  # letters of what is said
_PUMPS: Final = ("unknown", "stopped", "pumping", "holding")


@dataclass(frozen=True)
class Live:
    """A moment at the arm. Joints are joint1 to joint3 (rad), as they were read last; places are metres in the base frame."""

    joints_rad: JointPositions
    reference_rad: JointPositions  # where the arm was sent to last
    target_m: tuple[float, float, float] | None = None  # centre of the object's upper surface, once it was found
    object_size_m: tuple[float, float, float] = (0.03, 0.03, 0.03)
    moving: bool = False
    pump: str = "unknown"
    said: str = ""  # the last trial's line
    trials: int = 0  # how many are over
    emulated: bool = False
    ended: bool = False
    written_s: float = 0.0  # since 1970
    pictures: int = 0  # how many the camera has taken

    def __post_init__(self) -> None:
        for name in ("joints_rad", "reference_rad"):
            checks.numbers(name, getattr(self, name), (0.0, 0.0, 0.0), "three numbers")
        if self.target_m is not None:
            checks.position("target_m", self.target_m)
        for side in checks.position("object_size_m", self.object_size_m):
            checks.number("object_size_m", side, low=0.0, open_low=True)
        for name in ("moving", "emulated", "ended"):
            checks.boolean(name, getattr(self, name))
        for name in ("trials", "pictures"):
            checks.integer(name, getattr(self, name), low=0)
        checks.one_of("pump", self.pump, _PUMPS)
        checks.number("written_s", self.written_s)
        if not isinstance(self.said, str) or len(self.said) > _LONGEST:
            raise ValueError(f"said must be a text of at most {_LONGEST} letters")


def read(folder: Path) -> Live | None:
    """The newest moment; ``None`` where none was written, or it is being written, or it is none."""
    try:
        values: dict[str, Any] = json.loads(files.read(folder / LIVE, at_most=_MAX_BYTES))
        return Live(
            **{  # type: ignore[arg-type]
                key: tuple(value) if isinstance(value, list) else value for key, value in values.items()
            }
        )
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return None


def read_picture(folder: Path) -> bytes | None:
    """The newest picture, as PNG; ``None`` if there is none."""
    with suppress(OSError):
        return files.read(folder / LIVE_PICTURE, at_most=_MAX_PICTURE_BYTES)
    return None


class LiveFile:
    """Writes the files while it is open; a context manager. None of its methods waits or raises."""

    def __init__(
        self,
        folder: Path,
        *,
        emulated: bool,
        object_size_m: tuple[float, float, float],
        encode: Callable[[Any], bytes] | None = None,
    ) -> None:
        self._folder, self._encode, self._emulated, self._object_size_m = folder, encode, emulated, object_size_m
        self._state: ArmState | None = None
        self._said, self._trials, self._picture, self._pictures = "", 0, None, 0
        self._ended, self._warned = False, False
        self._news = threading.Event()
        self._thread = threading.Thread(target=self._work, name="live", daemon=True)  # the end does not wait for a disk

    def moved(self, state: ArmState) -> None:
        """The arm is in another state."""
        self._state = state
        self._news.set()

    def tried(self, line: str) -> None:
        """A trial is over."""
        self._said, self._trials = line[:_LONGEST], self._trials + 1
        self._news.set()

    def looked(self, picture: Any) -> None:
        """The camera has taken a picture."""
        self._picture, self._pictures = picture, self._pictures + 1
        self._news.set()

    def _work(self) -> None:
        written = 0
        while True:
            self._news.wait(_ALIVE_S)
            self._news.clear()
            ended = self._ended
            try:
                if self._encode is not None and self._pictures != written:
                    written = self._pictures
                    _put(self._folder / LIVE_PICTURE, self._encode(self._picture))
                self._write(ended)
            except Exception as error:  # whatever it is, the arm goes on
                if not self._warned:
                    log.warning("what uarm-rl watch would show cannot be written (%s); the trials go on without", error)
                self._warned = True
            if ended:
                return
            time.sleep(_EVERY_S)

    def _write(self, ended: bool) -> None:
        state = self._state
        if state is None:
            return
        live = Live(
            joints_rad=state.joints_rad,
            reference_rad=state.reference_rad,
            target_m=state.target_m,
            object_size_m=self._object_size_m,
            moving=state.moving,
            pump="unknown" if state.pump is None else state.pump.name.lower(),
            said=self._said,
            trials=self._trials,
            emulated=self._emulated,
            ended=ended,
            written_s=time.time(),
            pictures=self._pictures,
        )
        _put(self._folder / LIVE, json.dumps(asdict(live)).encode())

    def __enter__(self) -> LiveFile:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended = True
        self._news.set()
        self._thread.join(_END_S)


def _put(path: Path, data: bytes) -> None:
    """Replace a file as ``files.replace`` does, without waiting for the disk: after a power failure nobody looks on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.tmp")
    temporary.unlink(missing_ok=True)
    with open(temporary, "xb") as file:
        file.write(data)
    os.replace(temporary, path)


class Watched:
    """A camera whose pictures are told of, too; everything else is the camera's own."""

    def __init__(self, camera: Any, looked: Callable[[Any], None]) -> None:
        self._camera, self._looked = camera, looked

    def read(self) -> Any:
        """A picture of the camera."""
        picture = self._camera.read()
        self._looked(picture)
        return picture

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def __enter__(self) -> Watched:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._camera.close()
