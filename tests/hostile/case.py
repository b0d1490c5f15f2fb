"""A case: a command line, and what lies in the folder in which it is given."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

TOY = (
    *("name=toy", "episodes=2", "experiences_per_episode=20", "max_decisions_per_episode=80", "warmup_experiences=20"),
    *("batch_size=8", "agent.hidden=[16,16]", "buffer.capacity=70", "validate_every=2", "checkpoint_every=1"),
    *("time_limit_s=0.05", "simulate_beside=false"),
)
#: The smallest training, wherever its command line is what is hostile.
TINY = (
    *(word for word in TOY if not word.startswith(("episodes", "experiences", "warmup", "max_decisions"))),
    *("episodes=1", "experiences_per_episode=4", "warmup_experiences=2", "max_decisions_per_episode=8"),
    "results_dir=results/many",
)
RUN = "results/toy/seed0"  # finished and evaluated
HALF = "half/toy/seed0"  # the same run, stopped after its first episode
TRAIN = ("train", *TOY, "results_dir=half", "resume=true")
EVALUATE = ("evaluate", f"run={RUN}", "overwrite=true", "workers=1")
RENDER = ("render", f"run={RUN}", "episodes=1", "width=64", "height=64")
REPORT = ("report", "results_dir=results")


class Box(NamedTuple):
    """A case's folder: ``cwd`` is the working directory, ``outside`` what nothing may touch."""

    root: Path

    @property
    def cwd(self) -> Path:
        return self.root / "cwd"

    @property
    def outside(self) -> Path:
        return self.root / "outside"

    def fill(self, text: str) -> str:
        return text.replace("CANARY", str(self.outside / "canary")).replace("OUTSIDE", str(self.outside))

    def path(self, where: str) -> Path:
        """A path below the working directory; ``CHECKPOINT`` in it is the folder of the half run's checkpoint."""
        if "CHECKPOINT" in where:
            where = where.replace("CHECKPOINT", str(next((self.cwd / HALF).glob("checkpoint-*"))))
        return self.cwd / where


Prepare = Callable[[Box], object]


class Case(NamedTuple):
    """``OUTSIDE`` and ``CANARY`` in words, files and environment stand for paths."""

    group: str
    what: str
    words: tuple[str, ...]
    prepare: Prepare = lambda box: None
    environment: Mapping[str, str] = MappingProxyType({})
    accepted: bool = False  # the input is odd but does no harm: the command may do its work
    allowed: tuple[str, ...] = ()  # folders below the working directory that the user named as a place for results
    check: Callable[[Box], str | None] = lambda box: None

    def inside(self, box: Box) -> list[Path]:
        """The folders whose content the command may change."""
        return [box.cwd / name for name in ("results", "half", *self.allowed)]


def put(where: str, content: str | bytes) -> Prepare:
    """A file below the working directory, in place of what is there."""

    def prepare(box: Box) -> None:
        data = box.fill(content).encode() if isinstance(content, str) else content
        _cleared(box, where).write_bytes(data)

    return prepare


def link(where: str, target: str) -> Prepare:
    return lambda box: _cleared(box, where).symlink_to(box.fill(target))


def pipe(where: str) -> Prepare:
    return lambda box: os.mkfifo(_cleared(box, where))


def folder(where: str) -> Prepare:
    return lambda box: (_cleared(box, where) / "keep").mkdir(parents=True)


def giant(where: str) -> Prepare:
    """What is there, grown to a terabyte that takes no room."""

    def prepare(box: Box) -> None:
        with open(box.path(where), "ab") as file:
            file.truncate(1 << 40)

    return prepare


def renamed(where: str, name: str) -> Prepare:
    return lambda box: box.path(where).rename(box.path(where).with_name(name))


def every(*steps: Prepare) -> Prepare:
    return lambda box: [step(box) for step in steps]


def _cleared(box: Box, where: str) -> Path:
    path = box.path(where)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    return path
