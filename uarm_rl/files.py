"""Files that are whole or not there at all: written beside, flushed, renamed, and the rename flushed too."""

from __future__ import annotations

import os
from pathlib import Path


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


def write_and_flush(path: Path, data: bytes) -> None:
    """Write a file and have it on the disk when this returns."""
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def flush_folder(folder: Path) -> None:
    """Have the names in a folder on the disk: without it a rename may be undone by a power failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
