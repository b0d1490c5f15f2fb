"""Serves an emulated device on a raw pseudo-terminal, for any program that can open a serial port."""

from __future__ import annotations

import os
import select
import threading
import time
from contextlib import suppress
from types import TracebackType
from typing import Protocol

from uarm_rl import checks

MAX_SPEED = 50.0
_POLL_S = 0.002
_MAX_STEP_S = 0.1  # of device time in one go; a world that cannot keep up slows down rather than jumps
_MAX_UNREAD_BYTES = 1 << 20  # what waits for a client that does not read; more is lost


class Device(Protocol):
    """Bytes and time in, bytes out: ``Firmware``, or the camera."""

    now_s: float
    unplugged: bool

    def reset(self) -> None:
        """Start anew."""
        ...

    def advance(self, to_s: float, received: bytes = b"") -> bytes:
        """Let time pass until ``to_s``, then receive bytes; returns what was sent meanwhile."""
        ...


class PtyServer:
    """A thread that moves bytes between ``device`` and the terminal ``path``; a context manager.

    ``speed``: seconds of the device's time in a second. As on the real arm, opening the port resets the controller
    (``reset_on_open``; a close and an open within 2 ms pass unnoticed). An unplugged cable closes the terminal: the
    client sees its end of file or an I/O error.
    """

    def __init__(self, device: Device, *, speed: float = 1.0, reset_on_open: bool = True) -> None:
        import tty  # here, because Windows lacks it and devices in memory do without

        self._device = device
        self._speed = checks.number("speed", speed, low=0.0, high=MAX_SPEED, open_low=True)
        self._reset_on_open = reset_on_open
        self._master, slave = os.openpty()
        try:
            tty.setraw(slave)
            os.set_blocking(self._master, False)
            self.path = os.ttyname(slave)
        finally:
            os.close(slave)  # so that the first client's open can be told from none
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._serve, name=f"serves {self.path}", daemon=True)

    def __enter__(self) -> PtyServer:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the service ends by itself (unplugged, or broken); whether it did."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def close(self) -> None:
        """Stop serving; raises what the device or the world behind it raised meanwhile."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _serve(self) -> None:
        try:
            self._loop()
        except BaseException as error:  # the thread must not take it along
            self._error = error
        finally:
            os.close(self._master)

    def _loop(self) -> None:
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        device_s, wall_s = self._device.now_s, time.monotonic()
        connected = False
        unread = b""  # the terminal takes about 4 kB at a time
        while not (self._stop.is_set() or self._device.unplugged):
            poller.modify(self._master, select.POLLIN | (select.POLLOUT if unread else 0))
            ready = poller.poll(1000.0 * _POLL_S)
            flags = ready[0][1] if ready else 0
            hung_up = bool(flags & select.POLLHUP)
            received = b""
            if flags & select.POLLIN:
                with suppress(OSError):  # EIO: the client has just gone
                    received = os.read(self._master, 4096)
            if hung_up and not received:
                time.sleep(_POLL_S)  # poll does not wait on a terminal that nobody has open
            elif not hung_up and not connected and self._reset_on_open:
                self._device.reset()
            connected = not hung_up
            now_s = time.monotonic()
            device_s, wall_s = device_s + min(self._speed * (now_s - wall_s), _MAX_STEP_S), now_s
            sent = self._device.advance(device_s, received)
            unread = (unread + sent)[:_MAX_UNREAD_BYTES] if connected else b""
            if unread:
                with suppress(OSError):  # full, or the client has just gone
                    unread = unread[os.write(self._master, unread) :]
