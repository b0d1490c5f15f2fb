"""Imports point down only: who may import whom, read from the source."""

from __future__ import annotations

import ast
from configparser import ConfigParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "uarm_rl"

FLOORS = {
    0: {"checks", "files", "kinematics", "observation", "reward", "hold", "admission", "positions"},
    1: {"replay", "noise", "policy", "arm", "real.gcode"},
    2: {"ddpg", "env", "rollout", "pipeline", "sim", "real"},
    3: {
        "train",
        "session",
        "evaluate",
        "report",
        "records",
        "tables",
        "comparisons",
        "conditions",
        "budgets",
        "ablations",
        "arm_trials",
        "figures",
        "statistics",
        "checkpoint",
        "logbook",
        "render",
        "usage",
        "lab",
        "emulator",
    },
    4: {"cli"},
}

#: Third-party packages that belong to one part of the package alone.
OWNERS = {
    "hydra": ("cli",),
    "omegaconf": ("cli",),
    "pybullet": ("sim",),
    "serial": ("real", "emulator"),
    "cv2": ("real", "emulator"),
    "torch": ("ddpg", "session", "cli"),
    "gymnasium": ("env",),
    "matplotlib": ("report", "figures"),
    "pandas": ("report", "records", "tables", "comparisons", "conditions", "budgets", "ablations", "arm_trials", "figures"),
    "scipy": ("statistics",),
    "safetensors": ("policy", "checkpoint"),
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


def floor(module: str) -> int:
    floors = [number for number, names in FLOORS.items() for name in names if module == name or module.startswith(f"{name}.")]
    assert floors, f"{module} stands on no floor; add it to FLOORS"
    return min(floors)


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_down(module):
    for name in imports(MODULES[module]):
        imported = name.removeprefix("uarm_rl.")
        if name.startswith("uarm_rl.") and imported in MODULES:
            assert floor(imported) <= floor(module), f"{module} imports {imported}"
            parts = {module.split(".")[0], imported.split(".")[0]}
            assert parts != {"sim", "real"}, f"{module} imports {imported}"


@pytest.mark.parametrize("module", MODULES)
def test_libraries_stay_with_their_owners(module):
    for name in imports(MODULES[module]):
        owners = OWNERS.get(name.split(".")[0])
        assert owners is None or any(module == owner or module.startswith(f"{owner}.") for owner in owners), f"{module}: {name}"


@pytest.mark.parametrize("module", [name for name in MODULES if floor(name) == 0])
def test_the_lowest_floor_needs_numpy_at_most(module):
    foreign = {name.split(".")[0] for name in imports(MODULES[module])}
    assert not foreign & {"torch", "pandas", "scipy", "gymnasium", "safetensors"}


def test_the_configuration_stays_in_the_front_door():
    for module, path in MODULES.items():
        if module != "cli":
            names = {node.id for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Name)}
            assert "cfg" not in names, module


def test_setup_cfg_lists_every_package():
    parser = ConfigParser()
    parser.read(ROOT / "setup.cfg")
    listed = set(parser["options"]["packages"].split())
    here = {"uarm_rl", *(f"uarm_rl.{path.parent.name}" for path in PACKAGE.glob("*/__init__.py"))}
    assert listed == here | {"uarm_rl.conf"}
