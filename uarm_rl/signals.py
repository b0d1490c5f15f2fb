"""Signals that ask the program to end, and one way to hear of them."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

#: Ctrl-C, a polite kill, and, where the system knows them, a terminal that closes and what schedulers send before they kill.
STOPS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2") if hasattr(signal, name)
)


@contextmanager
def heard(react: Callable[[int], None]) -> Iterator[None]:
    """``react`` gets the number of every stop while the body runs; afterwards all is as it was before.

    A closed terminal that is ignored (``nohup``) stays ignored. Outside the main thread, where Python knows no handlers,
    nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: FrameType | None) -> None:
        react(number)

    ignored = {number for number in STOPS[2:] if signal.getsignal(number) is signal.SIG_IGN}
    before = {number: signal.signal(number, handle) for number in STOPS if number not in ignored}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def hand_on(number: int) -> None:
    """Let whoever else waits for a stop, as a scheduler's own handler, hear of it too, now that all is in order."""
    if number and callable(handler := signal.getsignal(number)) and handler is not signal.default_int_handler:
        signal.raise_signal(number)


@contextmanager
def deferred() -> Iterator[None]:
    """Hold stops back until the (short) body has run; the first of them strikes then."""
    caught: list[int] = []
    try:
        with heard(caught.append):
            yield
    finally:
        if caught:
            signal.raise_signal(caught[0])


@contextmanager
def interrupt_once() -> Iterator[None]:
    """The first stop raises ``KeyboardInterrupt``; more are ignored, while what it interrupts is put in order."""
    asked = False

    def stop(number: int) -> None:
        nonlocal asked
        if not asked:
            asked = True
            raise KeyboardInterrupt

    with heard(stop):
        yield
