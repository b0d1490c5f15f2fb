"""What the command line says: overview, help, and one sentence for every error. No configuration is read here."""

from __future__ import annotations

import re
from importlib import resources
from typing import Final

from uarm_rl.arm import ArmError

COMMANDS: Final = {
    "train": "train one policy, or many with -m",
    "evaluate": "test trained policies on the 100 fixed positions",
    "report": "rebuild all tables and figures from the CSV files in results/",
    "render": "film a policy as GIF or MP4",
    "run-real": "trials of a policy on the real arm",
    "jog": "move one joint of the real arm by a few degrees",
    "doctor": "look at everything that the real arm needs",
    "calibrate-camera": "measure the camera's lens",
    "calibrate-hand-eye": "measure where the camera sits on the arm",
    "emulate": "a stand-in for arm and camera on two pseudo-terminals",
}

EXAMPLES: Final = {
    "train": (
        "uarm-rl train experiment=C episodes=100             method C of the paper, for a short budget",
        "uarm-rl train buffer=adaptive reward=penalty seed=1 the same method, chosen by its parts",
        "uarm-rl train -m experiment=A,B,C,D seed=0,1,2      twelve runs; resume=true skips and continues",
    ),
    "evaluate": (
        "uarm-rl evaluate                                    every trained run that has no evaluation yet",
        "uarm-rl evaluate policy=ik                          the inverse-kinematics controller, as a reference",
        "uarm-rl evaluate run=results/adaptive-penalty/seed0 tolerance_m=0.002 out=strict.csv",
        "uarm-rl evaluate positions=heldout out=heldout.csv  that file in the folder of every trained run",
    ),
    "report": (
        "uarm-rl report                                      tables and pictures in results/ and results/ablations/",
        "uarm-rl report results_dir=demo                     the same for another folder of runs",
        "uarm-rl evaluate && uarm-rl report                  test what is new, then report",
    ),
    "render": (
        "uarm-rl render run=results/adaptive-penalty/seed0   episode.gif in the run's folder",
        "uarm-rl render run=results/uniform-plain/seed0 position=[0.25,0.1,0.03] out=shaking.gif",
        "uarm-rl render run=results/adaptive-penalty/seed0 policy=ik out=ik.gif",
    ),
    "run-real": (
        "uarm-rl run-real --dry-run --trials 1               show and audit every command, without an arm",
        "uarm-rl run-real --target 0.2 0 0.03 --policy ik    without a camera: the object lies where you say",
        "uarm-rl run-real --port /dev/ttyACM0 --trials 50    the default policy, the object found with the camera",
    ),
    "jog": (
        "uarm-rl jog --joint 1 --degrees 5                   turn the base by 5 degrees and tell which way is right",
        "uarm-rl jog joint=2 degrees=-5 port=/dev/ttyACM0    the same notation as everywhere",
    ),
    "doctor": (
        "uarm-rl doctor                                      ports, arm, camera, calibration, policy",
        "uarm-rl doctor --port /dev/ttyACM0 camera=none      a certain port, and no camera",
    ),
    "calibrate-camera": (
        "uarm-rl calibrate-camera                            take pictures of the board, press Enter for each",
        "uarm-rl calibrate-camera camera=none pictures=boards pictures that are in a folder already",
    ),
    "calibrate-hand-eye": (
        "uarm-rl calibrate-hand-eye                          touch marks with the cup and look at them from above",
        "uarm-rl calibrate-hand-eye camera=none observations=seen.csv what was touched and seen already",
    ),
    "emulate": (
        "uarm-rl emulate --speed 20                          prints the ports of arm and camera, runs until Ctrl-C",
        "uarm-rl run-real --port PATH --speed 20             the trials against it, in another terminal",
    ),
}

OVERVIEW: Final = """\
uarm-rl: train a uArm Swift Pro to bring its suction cup to an object, in simulation and on the desk.

usage: uarm-rl COMMAND [name=value or --name value ...] [-m]

{commands}

  uarm-rl train experiment=C episodes=100      method C of the paper, for a short budget
  uarm-rl train -m experiment=A,B,C,D seed=0,1 eight runs, one after the other
  uarm-rl evaluate && uarm-rl report           test every trained run, then the table and the pictures

uarm-rl COMMAND --help   what the command does, its groups and values
uarm-rl --version        the version
eval "$(uarm-rl -sc install=bash)"   completion of commands, groups and values in bash
"""


class UsageError(Exception):
    """The command line asks for something that does not exist; the message is a sentence."""


def config_name(command: str) -> str:
    """The configuration file of a command, without its ending."""
    return command.replace("-", "_")


