"""Sentences for values that a constructor cannot use: what was given and what is allowed."""

from __future__ import annotations

import difflib
import math
import re
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any


class UsageError(Exception):
    """The command line asks for something that does not exist; the message is a sentence."""


def number(name: str, value: object, *, low: float = -math.inf, high: float = math.inf, open_low: bool = False) -> float:
    """``value`` as a float if it is a finite number in [low, high] (``open_low``: in (low, high]).

    Raises :class:`ValueError` with a sentence otherwise.
    """
    allowed = _range(low, high, open_low)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"{name} must be a finite number{allowed}, got {_shown(value)}")
    if not (low < value if open_low else low <= value) or value > high:
        raise ValueError(f"{name} must be a number{allowed}, got {_shown(value)}")
    return float(value)


def integer(name: str, value: object, *, low: int, high: int | None = None) -> int:
    """``value`` as an int if it is a whole number in [low, high]; :class:`ValueError` with a sentence otherwise."""
    top = math.inf if high is None else high
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= top:
        hint = f"; write {name}={value:.0f}" if isinstance(value, float) and value.is_integer() else ""
        hint = f"; give it one, as in {name}=NUMBER" if value is True else hint  # what an option without a value is
        raise ValueError(f"{name} must be a whole number{_range(low, top, False)}, got {_shown(value)}{hint}")
    return value


def numbers(name: str, value: object, example: Sequence[float], what: str) -> list[float]:
    """``value`` as a list if it is finite numbers, as many as the example has; :class:`ValueError` otherwise."""
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != len(example):
        shown = str(list(example)).replace(" ", "")
        raise ValueError(f"{name} must be {what}, as in {name}={shown}, got {_shown(value)}")
    return [number(name, one) for one in value]


def integers(name: str, value: object, *, low: int, high: int) -> list[int]:
    """``value`` as a list if it holds at least one whole number, all in [low, high]; :class:`ValueError` otherwise."""
    if not isinstance(value, Sequence) or isinstance(value, str) or not value:
        raise ValueError(f"{name} must be a list of whole numbers{_range(low, high, False)}, got {_shown(value)}")
    return [integer(name, one, low=low, high=high) for one in value]


def position(name: str, value: object) -> tuple[float, float, float]:
    """``value`` as x, y and z if it is three finite numbers (m); :class:`ValueError` with a sentence otherwise."""
    x, y, z = numbers(name, value, (0.25, 0.1, 0.03), "three numbers in metres")
    return x, y, z


def one_of(name: str, value: object, choices: Sequence[str]) -> str:
    """``value`` if it is one of the words; :class:`ValueError` with a sentence otherwise."""
    if value not in choices:
        raise ValueError(f"{name} must be {' or '.join(choices)}, got {_shown(value)}")
    return str(value)


def boolean(name: str, value: object) -> bool:
    """``value`` if it is a bool; :class:`ValueError` with a sentence otherwise."""
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false, got {_shown(value)}")
    return value


