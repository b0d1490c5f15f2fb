"""One sentence and an exit code for every error, in words that a terminal can show."""

from __future__ import annotations

import difflib
import re
from typing import Final

from uarm_rl.checks import UsageError
from uarm_rl.commands import COMMANDS
from uarm_rl.configuration import compose, groups, keys
from uarm_rl.task.arm import ArmError

_SIMULATION: Final = "training and simulation need Python 3.10 or 3.11 on Linux x86-64, where pip installs it with uarm-rl"
#: Libraries that an installation may lack on purpose.
_MISSING: Final = {
    "cv2": "camera and emulator need it; in the checkout: pip install -c constraints.txt -e '.[real]'",
    "torch": _SIMULATION,
    "pybullet": _SIMULATION,
}


def explain(error: Exception) -> tuple[str, int]:
    """A sentence and an exit code for an exception: 2 for a wrong command line, 1 for a command that failed."""
    sentence = " ".join(str(error).split()) or type(error).__name__
    module = type(error).__module__
    if module.startswith(("hydra", "omegaconf")):
        return _explain_override(sentence), 2
    if isinstance(error, OSError) and error.strerror is not None:
        what = f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
        return f"{what}; check the path, its permissions and the free space", 1
    if isinstance(error, ModuleNotFoundError) and error.name in _MISSING:
        return f"{error.name} is not installed; {_MISSING[error.name]}", 1
    if isinstance(error, MemoryError) or "can't allocate memory" in sentence:
        return "there is not enough memory for this; look for a size in the configuration that is far too large", 1
    if isinstance(error, RecursionError):
        return "something is nested too deeply to be read; look for a list of lists of lists", 1
    if isinstance(error, UsageError) or type(error) is ValueError:
        return sentence, 2
    if isinstance(error, (ValueError, ArmError)) or module.startswith("uarm_rl"):
        return sentence, 1
    return f"{type(error).__name__}: {sentence}; this is a bug, UARM_RL_TRACEBACK=1 shows where", 1


def printable(text: str) -> str:
    """Text from a file or a command line as a terminal may show it: no control characters, not without end."""
    shown = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
    return shown if len(shown) <= 1000 else f"{shown[:1000]}..."


def _explain_override(sentence: str) -> str:
    """Hydra's own sentence without what only its developers need."""
    if match := re.search(r"Could not override '([^']+)'", sentence):
        return f"there is no setting {match[1]!r}; {_meant(match[1]) or '--help and --cfg job list the settings'}"
    if match := re.search(r"Ambiguous value for argument '([^']+)'", sentence):
        name, _, value = match[1].partition("=")
        return f"{match[1]} are several values: with -m there is a run for each; one list is written {name}=[{value}]"
    if match := re.search(r"Could not find '([^']+)' Available options in '([^']+)': (.*?) Config search path", sentence):
        return f"there is no {match[1]!r}; {match[2]} is one of {match[3].replace(' ', ', ')}"
    if match := re.search(r"No match in the defaults list for '([^']+)'|Could not override '([^']+)'\. No match", sentence):
        return f"there is no group or setting {match[1] or match[2]!r}; {_meant(match[1]) or '--help lists what there is'}"
    if re.search(r"Lexer|no viable alternative|mismatched|extraneous|token", sentence):
        return f"an override cannot be read ({sentence.split(' See https')[0]}); write name=value, lists as [1,2,3]"
    return f"{sentence.split(' Config search path')[0].split(' See https')[0]}; --help lists what there is"


def _meant(name: str) -> str:
    """The setting that was probably meant, as a question; empty if none is near."""
    names = {name for command in COMMANDS for name in keys(compose(command, incomplete=True))} | set(groups())
    near = difflib.get_close_matches(name, sorted(names), n=1)
    return f"did you mean {near[0]}?" if near else ""
