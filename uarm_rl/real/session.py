"""A session at the arm: connecting, and keeping what its trials give."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

from uarm_rl import columns, csvfile, files
from uarm_rl.checks import UsageError
from uarm_rl.csvfile import Logbook
from uarm_rl.real.link import open_link
from uarm_rl.real.ports import ARM, emulated_speed, is_emulated, named_port
from uarm_rl.real.swift_arm import SwiftArm
from uarm_rl.real.trials import Row, Trial

TRIALS: Final = "trials.csv"


def connect(port: str | None, *, speed: float | None = None, **keywords: Any) -> SwiftArm:
    """The arm at ``port``, or the one that is plugged in; the keywords are those of ``SwiftArm``.

    ``speed``: of an emulator, which need not be told where the emulator says it. Raises :class:`UsageError` for any of a real
    arm, and for another than the emulator says.
    """
    name = named_port(ARM, port)
    own = emulated_speed(name) if is_emulated(name) else 1.0
    if speed is not None and speed != own:
        if not is_emulated(name):
            raise UsageError(f"speed={speed:g} is for an emulator, and {name} is no pseudo-terminal; leave speed out")
        if own is not None:
            raise UsageError(f"speed={speed:g}, and the emulator at {name} runs with {own:g}; leave speed out")
    return SwiftArm(open_link(name), speed=speed or own or 1.0, **keywords)


def recorded(folder: Path) -> list[Row]:
    """The trials that are in a folder already. Raises ``CsvError`` for a damaged file."""
    if not (folder / TRIALS).exists():
        return []
    table = csvfile.read(folder / TRIALS, columns.TRIALS)
    return [dict(zip(table.values, row, strict=True)) for row in zip(*table.values.values(), strict=True)]


def record(trials: Iterable[Trial], folder: Path, config: str, *, emulated: bool, keep_rows: int = 0) -> Iterator[Row]:
    """Write each trial's row and picture as it comes, and yield the row; ``config`` is kept beside them.

    Behind the first ``keep_rows`` rows of a series that is continued; else what is in the folder is replaced.
    """
    pictures = folder / files.PICTURES
    pictures.mkdir(parents=True, exist_ok=True)
    for old in pictures.glob("trial-*.png") if not keep_rows else ():
        old.unlink()
    files.replace(folder / files.CONFIG, config.encode())
    logbook = Logbook(folder / TRIALS, columns.TRIALS, keep_rows=keep_rows)
    try:
        for trial in trials:
            row = trial.row | {"emulated": emulated}
            logbook.add(row)
            if trial.picture is not None:
                from uarm_rl.real.vision.camera import write_picture

                write_picture(pictures / f"trial-{row['trial']:03d}.png", trial.picture)
            yield row
    finally:
        logbook.close()