def mapping(name: str, value: object) -> dict[str, Any]:
    """``value`` as a dict if it is one with texts as its keys; :class:`ValueError` with a sentence otherwise."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise ValueError(f"{name} must be a group of settings, got {_shown(value)}")
    return dict(value)


def generator_state(name: str, value: object) -> dict[str, Any]:
    """The state of a numpy generator, as it lies in a file, if it is one; :class:`ValueError` with a sentence otherwise."""
    state = mapping(name, value)
    if state.get("has_uint32") not in (0, 1):  # numpy itself would take others
        raise ValueError(f"{name} is no state of a generator")
    return state


def text(name: str, value: object) -> str:
    """``value`` if it is a text that is not empty; :class:`ValueError` with a sentence otherwise."""
    if not isinstance(value, str) or not value:
        hint = "; is its value missing behind it?" if value is True else ""  # as of --name alone
        raise ValueError(f"{name} must be a text, got {_shown(value)}{hint}")
    return value


def path(name: str, value: object) -> Path:
    """``value`` as a path if it is a text that is not empty; :class:`ValueError` with a sentence otherwise."""
    return Path(text(name, value))


def shell_path(name: str, value: object) -> Path:
    """``value`` as a path if it can stand in a job script: letters, digits and ``. / + , = @ -`` and spaces."""
    if not re.fullmatch(r"[\w./+,=@ -]+", text(name, value)):
        raise ValueError(
            f"{name} must be a path of letters, digits, spaces and . / + , = @ - _ for a cluster, got {_shown(value)}"
        )
    return Path(str(value))


def like(name: str, value: object, example: object) -> None:
    """Raises :class:`ValueError` with a sentence unless ``value`` is of the kind of the ``example`` that a configuration has.

    True or false, a number, a text, a group of settings, or a list of the same; ``None`` and ``"???"`` (which is to be given)
    say nothing.
    """
    if example == "???":
        return
    if isinstance(example, Mapping):
        given = mapping(name, value)
        for key in given.keys() & example.keys():
            like(f"{name}.{key}" if name else key, given[key], example[key])
    elif isinstance(example, bool):
        boolean(name, value)
    elif isinstance(example, (int, float)):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"{name} must be a {'whole ' * isinstance(example, int)}number, got {_shown(value)}")
    elif isinstance(example, str):
        text(name, value)
    elif isinstance(example, list):
        if not isinstance(value, list) or len(value) < min(1, len(example)):
            raise ValueError(f"{name} must be a list, as in {name}={str(example).replace(' ', '')}, got {_shown(value)}")
        for one in value if example else ():
            like(f"each of {name}", one, example[0])


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The known word that is nearest to one that does not exist, as the end of a sentence; empty if none is near."""
    known = list(known)
    near = [one for one in known if one.lower() == word.lower()] or difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def command(results_dir: Path, words: str) -> str:
    """A command of this program for these results, as a user can paste it."""
    where = "" if results_dir == Path("results") else f" results_dir={shlex.quote(str(results_dir))}"
    return f"`uarm-rl {words}{where}`"


def results_folder(results_dir: Path) -> Path:
    """``results_dir`` if it is a folder; :class:`UsageError` with a sentence otherwise."""
    if not results_dir.is_dir():
        raise UsageError(
            f"{results_dir} is not a folder; name one with results_dir=PATH or make one with {command(results_dir, 'train')}"
        )
    return results_dir


def place_of(path: Path) -> Path:
    """``path`` if it is in a folder that exists; :class:`UsageError` with a sentence otherwise."""
    if not path.parent.is_dir():
        raise UsageError(f"there is no folder {path.parent} for {path.name}; make it first, or give another out=FILE")
    return path


def how_to_add(extra: str) -> str:
    """What brings an optional part of the installation, as the end of a sentence."""
    return f"in the checkout: pip install -c constraints.txt -e '.[{extra}]'"


def _shown(value: object) -> str:
    """A value in a sentence, cut where it would fill the screen."""
    if isinstance(value, int) and value.bit_length() > 100:
        return f"a number of about {value.bit_length() * 0.30103:.0f} digits"  # Python refuses to write very long ones
    shown = repr(value)
    return shown if len(shown) <= 60 else f"{shown[:60]}..."


def _range(low: float, high: float, open_low: bool) -> str:
    if low == -math.inf and high == math.inf:
        return ""
    if high == math.inf:
        return f" above {_bound(low)}" if open_low else f" of at least {_bound(low)}"
    if low == -math.inf:
        return f" of at most {_bound(high)}"
    return f" {f'above {_bound(low)} and at most' if open_low else f'from {_bound(low)} to'} {_bound(high)}"


def _bound(value: float) -> str:
    if isinstance(value, int):
        return _shown(value)
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else f"{value:g}"


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Each setting in which two configurations differ, in words, as in ``agent.gamma=0.9, not 0.99``.

    Of a group with another name the name says it all, as in ``sim=pybullet, not mujoco``.
    """
    found = []
    for key in [*before, *(key for key in now if key not in before)]:
        then, wanted = before.get(key), now.get(key)
        if isinstance(then, Mapping) and isinstance(wanted, Mapping) and then.get("name") == wanted.get("name"):
            found += [f"{key}.{inner}" for inner in differences(then, wanted)]
        elif then != wanted:
            found.append(f"{key}={_named(then)}, not {_named(wanted)}")
    return found


def _named(value: Any) -> Any:
    return value.get("name", value) if isinstance(value, Mapping) else value
