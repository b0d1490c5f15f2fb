"""Disks that fail and files that are damaged: what becomes of a save, and whether a reader notices."""

from __future__ import annotations

import errno
import itertools
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np

from tests.conftest import CARD
from uarm_rl.learn import checkpoint
from uarm_rl.learn.checkpoint import Checkpoint
from uarm_rl.task.policy import ActorPolicy, PolicyFileError

#: Calls of the operating system that commit something.
COMMITS = ("fsync", "rename", "replace", "mkdir", "unlink", "rmdir")


@contextmanager
def counted_calls(at: int, act: Callable[[], object], names: tuple[str, ...] = COMMITS) -> Iterator[list[int]]:
    """Call ``act`` before the ``at``-th of these calls; yields the count."""
    count = [0]

    def wrap(real: Callable) -> Callable:
        def call(*arguments, **keywords):
            count[0] += 1
            if count[0] == at:
                act()
            return real(*arguments, **keywords)

        return call

    patches = [mock.patch.object(os, name, wrap(getattr(os, name))) for name in names]
    for patch in patches:
        patch.start()
    try:
        yield count
    finally:
        for patch in patches:
            patch.stop()


def small_checkpoint(folder: Path) -> Path:
    arrays = {"agent/parameters": np.arange(12, dtype=np.float32), "replay/rows": np.ones((2, 5), np.float32)}
    checkpoint.write(folder, Checkpoint(1, arrays, {"counters": {"episode": 1}, "noise": [0.5, -0.25]}))
    return folder / "checkpoint-000001"


def accepted(read: Callable[[], object]) -> bool:
    """Whether a damaged file is taken for a good one; another error than the typed one counts as accepted too."""
    try:
        read()
    except (checkpoint.CheckpointError, PolicyFileError):
        return False
    except Exception:
        return True
    return True


def damaged(path: Path, read: Callable[[], object]) -> tuple[int, int]:
    """Flip every bit of a file and cut it at every length; (trials, damages that were not refused)."""
    whole = path.read_bytes()
    trials = taken = 0
    for bit in range(8 * len(whole)):
        data = bytearray(whole)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        taken += accepted(read)
        trials += 1
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        taken += accepted(read)
        trials += 1
    path.write_bytes(whole)
    return trials, taken


def damaged_checkpoint(folder: Path) -> tuple[int, int]:
    saved = small_checkpoint(folder)
    results = [damaged(path, lambda: checkpoint.read_latest(folder)) for path in sorted(saved.iterdir())]
    return sum(trials for trials, _ in results), sum(taken for _, taken in results)


def damaged_policy(folder: Path) -> tuple[int, int]:
    path = folder / "policy.safetensors"
    layers = [(np.full((20, 3), 0.5, np.float32), np.zeros(3, np.float32))]
    ones = np.ones(20, np.float32)
    ActorPolicy(layers, offset=ones, scale=ones, card=CARD).save(path)
    return damaged(path, lambda: ActorPolicy.load(path))


def failing_saves(folder: Path) -> tuple[int, int]:
    """Let each opening and committing call of a save fail in each way; (trials, saves that lied or lost the last good one)."""
    trials = wrong = 0
    for error in (errno.ENOSPC, errno.EIO, errno.EACCES, errno.EROFS):
        for at in itertools.count(1):
            run = folder / f"{error}-{at}"
            run.mkdir()
            small_checkpoint(run)

            def fail(error=error) -> None:
                raise OSError(error, os.strerror(error), "the disk")

            with counted_calls(at, fail, (*COMMITS, "open")) as count:
                try:
                    checkpoint.write(run, Checkpoint(2, {"agent/parameters": np.zeros(3, np.float32)}, {}))
                    claimed = True
                except OSError:
                    claimed = False
            if count[0] < at:
                break
            latest = checkpoint.read_latest(run)
            wrong += latest is None or (claimed and latest[0] != 2)
            trials += 1
    return trials, wrong


def full_disks(folder: Path) -> tuple[int, int]:
    """Let the kernel cut every file of a save at every length; (trials, saves that lied or lost the last good one)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    wrong = trials = 0
    for trials in itertools.count(1):
        run = folder / str(trials)
        run.mkdir()
        small_checkpoint(run)
        resource.setrlimit(resource.RLIMIT_FSIZE, (trials - 1, hard))
        try:
            checkpoint.write(run, Checkpoint(2, {"agent/parameters": np.zeros(3, np.float32)}, {}))
            claimed = True
        except OSError:
            claimed = False
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        latest = checkpoint.read_latest(run)
        wrong += latest is None or (claimed and latest[0] != 2)
        if claimed:
            return trials, wrong
    raise AssertionError("unreachable")


def trusting() -> mock._patch:
    """A reader that does not look at hashes."""
    parts = ("arrays.safetensors", "state.json")
    return mock.patch.object(
        checkpoint, "_verified_parts", lambda folder: {name: (folder / name).read_bytes() for name in parts}
    )
