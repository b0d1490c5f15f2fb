"""The texts: every command in them runs, every link leads somewhere, and their tables are the code's own."""

from __future__ import annotations

import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from configparser import ConfigParser
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.conftest import FAST
from uarm_rl import cli, columns, configuration
from uarm_rl.commands import COMMANDS
from uarm_rl.commands.words import as_overrides

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
TEXTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "RESULTS.md", *sorted(DOCS.glob("*.md"))]
PAGES = [page for page in TEXTS if page.name not in ("CONTRIBUTING.md", "RESULTS.md", "preregistration.md")]

_setup = ConfigParser()
_setup.read(ROOT / "setup.cfg")
EXTRAS = set(_setup["options.extras_require"])

#: The runs that the pages take as given.
GIVEN = ("adaptive-plain", "adaptive-penalty", "uniform-plain")

#: What makes a command short; what it does, and with which words, stays.
SHORT = {
    "train": (*FAST, "episodes=1", "simulate_beside=false", "resume=true"),
    "sweep": (*FAST, "episodes=1", "simulate_beside=false", "sweep.trials=1"),
    "evaluate": ("workers=1",),
    "render": ("width=64", "height=64", "episodes=1"),
    "run-real": ("trials=1", "overwrite=true"),
}

#: They stand and wait for a person, and for what no test has: a printed board, marks on a table, a cluster. Their words are
#: checked.
WAITING = ("emulate", "watch", "calibrate-camera", "calibrate-hand-eye", "submit")


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language, and what the README has indented as commands."""
    text = page.read_text()
    found = re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    indented = ["\n".join(re.findall(r"^    (\S.*)$", text, re.MULTILINE))] if language == "sh" and page.parent == ROOT else []
    return [*found, *indented]


def commands(page: Path) -> list[list[str]]:
    """The words of each command in a page's blocks, each once."""
    lines = [line for block in blocks(page, "sh") for line in block.replace("\\\n", " ").splitlines()]
    return [shlex.split(line, comments=True) for line in dict.fromkeys(lines) if line]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the runs that the pages name, in which they are read."""
    for name in GIVEN:
        shutil.copytree(ROOT / "results" / name / "seed0", tmp_path / "results" / name / "seed0")
    shutil.copytree(ROOT / "results" / GIVEN[0] / "seed0", tmp_path / "mine" / "other" / "seed0")
    (tmp_path / "mine" / "other" / "seed0" / "evaluation.csv").unlink()
    (tmp_path / "two.csv").write_text("x_m,y_m,z_m\n0.2,0.1,0.03\n0.25,-0.1,0.03\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[str]:
    """The port of an emulated arm, whose camera is found beside it."""
    words = [sys.executable, "-m", "uarm_rl", "emulate", "--speed", "50", "object_position=[0.2,0,0.03]"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=tmp_path) as emulator:
        assert emulator.stdout
        yield next(line for line in emulator.stdout if line.startswith("arm: ")).split()[1]
        emulator.send_signal(signal.SIGINT)
        emulator.stdout.read()


def shortened(words: list[str]) -> list[str]:
    """The same command for a small run; a study is one of its runs."""
    command, *rest = words
    if "-m" in rest:  # its first job; `check` has composed all of them
        rest = configuration.combinations([word for word in rest if not word.startswith(("-", "hydra"))])[1][0]
    rest += SHORT.get(command, ())
    if command == "evaluate":
        rest = [*(word for word in rest if not word.startswith("positions=")), "positions=two.csv"]
        rest += [] if any(word.startswith("out=") for word in rest) else ["out=two-evaluation.csv", "overwrite=true"]
    return [command, *rest]


def check(words: list[str]) -> None:
    """Every run of a command composes: groups, keys and choices are there."""
    command, *rest = words
    assert command in COMMANDS, words
    if command == "sweep":
        space, others = configuration.search_space(as_overrides(rest))
        assert space
        assert configuration.compose(command, others)
    elif "--help" not in rest:
        rest = as_overrides([word for word in rest if word not in ("-m", "--cfg", "job")])
        for overrides in configuration.combinations([word for word in rest if not word.startswith("hydra")])[1]:
            assert configuration.compose(command, overrides)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_of_a_page_runs(page, place, request):
    if any(words[1] in ("run-real", "doctor", "jog") for words in commands(page) if words[0] == "uarm-rl"):
        if not find_spec("pybullet"):
            pytest.skip("the emulated arm needs PyBullet")
        port = request.getfixturevalue("arm")
    for words in commands(page):
        program, *rest = words
        if program == "uarm-rl":
            check(rest)
            if rest[0] in WAITING or ("policy=planner" in rest and not find_spec("ompl")):
                continue
            if rest[0] in ("run-real", "doctor", "jog") and "--dry-run" not in rest:
                kept = [word for word in rest if word not in ("--port", "/dev/ttyACM0", "PATH")]
                rest = [*kept, f"port={port}"]
            run(shortened(rest))
        elif program == "make":
            subprocess.run(["make", "-n", *rest], cwd=ROOT, capture_output=True, check=True)
        elif program == "pip":
            assert extras(" ".join(rest)) <= EXTRAS
        else:
            assert words[:4] == ["python3", "-m", "venv", ".venv"], words


def run(words: list[str]) -> None:
    """A command in this process; one that ends well ends with 0."""
    code = None
    try:
        cli.main(words)
    except SystemExit as stop:
        code = stop.code
    assert not code, words


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.stem)
def test_every_example_in_python_runs(page, place):
    for code in blocks(page, "python"):
        exec(compile(code, str(page), "exec"), vars(sys.modules["__main__"]) | {"__name__": "__main__"})


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.stem)
def test_what_is_named_in_a_sentence_is_there_too(page):
    """Commands and `make` goals in backticks, and extras."""
    text = page.read_text()
    goals = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"`make ([a-z]+)", text)) <= set(goals)
    assert extras(text) <= EXTRAS
    for words in re.findall(r"`uarm-rl ([a-z][^`]*)`", text):
        if not re.search(r"\b(?:[A-Z_]{2,}|\.\.\.)", words.replace("PATH", "x")):
            check(shlex.split(words))


def extras(text: str) -> set[str]:
    """The extras that are asked for in ``.[a,b]`` or called by that name."""
    asked = [name for names in re.findall(r"\.\[([\w,]+)\]", text) for name in names.split(",")]
    return {*asked, *re.findall(r"extra `(\w+)`", text)}


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.stem)
def test_every_link_leads_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), f"{page.name} links to {target}"
        assert ROOT in there.parents, f"{page.name} links to {target}"
        if anchor:
            assert anchor in anchors(there.read_text()), f"{page.name} links to {target}"


def anchors(text: str) -> set[str]:
    """What a heading or a label of a Markdown page is linked by."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    made = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
    return made | set(re.findall(r"^\((.+)\)=$", text, re.MULTILINE))


@pytest.mark.parametrize(
    ("page", "file"), [("training", "progress.csv"), ("evaluating", "evaluation.csv"), ("real_arm", "trials.csv")]
)
def test_the_columns_are_as_they_are_declared(page, file):
    table = columns.markdown(getattr(columns, file.removesuffix(".csv").upper()), file)
    assert table in (DOCS / f"{page}.md").read_text()


def test_every_command_setting_group_and_study_is_in_the_documentation():
    text = "".join(page.read_text() for page in PAGES)
    lacking = [command for command in COMMANDS if f"uarm-rl {command}" not in text and command != "completion"]
    for group in ("task", "buffer", "observation", "reward", "agent", "noise", "servo", "cup", "sim", "logger", "experiment"):
        lacking += [one.stem for one in (ROOT / "conf" / group).glob("*.yaml") if f"`{one.stem}`" not in text]
    assert lacking == []


def test_the_readme_is_of_one_screen():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


def test_every_page_is_in_the_site():
    listed = re.findall(r"^([a-z_]+)$", (DOCS / "index.md").read_text(), re.MULTILINE)
    assert {page.stem for page in DOCS.glob("*.md")} == {*listed, "index"}