def help_text(command: str) -> str:
    """What a command does, its groups with their choices, and its configuration file, whose comments explain each key."""
    conf = resources.files("uarm_rl.conf")
    defaults, _, values = (conf / f"{config_name(command)}.yaml").read_text(encoding="utf-8").partition("\n\n")
    lines = [f"uarm-rl {command}: {COMMANDS[command]}", "", "Examples:", *(f"  {line}" for line in EXAMPLES[command])]
    groups = [line.split()[1].rstrip(":") for line in defaults.splitlines() if line.startswith("  - ") and ": " in line]
    if groups:
        lines += ["", "Groups (group=choice picks one, group.key=value changes a value in it; --cfg job shows all):"]
    for group in groups:
        folder = group.partition("@")[0]
        names = sorted(path.name.removesuffix(".yaml") for path in (conf / folder).iterdir() if path.name.endswith(".yaml"))
        lines.append(f"  {group:21} {', '.join(names)}")
    shared = (conf / "command.yaml").read_text(encoding="utf-8")
    shared_values = [line for line in shared.splitlines() if line.startswith("results_dir")]
    return "\n".join([*lines, "", "Values (key=value):", *(f"  {line}" for line in [*shared_values, *values.splitlines()])])


#: Hydra's own options are no settings; the command line decides which of them it takes. (``run`` is a setting here.)
_HYDRAS: Final = (
    "help|hydra-help|version|cfg|resolve|package|multirun|shell-completion|config-path|config-name|config-dir|"
    "experimental-rerun|info"
)
_OPTION: Final = re.compile(rf"--(?!(?:{_HYDRAS})(?:=|$))([a-z][\w.@/-]*)(?:=(.*))?", re.DOTALL)
_NUMBER: Final = re.compile(r"-\.?\d.*")
#: Values that Hydra reads without quotes: words, numbers, paths, lists.
_PLAIN: Final = re.compile(r"[\w./:,+@%$\[\]{} -]+", re.ASCII)


def as_overrides(words: list[str]) -> list[str]:
    """``--name value`` as ``name=value``, the one spelling that is read further on.

    ``--dry-run`` is ``dry_run=true``, ``--target 0.2 0 0.03`` is ``target=[0.2,0,0.03]``. All other words stay as they are.
    """
    overrides: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        option = _OPTION.fullmatch(word)
        if option is None:
            overrides.append(word)
            continue
        values = [] if option[2] is None else [option[2]]
        while option[2] is None and rest and not _begins_something(rest[0]):
            values.append(rest.pop(0))
        name = option[1].replace("-", "_")
        text = ",".join(value if _PLAIN.fullmatch(value) else _quoted(value) for value in values)
        overrides.append(f"{name}=[{text}]" if len(values) > 1 else f"{name}={text if values else 'true'}")
    return overrides


def _begins_something(word: str) -> bool:
    return (word.startswith("-") and not _NUMBER.fullmatch(word)) or re.match(r"[a-z][\w.@/]*=", word) is not None


def _quoted(value: str) -> str:
    escaped = value.replace("'", "\\'")
    return f"'{escaped}'"


_SIMULATION: Final = "training and simulation need Python 3.10 or 3.11 on Linux x86-64, where pip installs it with uarm-rl"
#: Libraries that an installation may lack on purpose.
_MISSING: Final = {
    "cv2": "camera and emulator need it: pip install 'uarm-rl[real]'",
    "torch": _SIMULATION,
    "pybullet": _SIMULATION,
}


def groups() -> list[str]:
    """The configuration groups: the folders of ``conf/``."""
    return [path.name for path in resources.files("uarm_rl.conf").iterdir() if path.is_dir()]


def explain(error: Exception) -> tuple[str, int]:
    """A sentence and an exit code for an exception: 2 for a wrong command line, 1 for a command that failed."""
    sentence = " ".join(str(error).split()) or type(error).__name__
    module = type(error).__module__
    if module.startswith(("hydra", "omegaconf")):
        return _explain_override(sentence), 2
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}; check the path, its permissions and the free space", 1
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
        return f"there is no setting {match[1]!r}; --help and --cfg job list the settings"
    if match := re.search(r"Could not find '([^']+)' Available options in '([^']+)': (.*?) Config search path", sentence):
        return f"there is no {match[1]!r}; {match[2]} is one of {match[3].replace(' ', ', ')}"
    if match := re.search(r"No match in the defaults list for '([^']+)'|Could not override '([^']+)'\. No match", sentence):
        return f"there is no group or setting {match[1] or match[2]!r}; --help lists what there is"
    if re.search(r"Lexer|no viable alternative|mismatched|extraneous|token", sentence):
        return f"an override cannot be read ({sentence.split(' See https')[0]}); write name=value, lists as [1,2,3]"
    return f"{sentence.split(' Config search path')[0].split(' See https')[0]}; --help lists what there is"
