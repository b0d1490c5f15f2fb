"""Imports point down only: who may import whom, read from the source."""

from __future__ import annotations

import ast
from configparser import ConfigParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "uarm_rl"

#: What a wing may import, besides itself and the root's small files (which import nothing but each other).
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
    "cli": {"commands", "configuration"},
}
ROOT_FILES = {"checks", "files", "csvfile", "workers"}

#: Third-party packages, and the parts of the package that may import them.
OWNERS = {
    "hydra": ("cli", "configuration"),
    "omegaconf": ("cli", "configuration"),
    "pybullet": ("sim",),
    "serial": ("real", "emulator"),
    "cv2": ("real", "emulator"),
    "torch": ("learn", "commands.train"),
    "gymnasium": ("task.env",),
    "matplotlib": ("report",),
    "pandas": ("report",),
    "scipy": ("report",),
    "safetensors": ("task.policy", "learn.checkpoint"),
}


def modules() -> dict[str, Path]:
    names = {}
    for path in PACKAGE.rglob("*.py"):
        relative = path.relative_to(PACKAGE).with_suffix("")
        names[".".join(part for part in relative.parts if part != "__init__")] = path
    return {name: path for name, path in names.items() if name}


MODULES = modules()


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return found


def wing(module: str) -> str:
    return module.split(".")[0]


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_down(module):
    for name in imports(MODULES[module]):
        imported = name.removeprefix("uarm_rl.")
        if name.startswith("uarm_rl.") and imported in MODULES and wing(imported) not in {wing(module), *ROOT_FILES}:
            assert wing(imported) in WINGS.get(wing(module), set()), f"{module} imports {imported}"


@pytest.mark.parametrize("module", MODULES)
def test_libraries_stay_with_their_owners(module):
    for name in imports(MODULES[module]):
        owners = OWNERS.get(name.split(".")[0])
        assert owners is None or any(module == owner or module.startswith(f"{owner}.") for owner in owners), f"{module}: {name}"


def test_setup_cfg_lists_every_package():
    parser = ConfigParser()
    parser.read(ROOT / "setup.cfg")
    listed = set(parser["options"]["packages"].split())
    here = {".".join(path.parent.relative_to(ROOT).parts) for path in PACKAGE.rglob("__init__.py")}
    assert listed == here | {"uarm_rl.conf"}
