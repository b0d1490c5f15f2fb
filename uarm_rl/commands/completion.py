"""What the Tab key offers: commands, options, settings, choices of groups, files."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Mapping
from typing import Any

from uarm_rl.checks import UsageError
from uarm_rl.commands import COMMANDS
from uarm_rl.commands.words import FLAGS, LAUNCHERS, as_overrides, launcher
from uarm_rl.configuration import compose, groups_of


def candidates(line: str) -> list[str]:
    """The words that the last word of a command line, which begins with the program's name, may become."""
    words = line.split()
    word = words.pop() if words and not line[-1].isspace() else ""
    if len(words) < 2:
        return _beginning(word, (*COMMANDS, "--help", "--version") if words else ())
    command, given = words[1], words[2:]
    if command not in COMMANDS:
        return []
    settings, choices = _known(command, given)
    dashes = "--" if word.startswith("--") and "=" in word else ""
    word = word.removeprefix(dashes)
    if word.startswith("-"):
        names = (*choices, *_names(settings, word[2:].replace("-", "_")))
        return _beginning(word, (*FLAGS, *(f"--{name.rstrip('=').replace('_', '-')}" for name in names)))
    if given and given[-1].startswith("--") and given[-1] not in FLAGS and "=" not in given[-1]:
        return _values(given[-1][2:].replace("-", "_"), word, settings, choices)
    name, equals, value = word.partition("=")
    if equals:
        return [f"{dashes}{name}={value}" for value in _values(name.replace("-", "_"), value, settings, choices)]
    return _beginning(word, (*(f"{group}=" for group in choices), *_names(settings, word)))


def _known(command: str, given: list[str]) -> tuple[dict[str, Any], dict[str, list[str]]]:
    """Settings and groups, as far as what was typed already can be read."""
    words = as_overrides(given[:-1] if given and given[-1].startswith("--") else given)
    try:
        settings = compose(command, tuple(word for word in words if not word.startswith("-")), incomplete=True)
    except UsageError:
        settings = compose(command, incomplete=True)
    choices = groups_of(command)
    if {"-m", "--multirun"} & set(given):
        choices["hydra/launcher"] = [*LAUNCHERS]
        settings["hydra"] = {
            "launcher": _nested(LAUNCHERS[chosen].settings) if (chosen := launcher(words)) in LAUNCHERS else {}
        }
    return settings, choices


def _nested(names: Iterable[str]) -> dict[str, Any]:
    """Dotted names as mappings in mappings, without values."""
    found: dict[str, Any] = {}
    for name in names:
        *path, last = name.split(".")
        inner = found
        for key in path:
            inner = inner.setdefault(key, {})
        inner[last] = None
    return found


def _names(settings: Mapping[str, Any], word: str) -> list[str]:
    """Names of settings down to the depth that the word has reached: ``agent.`` and, behind that, ``agent.gamma=``."""
    path, dot, _ = word.rpartition(".")
    inner = _find(settings, path) if dot else settings
    if not isinstance(inner, Mapping):
        return []
    return [f"{path}{dot}{key}{'.' if isinstance(value, Mapping) else '='}" for key, value in inner.items()]


def _values(name: str, value: str, settings: Mapping[str, Any], choices: Mapping[str, list[str]]) -> list[str]:
    """Choices of a group, behind a comma too; true and false; a number that is there; files."""
    if name in choices:
        before, comma, last = value.rpartition(",")
        return [f"{before}{comma}{choice}" for choice in _beginning(last, choices[name])]
    now = _find(settings, name)
    if isinstance(now, bool):
        return _beginning(value, ("true", "false"))
    if isinstance(now, (int, float)):
        return _beginning(value, (str(now),))
    if isinstance(now, str) or (now is None and name in settings):
        found = sorted(glob.glob(f"{glob.escape(value)}*"))
        return [f"{path}/" if os.path.isdir(path) else path for path in found]
    return []


def _find(settings: Mapping[str, Any], path: str) -> Any:
    found: Any = settings
    for key in path.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def _beginning(word: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(word)]
