"""The house: imports point down only, through however many modules a name is handed on, and documents name what is there."""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Iterator
from configparser import ConfigParser
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
import yaml

from uarm_rl.commands import COMMANDS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "uarm_rl"

#: What a wing may use, besides itself and the root's small files, which use nothing but each other.
WINGS = {
    "task": set(),
    "sim": {"task"},
    "real": {"task"},
    "learn": {"task"},
    "evaluation": {"task"},
    "view": {"task", "sim"},
    "report": {"task", "view"},
    "export": {"task", "report"},
    "emulator": {"task", "sim", "real"},
    "configuration": {"task", "sim", "real", "learn"},
    "trained": {"task", "configuration"},
    "commands": {
        "task",
        "sim",
        "real",
        "learn",
        "evaluation",
        "export",
        "report",
        "emulator",
        "view",
        "configuration",
        "trained",
    },
    "cli": {"commands", "configuration", "uarm_rl"},
    "uarm_rl": {"configuration", "task"},
    "__main__": {"cli"},
}
ROOT_FILES = {"checks", "columns", "csvfile", "files", "locks", "progress", "signals", "studies", "workers"}

#: Third-party packages, and the parts of the package that may use them.
OWNERS = {
    "hydra": ("cli", "configuration"),
    "omegaconf": ("cli", "configuration"),
    "pybullet": ("sim", "emulator.physics"),
    "mujoco": ("sim",),
    "serial": ("real.ports", "real.doctor"),
    "cv2": ("real.vision", "emulator.camera", "emulator.optics"),
    "torch": ("learn", "commands.train"),
    "gymnasium": ("task.env", "learn.sb3", "learn.sb3_training"),
    "stable_baselines3": ("learn.sb3", "learn.sb3_training"),
    "matplotlib": ("report",),
    "viser": ("view",),
    "websockets": ("view.guard",),
    "pandas": ("report",),
    "onnx": ("export",),
    "ompl": ("task.planner",),
    "tqdm": ("progress",),
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
    """Dotted paths that a module imports, reaches through an imported module, or names in a text (an entry point)."""
    paths = set(bound(module).values())
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and bound(module).get(node.value.id) in MODULES:
            paths.add(f"{bound(module)[node.value.id]}.{node.attr}")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and "." in node.value:
            paths |= {node.value.split(":")[0]} & MODULES.keys()
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


DOCUMENTS = [ROOT / "CONTRIBUTING.md", ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
INITS = [path for path in MODULES.values() if path.name == "__init__.py" and path.parent != PACKAGE]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_what_a_document_names_is_there(document):
    """Modules and files in backticks, as seen from the checkout or the package, and tests in them; ``NAME`` stands for any."""
    for name in re.findall(r"`((?:[\w.-]+/)+[\w.-]+\.(?:py|yaml|md)(?:::\w+)?|\w+\.py)`", document.read_text()):
        path, _, test = name.partition("::")
        places = [root / path for root in (ROOT, PACKAGE) if (root / path).is_file()]
        assert places or re.search(r"\b[A-Z]+\b", path), f"{document.name} names {path}"
        assert not test or f"def {test}(" in places[0].read_text(), f"{document.name} names {name}"


def test_the_picture_of_the_wings_is_the_table():
    picture = (ROOT / "docs" / "architecture.md").read_text().partition("```mermaid")[2].partition("```")[0]
    arrows = re.findall(r"^ *(\w+)(?:\[.*?\])? --> (.*)$", picture, re.MULTILINE)
    assert {source for source, _ in arrows} | {"task"} == WINGS.keys() - {"uarm_rl", "__main__"}
    for source, targets in arrows:
        assert set(re.findall(r"\w+", re.sub(r"\[.*?\]", "", targets))) <= WINGS[source], source


@pytest.mark.parametrize("package", INITS, ids=lambda path: path.parent.name)
def test_a_wing_lists_what_lives_in_it(package):
    """Each of its modules (the commands are listed in ``COMMANDS``), and of others only what is there."""
    contents = ast.get_docstring(ast.parse(package.read_text()))
    named = set(re.findall(r"``([\w/]+\.py)``", contents))
    listed = {f"{command.replace('-', '_')}.py" for command in COMMANDS} if package.parent.name == "commands" else set()
    assert named | listed >= {path.name for path in package.parent.glob("*.py")} - {"__init__.py"}
    assert all((package.parent / name).is_file() or (PACKAGE / name).is_file() for name in named)


def test_commits_are_checked_by_what_make_check_runs():
    made = subprocess.run(
        ["make", "-n", "check", "VENV=.venv"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    assert [hook["entry"] for hook in hooks] == [line for line in made if re.match(r"\.venv/bin/(?!python)", line)]


def test_one_module_begins_processes():
    """Elsewhere its context is used; a second way to begin one would be a fork on some systems."""
    for module, path in MODULES.items():
        ways = re.findall(r"get_context|set_start_method|os\.fork|multiprocessing\.(?:Process|Pool)", path.read_text())
        assert not ways or module == "uarm_rl.workers", f"{module}: {ways}"
        for call in re.findall(r"ProcessPoolExecutor\(([^)]*)", path.read_text()):
            assert "workers.CONTEXT" in call, module


@pytest.mark.parametrize("path", [*DOCUMENTS, *MODULES.values()], ids=lambda path: str(path.relative_to(ROOT)))
def test_nobody_is_told_to_install_a_package_that_the_index_lacks(path):
    assert not re.search(r"pip install[^\n]*['\" ]uarm-rl\b", path.read_text())
