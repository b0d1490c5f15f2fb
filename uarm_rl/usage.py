"""What the command line says: overview, help, and one sentence for every error. No configuration is read here."""

from __future__ import annotations

import re
from importlib import resources
from typing import Final

from uarm_rl.arm import ArmError

COMMANDS: Final = {
    "train": "train one policy, or many with -m",
    "evaluate": "test trained policies on the 100 fixed positions",
    "report": "rebuild Table 1 and the figures from the CSV files in results/",
    "render": "film a policy as GIF or MP4",
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
    ),
    "report": (
        "uarm-rl report                                      table1.md, table1.csv and the pictures in results/",
        "uarm-rl report results_dir=demo                     the same for another folder of runs",
        "uarm-rl evaluate && uarm-rl report                  test what is new, then report",
    ),
    "render": (
        "uarm-rl render run=results/adaptive-penalty/seed0   episode.gif in the run's folder",
        "uarm-rl render run=results/uniform-plain/seed0 position=[0.25,0.1,0.03] out=shaking.gif",
        "uarm-rl render run=results/adaptive-penalty/seed0 policy=ik out=ik.gif",
    ),
}

OVERVIEW: Final = """\
uarm-rl: train a uArm Swift Pro to bring its suction cup to an object, in simulation and on the desk.

usage: uarm-rl COMMAND [name=value ...] [-m]

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


def help_text(command: str) -> str:
    """What a command does, its groups with their choices, and its configuration file, whose comments explain each key."""
    conf = resources.files("uarm_rl.conf")
    defaults, _, values = (conf / f"{command}.yaml").read_text(encoding="utf-8").partition("\n\n")
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


def explain(error: Exception) -> tuple[str, int]:
    """A sentence and an exit code for an exception: 2 for a wrong command line, 1 for a command that failed."""
    sentence = " ".join(str(error).split()) or type(error).__name__
    module = type(error).__module__
    if module.startswith(("hydra", "omegaconf")):
        return _explain_override(sentence), 2
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}; check the path, its permissions and the free space", 1
    if isinstance(error, UsageError) or type(error) is ValueError:
        return sentence, 2
    if isinstance(error, (ValueError, ArmError)) or module.startswith("uarm_rl"):
        return sentence, 1
    return f"{type(error).__name__}: {sentence}; this is a bug, UARM_RL_TRACEBACK=1 shows where", 1


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
