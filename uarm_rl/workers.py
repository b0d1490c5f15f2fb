"""Processes that work beside this one: how they begin, the same everywhere.

They are spawned, a new interpreter each. A fork would copy a process in which an engine, BLAS and the thread of a progress
bar are running, of which none promises to survive that, and not every system has a fork.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from multiprocessing.connection import wait
from typing import Final

from threadpoolctl import threadpool_limits

from uarm_rl import signals

CONTEXT: Final = multiprocessing.get_context("spawn")


def begin() -> None:
    """The first call in a worker: a stop is its parent's business, and it ends when its parent does, however that ends."""
    for number in signals.STOPS:
        signal.signal(number, signal.SIG_IGN)
    one_thread()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def one_thread() -> None:
    """Keep BLAS to one thread in this process: one observation is no work for two, and they would change the last bits."""
    threadpool_limits(1, user_api="blas")


def cores() -> int:
    """How many of the machine's cores this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # macOS and Windows have none
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
