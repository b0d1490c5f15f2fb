"""What the shell may offer behind a command: its groups with their choices, its settings, and paths."""

from __future__ import annotations

from glob import glob
from pathlib import Path
from typing import Any

from uarm_rl.commands import COMMANDS
from uarm_rl.configuration import Settings, choices, compose, keys

#: Settings whose values are paths, wherever they are.
_PATHS = ("run", "policy", "out", "results_dir", "positions", "port", "pictures", "calibration", "lens", "observations")


def candidates(line: str) -> list[str]:
    """Completions of the last word of a command line, each a whole word."""
    _, *words = line.split(" ")
    if len(words) <= 1 or words[0] not in COMMANDS:
        return [name for name in COMMANDS if name.startswith(words[0] if words else "")]
    command, word = words[0], words[-1]
    dashes = "--" if word.startswith("--") else ""
    name, equals, value = word.removeprefix(dashes).partition("=")
    settings = compose(command, (), incomplete=True)
    if not equals:
        names = [f"{key}=" for key in (*_groups(settings), *keys(settings))]
        return sorted({f"{dashes}{one}" for one in names if one.startswith(name)})
    return [f"{dashes}{name}={one}" for one in _values(name, settings) or _files(name, value) if one.startswith(value)]


def _groups(settings: Settings) -> list[str]:
    """The groups that a command has: those of its settings that are groups with choices."""
    return [name for name in (*settings, "experiment") if choices(name) and (name in settings or "episodes" in settings)]


def _values(name: str, settings: Settings) -> list[str]:
    value: Any = settings
    for part in name.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return ["true", "false"] if isinstance(value, bool) else choices(name)


def _files(name: str, value: str) -> list[str]:
    if name.rpartition(".")[2] not in _PATHS:
        return []
    return [f"{path}/" if Path(path).is_dir() else path for path in sorted(glob(f"{value}*"))]
