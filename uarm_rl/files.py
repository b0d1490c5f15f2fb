"""Files that are whole or not there at all: written beside, flushed, renamed, and the rename flushed too.

A run folder may come from somebody else, so what is read must be a plain file of a sensible size, and nothing is
written through a link that waits there.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
import tempfile
from pathlib import Path
from typing import Final

#: The files of a run's folder.
CONFIG: Final = "config.yaml"
PROGRESS: Final = "progress.csv"
POLICY: Final = "policy.safetensors"
LOCK: Final = ".lock"  # held by the process that trains there
PRUNED: Final = ".pruned"  # beside a run's folder: its sweep ended it, and it is not to be continued
PICTURES: Final = "pictures"  # a folder, of what the camera saw, beside the trials of an arm
HOLDER: Final = ".holder"  # which that is, renewed while it trains


def replace(path: Path, data: bytes) -> None:
    """Write a file so that a crash at any instant leaves either the old or the new content, never a part.

    Raises :class:`OSError` if it cannot be written; the old content is then still there.
    """
    temporary = path.with_name(path.name + ".tmp")
    try:
        write_and_flush(temporary, data)
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    flush_folder(path.parent)


def check_place(path: Path) -> None:
    """Raises :class:`OSError` if no file can be written there, by trying: permissions say nothing of root and of odd disks."""
    folder = path.parent
    while not folder.exists():
        folder = folder.parent
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


def read(path: Path, *, at_most: int = 1 << 28) -> bytes:
    """The content of a plain file of ``at_most`` so many bytes.

    Raises :class:`OSError`, at once, for anything else: a pipe would be waited for, a device never end.
    """
    with open(path, "rb", opener=_at_once) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "this is no plain file", str(path))
        if status.st_size > at_most:
            raise OSError(errno.EFBIG, f"it is larger than {at_most:,} bytes, as no file of its kind is", str(path))
        return file.read()


def _at_once(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)  # Windows has no pipes among its files


def remove(path: Path) -> None:
    """Delete whatever is there, if anything is: a file, a folder, a link (not what it points to)."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def write_and_flush(path: Path, data: bytes) -> None:
    """Write a new file and have it on the disk when this returns; what was there, a link even, is removed."""
    path.unlink(missing_ok=True)
    with open(path, "xb", opener=_at_once) as file:  # which follows no link
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def flush_folder(folder: Path) -> None:
    """Have the names in a folder on the disk: without it a rename may be undone by a power failure. (Windows cannot.)"""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
