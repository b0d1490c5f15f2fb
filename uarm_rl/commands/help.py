"""What ``--help`` says: of the whole program, and of a command from its docstring and its configuration file."""

from __future__ import annotations

import ast
from importlib import resources
from typing import Final

from uarm_rl.commands import COMMANDS

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


#: Between paragraphs.
NEXT: Final = "\n\n"


def overview() -> str:
    """All commands, a line each."""
    return OVERVIEW.format(
        commands="\n".join(f"  {name:18} {_parts(name)[0].partition(NEXT)[0].rstrip('.')}" for name in COMMANDS)
    )


def _parts(command: str) -> tuple[str, str]:
    """What a command does, and its examples. The module is read, not imported: help needs neither torch nor an engine."""
    module = resources.files("uarm_rl.commands") / f"{config_name(command)}.py"
    text = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or ""
    summary, _, examples = text.partition("\n\nExamples:\n")
    return summary[0].lower() + summary[1:].rstrip("."), examples


def config_name(command: str) -> str:
    """The configuration file of a command, without its ending."""
    return command.replace("-", "_")


def help_text(command: str) -> str:
    """What a command does, its groups with their choices, and its configuration file, whose comments explain each key."""
    conf = resources.files("uarm_rl.conf")
    defaults, _, values = (conf / f"{config_name(command)}.yaml").read_text(encoding="utf-8").partition("\n\n")
    summary, examples = _parts(command)
    lines = [f"uarm-rl {command}: {summary}", "", "Examples:", *examples.splitlines()]
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
