"""Imports point down only: who may use what, read from the source, through however many modules it was handed on."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from configparser import ConfigParser
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "uarm_rl"

#: What a wing may use, besides itself and the root's small files, which use nothing but each other.
WINGS = {
    "task": set(),
    "sim": {"task"},
    "real": {"task", "report"},
    "learn": {"task"},
    "evaluation": {"task"},
    "report": {"task"},
    "emulator": {"task", "sim", "real"},
    "configuration": {"task", "sim", "real", "learn"},
    "commands": {"task", "sim", "real", "learn", "evaluation", "report", "emulator", "configuration"},
    "cli": {"commands", "configuration", "uarm_rl"},
    "uarm_rl": {"configuration", "task"},
    "__main__": {"cli"},
}
ROOT_FILES = {"checks", "files", "csvfile", "workers"}

#: Third-party packages, and the parts of the package that may use them.
OWNERS = {
    "hydra": ("cli", "configuration"),
    "omegaconf": ("cli", "configuration"),
    "pybullet": ("sim", "emulator.physics"),
    "serial": ("real", "emulator"),
    "cv2": ("real", "emulator"),
    "torch": ("learn", "commands.train"),
    "gymnasium": ("task.env",),
    "matplotlib": ("report",),
    "pandas": ("report",),
    "scipy": ("report",),
    "safetensors": ("task.policy", "learn.checkpoint"),
}


def name_of(path: Path) -> str:
    return ".".join(part for part in path.relative_to(ROOT).with_suffix("").parts if part != "__init__")


MODULES = {name_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def inside(module: str) -> str:
    """The module's name in the package; the package itself is ``uarm_rl``."""
    return module.removeprefix("uarm_rl.")


def wing(module: str) -> str:
    return inside(module).split(".")[0]


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text())


@cache
def bound(module: str) -> dict[str, str]:
    """What the imports of a module bind, wherever in it they stand: name -> dotted path."""
    names = {}
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Import):
            names |= {alias.asname or alias.name.split(".")[0]: alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}, line {node.lineno}: a relative import hides which wing it leads to"
            names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return names


def uses(module: str) -> set[str]:
    """Dotted paths that a module imports or reaches through an imported module."""
    paths = set(bound(module).values())
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and bound(module).get(node.value.id) in MODULES:
            paths.add(f"{bound(module)[node.value.id]}.{node.attr}")
    return paths - {module}


def origins(path: str) -> Iterator[str]:
    """The modules that a dotted path leads through, a library's at the end: what is imported may itself be imported."""
    if path in MODULES:
        yield path
        return
    module, _, name = path.rpartition(".")
    if module not in MODULES:
        if not path.startswith("uarm_rl."):
            yield path
        return
    yield module
    if handed_on := bound(module).get(name):
        yield from origins(handed_on)


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_down(module):
    allowed = WINGS.get(wing(module), set()) | ROOT_FILES | {wing(module)}
    for path in uses(module):
        for origin in origins(path):
            assert origin not in MODULES or wing(origin) in allowed, f"{module} uses {path} of {origin}"


@pytest.mark.parametrize("module", MODULES)
def test_libraries_stay_with_their_owners(module):
    for path in uses(module):
        for origin in origins(path):
            owners = OWNERS.get(origin.split(".")[0])
            assert owners is None or f"{inside(module)}.".startswith(tuple(f"{owner}." for owner in owners)), (
                f"{module} uses {path} of {origin}"
            )


def test_no_two_modules_need_each_other():
    TopologicalSorter({module: {path for path in uses(module) if path in MODULES} for module in MODULES}).prepare()


def test_setup_cfg_lists_every_package():
    parser = ConfigParser()
    parser.read(ROOT / "setup.cfg")
    listed = set(parser["options"]["packages"].split())
    here = {".".join(path.parent.relative_to(ROOT).parts) for path in PACKAGE.rglob("__init__.py")}
    assert listed == here | {"uarm_rl.conf"}
