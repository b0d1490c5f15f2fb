"""The OpenMV camera as a device: bytes and time in, bytes out. It speaks the ``snap`` protocol of OpenMV's own example.

The host sends the four bytes ``snap``; the camera answers with the number of bytes, 32 bits, little-endian, and so many
bytes of JPEG. Requests are read in groups of four; anything else is ignored, and an incomplete group is forgotten after
5 s, so that a lost byte spoils everything until then.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from uarm_rl.emulator.faults import CameraFault, Fault, Faults

Picture = NDArray[np.uint8]

_REQUEST: Final = b"snap"
_FORGET_S: Final = 5.0
_RX_BYTES: Final = 1024  # what waits while a picture is sent; more is lost
_PACKET_BYTES: Final = 64
_DAMAGED_BYTES: Final = 16


class SnapCamera:
    """``take`` gives the picture of the moment, BGR. ``snap_s``: from request to picture."""

    def __init__(
        self,
        take: Callable[[], Picture],
        *,
        jpeg_quality: int = 90,
        snap_s: float = 0.0,
        faults: tuple[CameraFault, ...] = (),
    ) -> None:
        self.now_s = 0.0
        self.unplugged = False
        self._take = take
        self._quality = jpeg_quality
        self._snap_s = snap_s
        self._faults = Faults(faults)
        self._unplugs_at_s: float | None = None
        self._frozen: bytes | None = None
        self._last = b""
        self.reset()

    def reset(self) -> None:
        """Start the script anew."""
        self._received = bytearray()
        self._group_since_s = self.now_s
        self._busy_until_s = self.now_s
        self._out: list[tuple[float, bytes]] = []  # when, what; in order
        self._packet_period_s = 0.0
        self._silent = False

    def advance(self, to_s: float, received: bytes = b"") -> bytes:
        """Let time pass until ``to_s``, then receive bytes; returns what was sent meanwhile."""
        self.now_s = to_s
        if self._unplugs_at_s is not None and to_s >= self._unplugs_at_s:
            self.unplugged = True
        if len(self._received) < len(_REQUEST) and to_s - self._group_since_s >= _FORGET_S:
            self._received.clear()
        if received and not self._received:
            self._group_since_s = to_s
        self._received += received[: _RX_BYTES - len(self._received)]
        while len(self._received) >= len(_REQUEST) and to_s >= self._busy_until_s:
            group = bytes(self._received[: len(_REQUEST)])
            del self._received[: len(_REQUEST)]
            self._group_since_s = to_s
            if group == _REQUEST:
                self._snap()
        sent = bytearray()
        while self._out and self._out[0][0] <= to_s:
            sent += self._out.pop(0)[1]
        return b"" if self.unplugged else bytes(sent)

    def _snap(self) -> None:
        struck = self._faults.strike("snap")
        self._silent |= "silence" in struck
        if "slow" in struck:
            self._packet_period_s = struck["slow"].delay_s
        if "unplug" in struck:
            self._unplugs_at_s = self.now_s + struck["unplug"].delay_s
        if "frozen" in struck and self._frozen is None:
            self._frozen = self._last or self._jpeg(struck)
        jpeg = self._frozen or self._jpeg(struck)
        self._last = jpeg
        late_s = struck["late"].delay_s if "late" in struck else 0.0
        self._busy_until_s = self.now_s + self._snap_s + late_s
        if not self._silent:
            self._send(_damaged(jpeg, struck))

    def _jpeg(self, struck: dict[str, Fault]) -> bytes:
        picture = self._take()
        if "size" in struck:
            picture = picture[::2, ::2]
        # As the camera's firmware does from quality 60 on: colour at full resolution.
        parameters = [cv2.IMWRITE_JPEG_QUALITY, self._quality]
        parameters += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        return cv2.imencode(".jpg", picture, parameters)[1].tobytes()

    def _send(self, answer: bytes) -> None:
        at_s = self._busy_until_s
        if not self._packet_period_s:
            self._out.append((at_s, answer))
            return
        for start in range(0, len(answer), _PACKET_BYTES):
            at_s += self._packet_period_s
            self._out.append((at_s, answer[start : start + _PACKET_BYTES]))
        self._busy_until_s = at_s


def _damaged(jpeg: bytes, struck: dict[str, Fault]) -> bytes:
    """The answer with this JPEG, after what the faults do to it on its way."""
    header, middle = struct.pack("<I", len(jpeg)), len(jpeg) // 2
    if "truncated" in struck:
        jpeg = jpeg[:middle]
    if "dropped" in struck:
        jpeg = jpeg[:middle] + jpeg[middle + 1 :]
    if "corrupt" in struck:
        wrong = bytes(byte ^ 0x55 for byte in jpeg[middle : middle + _DAMAGED_BYTES])
        jpeg = jpeg[:middle] + wrong + jpeg[middle + _DAMAGED_BYTES :]
    if "length" in struck:
        header = struck["length"].data
    before, after = (struck[effect].data if effect in struck else b"" for effect in ("text", "trailing"))
    return before + (b"" if "lost" in struck else header + jpeg) + after
