"""Who works in a run's folder: its lock, and a note of who holds it, for disks on which a lock does not reach far.

The lock is the system's (``flock``): it ends with its process, however that ends. Over NFS Linux makes it a lock of the
server, which holds between machines; but a disk mounted with ``nolock`` or ``local_lock`` (NFS) or ``localflock`` (Lustre)
keeps its locks to one machine, and says nothing of it. Therefore the holder keeps a note with its machine beside the lock and
renews the note's time every few seconds. Who gets the lock while the note of another machine is renewed knows that the lock
is worth nothing there. No clocks are compared for that: the note is watched for three renewals. A lock that is refused by the
disk itself is said, not replaced.
"""

from __future__ import annotations

import errno
import os
import platform
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

from filelock import FileLock, Timeout

from uarm_rl import files
from uarm_rl.files import HOLDER, LOCK

#: The note is renewed this often (s).
BEAT_S: Final = 5.0
#: How a disk without locks refuses one.
_NO_LOCKS: Final = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)
#: A note that is older is nobody's (s); for readers, who do not want to wait, by the clock.
STALE_S: Final = 60.0


class LockError(Exception):
    """The folder cannot be had; the message is a sentence."""


class Note(NamedTuple):
    """Who holds a folder. ``renewed_ns`` is when the note was last renewed, by the clock of the disk."""

    host: str
    process: str
    machine: str
    renewed_ns: int

    def __str__(self) -> str:
        return f"{self.host}, process {self.process}"


@contextmanager
def held(run_dir: Path) -> Iterator[None]:
    """Hold the folder's lock. Raises :class:`LockError` if another has it, or if there can be no lock.

    A link or a pipe in its place is refused.
    """
    path = run_dir / LOCK
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise LockError(f"{path} is no plain file; remove it, or choose another name")
    lock = FileLock(path, timeout=0.5, fallback_to_soft=False)  # `uarm-rl runs` may be looking, for a moment
    try:
        lock.acquire()
    except Timeout:
        who = read(run_dir / HOLDER)
        raise LockError(
            f"another process is training in {run_dir}{f' ({who})' if who else ''}; wait for it or choose another name"
        ) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        raise LockError(
            f"{path}: this disk has no locks, without which two processes could train in one folder; have it mounted with them "
            "(NFS: with its lock service; Lustre: with flock), or take a results_dir elsewhere"
        ) from None
    try:
        _watch(run_dir)
        with _renewed(run_dir / HOLDER):
            yield
    finally:
        lock.release()


def holder(run_dir: Path) -> str:
    """Who trains in a folder, as in ``node7, process 4711``; empty if nobody does. Reads, and changes nothing."""
    note = read(run_dir / HOLDER)
    if _is_locked(run_dir / LOCK):
        return str(note or "a process")
    elsewhere = note is not None and note.machine != _machine()
    return str(note) if note and elsewhere and time.time() - note.renewed_ns / 1e9 < STALE_S else ""


def read(path: Path) -> Note | None:
    """The note there; ``None`` if there is none, or something else."""
    try:
        with open(path, "rb") as file:  # opened anew each time: over NFS that is what looks at the server
            words, status = file.read(500).decode(errors="replace").split(), os.fstat(file.fileno())
    except OSError:
        return None
    if len(words) != 3 or not "".join(words).isprintable():
        return None
    return Note(words[0], words[1], words[2], status.st_mtime_ns)


def _watch(run_dir: Path) -> None:
    """Raises :class:`LockError` if another machine holds the folder in spite of the lock that this one got."""
    note = read(run_dir / HOLDER)
    if note is None or note.machine == _machine():
        return  # on one machine every disk's locks hold
    until = time.monotonic() + 3 * BEAT_S
    while time.monotonic() < until:
        time.sleep(BEAT_S / 10)
        now = read(run_dir / HOLDER)
        if now is None:
            return
        if now != note:
            raise LockError(
                f"another process is training in {run_dir} ({now}), and its lock does not reach this machine: the disk is "
                "mounted without locks between machines (NFS: nolock, local_lock; Lustre: localflock); let one machine use it"
            )


@contextmanager
def _renewed(path: Path) -> Iterator[None]:
    """Keep a note there, whose time is renewed."""
    files.write_and_flush(path, f"{platform.node() or 'unnamed'} {os.getpid()} {_machine()}\n".encode())
    done = threading.Event()

    def renew() -> None:
        while not done.wait(BEAT_S):
            with suppress(OSError):
                os.utime(path)

    thread = threading.Thread(target=renew, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        with suppress(OSError):
            path.unlink(missing_ok=True)


@cache
def _machine() -> str:
    """What tells this machine from others that have its name, as containers do: the start of its system."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return platform.node() or "unnamed"


def _is_locked(path: Path) -> bool:
    if path.is_symlink() or not path.is_file():
        return False
    try:
        with FileLock(path, timeout=0, fallback_to_soft=False):
            return False
    except Timeout:
        return True
    except OSError:  # a folder that is only to be read, a disk without locks
        return False
