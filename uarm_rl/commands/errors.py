"""One sentence and an exit code for every error, in words that a terminal can show."""

from __future__ import annotations

from typing import Final

from uarm_rl.checks import UsageError, how_to_add
from uarm_rl.task.arm import ArmError

#: Libraries that an installation may lack on purpose.
_MISSING: Final = {
    "onnx": f"export needs it; {how_to_add('export')}",
    "cv2": f"camera and emulator need it; {how_to_add('real')}",
    "termios": "the emulator's ports are pseudo-terminals, which Windows does not have",
    "torch": "training needs it; pip install -c constraints.txt torch",
}
_ENGINES: Final = ("pybullet", "mujoco", "viser", "ompl")  # their modules say it themselves


def explain(error: Exception) -> tuple[str, int]:
    """A sentence and an exit code for an exception: 2 for a command line that asks for what is not there, or may
    not be, and 1 for a command that failed."""
    sentence = " ".join(str(error).split()) or type(error).__name__
    module = type(error).__module__
    if module.startswith(("hydra", "omegaconf")):
        return f"{sentence.split(' See https')[0]}; --help lists what there is", 2
    if module.startswith(("submitit", "ray")):
        last = str(error).strip().splitlines()[-1:]
        return f"a job of the launcher did not end: {' '.join(last) or type(error).__name__}; resume=true continues it", 1
    if isinstance(error, OSError) and error.strerror is not None:
        what = f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
        remedy = (
            "check the path" if isinstance(error, FileNotFoundError) else "check the path, its permissions and the free space"
        )
        return f"{what}; {remedy}", 1
    if isinstance(error, ModuleNotFoundError) and error.name in _MISSING:
        return f"{error.name} is not installed; {_MISSING[error.name]}", 2
    if isinstance(error, ModuleNotFoundError) and error.name in _ENGINES:
        return sentence, 2
    if isinstance(error, MemoryError) or "can't allocate memory" in sentence or "out of memory" in sentence:
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
