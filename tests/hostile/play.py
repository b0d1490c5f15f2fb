"""Cases played, each in a process of its own, and judged when it ends."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import matplotlib.font_manager

from tests.hostile import child, files, words
from tests.hostile.case import EVALUATE, TOY, Box, Case
from tests.hostile.controls import CONTROLS
from tests.hostile.hook import PAYLOAD
from uarm_rl import configuration

LIMIT_S = 60.0  # of a case
LONGEST_LINE = 10_000  # characters of an error line

#: Row of the table -> its cases, and the controls that belong to it.
ROWS: dict[str, tuple[Callable[[], Iterator[Case]], tuple[str, ...]]] = {
    "hostile files": (files.cases, ("unsafe yaml", "unpickled", "following links")),
    "hostile configurations and overrides": (words.cases, ("unchecked words",)),
}


def snapshot(root: Path, inside: Iterable[Path]) -> dict[str, str]:
    """Kind, content and target of everything below ``root`` that is not ``inside``."""
    state = {}
    for folder, names, names_of_files in os.walk(root):
        names[:] = [name for name in names if Path(folder) / name not in inside]
        for name in (*names, *names_of_files):
            path = os.path.join(folder, name)
            seen = os.lstat(path)
            content = os.readlink(path) if os.path.islink(path) else ""
            if stat.S_ISREG(seen.st_mode):
                with open(path, "rb") as file:
                    content = f"{seen.st_size} bytes, {hashlib.sha256(file.read(1 << 20)).hexdigest()}"
            state[path] = f"{seen.st_mode:o} {content}"
    for name in ("events", "stdout", "stderr"):
        state.pop(str(root / name), None)
    return state


def written(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""


def complaints(case: Case, box: Box, code: int | None, before: dict[str, str]) -> list[str]:
    """What is wrong with how a case ended; empty if nothing."""
    found = [f"executed or wrote: {line}" for line in dict.fromkeys(written(box.root / "events").splitlines())][:5]
    after = snapshot(box.root, case.inside(box))
    changed = sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))
    found += [f"changed outside: {Path(path).relative_to(box.root)}" for path in changed][:5]
    if code is None or code < 0:
        return [*found, "hung" if code is None else f"died of {signal.Signals(-code).name}"]
    errors = written(box.root / "stderr")
    lines = [line for line in errors.replace("\r", "\n").splitlines() if line.strip()]
    sentences = [line for line in lines if line.startswith(("error: ", "failed: "))]  # of many, a job's
    faults = {
        "traceback": "Traceback (most recent call last)" in errors,
        "accepted": code == 0 and not case.accepted,
        f"{len(sentences)} error lines": code > 0 and len(sentences) != 1,
        "something behind the error line": code > 0 and sentences != lines[-1:],
        "an error without a type": any("this is a bug" in line for line in sentences),
        "an endless error line": any(len(line) > LONGEST_LINE for line in sentences),
        "control characters in the error line": not "".join(sentences).isprintable(),
    }
    found += [fault for fault, there in faults.items() if there]
    wrong = case.check(box)
    return [*found, wrong] if wrong else found


class Result(NamedTuple):
    """How a case ended, with a control or none."""

    row: str  # of the table
    case: Case
    control: str
    complaints: list[str]
    last_line: str


def play(row: str, case: Case, control: str, template: Path) -> Result:
    with tempfile.TemporaryDirectory(dir=template.parent) as folder:
        box = Box(Path(folder) / "box")
        shutil.copytree(template, box.root, symlinks=True)
        case.prepare(box)
        before = snapshot(box.root, case.inside(box))
        cache = template.parent / "cache"  # what matplotlib and torch keep from one start to the next is theirs
        environment = {
            **os.environ,
            **dict.fromkeys(("MPLCONFIGDIR", "TORCHINDUCTOR_CACHE_DIR"), str(cache)),
            **{name: box.fill(value) for name, value in case.environment.items()},
            "HOSTILE_CANARY": box.fill("CANARY"),
            "HOSTILE_INSIDE": os.pathsep.join(map(str, (cache, *case.inside(box)))),
            "PYTHONPATH": str(template.parent / "payload"),
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        script = [sys.executable, child.__file__, str(box.root), control, *map(box.fill, case.words)]
        with open(box.root / "stdout", "wb") as out, open(box.root / "stderr", "wb") as err:
            process = subprocess.Popen(
                script, cwd=box.cwd, env=environment, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True
            )
        code = None
        with suppress(subprocess.TimeoutExpired):
            code = process.wait(LIMIT_S)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # it and what it left behind
        process.wait()
        errors = written(box.root / "stderr").strip()[-300:].splitlines()
        return Result(row, case, control, complaints(case, box, code, before), errors[-1] if errors else "")


def make_template(template: Path) -> None:
    """A finished and evaluated run, the same run half done, what must not be touched, and a module not to be imported."""
    from uarm_rl.commands import evaluate, train
    from uarm_rl.learn import checkpoint

    box = Box(template)
    box.cwd.mkdir(parents=True)
    (box.outside / "folder").mkdir(parents=True)
    for name in ("victim.txt", "folder/keep.txt"):
        (box.outside / name).write_text("precious\n")
    shutil.copytree(matplotlib.get_cachedir(), template.parent / "cache")  # its list of fonts, which takes processes to make
    (template.parent / "payload").mkdir()
    code = "import os\nopen(os.environ['HOSTILE_CANARY'], 'w').close()\nrun = Run = Callback = dict\n"
    (template.parent / "payload" / f"{PAYLOAD}.py").write_text(code)
    write = checkpoint.write

    def stop_there(*arguments: Any) -> None:
        write(*arguments)
        raise KeyboardInterrupt

    half, results = (f"results_dir={box.cwd / name}" for name in ("half", "results"))
    with mock.patch.object(checkpoint, "write", stop_there), suppress(KeyboardInterrupt):
        train.run(configuration.compose("train", (*TOY, half)))
    train.run(configuration.compose("train", (*TOY, results)))
    evaluate.run(configuration.compose("evaluate", (*EVALUATE[2:], results)))
    for path in template.rglob(".lock"):
        path.unlink()


def rows(every_nth: int = 1, control_nth: int = 3) -> Iterator[tuple[str, int, list[str], str]]:
    """Each row of the table: its name, the number of cases (every nth), those that failed, and what the controls showed."""
    entries: list[tuple[str, Case, str]] = []
    for row, (make, controls) in ROWS.items():
        listed = list(make())
        entries += [(row, case, "") for case in listed[::every_nth]]
        for name in controls:
            victims = [case for case in listed if case.group in CONTROLS[name].groups]
            entries += [(row, case, name) for case in victims[::control_nth]]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(len(os.sched_getaffinity(0)) + 1) as pool:
        template = Path(folder) / "template"
        make_template(template)
        results = list(pool.map(lambda entry: play(*entry, template), entries))
    for row, (_, controls) in ROWS.items():
        mine = [result for result in results if (result.row, result.control) == (row, "")]
        failed = [
            f"{it.case.group}: {it.case.what}: {'; '.join(it.complaints)} [{it.last_line}]" for it in mine if it.complaints
        ]
        shown = []
        for name in controls:
            tried = [result.complaints for result in results if result.control == name]
            caught = sum(any(fault.startswith(("executed", "changed")) for fault in found) for found in tried)
            shown.append(f"{'' if caught else 'NOT CAUGHT: '}{name}: {caught} of {len(tried)} seen")
        yield row, len(mine), failed, ", ".join(sorted(shown, key=lambda text: not text.startswith("NOT")))
