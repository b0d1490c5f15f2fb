"""Where the numbers come from: every run with its engine and the hashes of its files, and what the report was made with."""

from __future__ import annotations

import hashlib
import platform
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from uarm_rl import files
from uarm_rl.report import tables
from uarm_rl.report.inventory import inventory
from uarm_rl.report.tables import Document, Section, Table

_HASHED: Final = (files.POLICY, files.PROGRESS, "evaluation.csv")
_DIGITS: Final = 16
_PACKAGES: Final = ("uarm-rl", "numpy", "pandas", "matplotlib", "viser", "pybullet", "mujoco", "torch")


def provenance(results_dir: Path) -> Section:
    """A section of the page alone: what is installed here belongs into no file that another machine shall repeat."""
    rows = [
        [
            run.name,
            run.method,
            run.state,
            str(run.seed),
            str(run.episodes or "-"),
            run.engine or "-",
            tables.percent(run.success),
            *(_hash(run.folder / name) for name in _HASHED),
        ]
        for run in inventory(results_dir)
    ]
    # Numbers on the right, as elsewhere; the words between them come first.
    headings = ("Run", "Method", "State", "Seed", "Episodes", "Engine", "Success", *(f"SHA-256 of {name}" for name in _HASHED))
    words = (
        f"The first {_DIGITS} digits of each hash, as `sha256sum` prints it. Engine: that of the training, and of the test "
        "where it is another; success: on the test positions, or on the validation positions where none was made."
    )
    made = Table(("With", "Version"), _made_with(), left=2)
    return Section(page=Document(made, Table(headings, rows, left=3, title=f"Runs: {len(rows)}"), words))


def _hash(path: Path) -> str:
    try:
        return f"`{hashlib.sha256(files.read(path)).hexdigest()[:_DIGITS]}`"
    except OSError:
        return "-"


def _made_with() -> list[tuple[str, str]]:
    """The program, what it stands on, and the machine: the page was made here, the runs may come from elsewhere."""
    installed = []
    for name in _PACKAGES:
        try:
            installed.append((name, version(name)))
        except PackageNotFoundError:
            installed.append((name, "not installed"))
    return [
        *installed,
        ("Python", platform.python_version()),
        ("System", f"{platform.system()} {platform.machine()}"),
        ("Processor", _processor()),
    ]


def _processor() -> str:
    """Its name, as far as the system tells."""
    try:
        found = re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return (found[1] if found else platform.processor()) or "unknown"
