"""Training state on disk: safetensors and JSON, no pickle, committed so that a crash never leaves a torn one.

A checkpoint is a folder ``checkpoint-<episode>`` beside the run's other files. It is written under another name,
flushed, renamed, read back and verified; only then is the one before deleted. ``manifest.json`` holds the
SHA-256 of every part.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from uarm_rl import files
from uarm_rl.task import observation
from uarm_rl.task.policy import ActorPolicy, PolicyCard

Arrays = dict[str, NDArray[Any]]

_PARTS = ("arrays.safetensors", "state.json")
_PREFIX = "checkpoint-"
_MAX_BYTES = 1 << 31  # a replay buffer of ten million transitions


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message is a sentence."""


class Checkpoint(NamedTuple):
    """The state of a training after ``episode``: arrays by name, and what is JSON."""

    episode: int
    arrays: Arrays
    state: dict[str, Any]


def write(run_dir: Path, checkpoint: Checkpoint) -> None:
    """Commit a checkpoint and delete older ones.

    Raises :class:`CheckpointError`, with nothing written, if an array holds a number that is not finite, and
    :class:`OSError` if the disk does not take it; the checkpoint before is then still there.
    """
    episode, arrays, state = checkpoint
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise CheckpointError(f"{name} holds numbers that are not finite, so it was not saved; the last checkpoint is good")
    final = run_dir / f"{_PREFIX}{episode:06d}"
    temporary = final.with_name(final.name + ".tmp")
    for stale in (temporary, final):
        files.remove(stale)
    temporary.mkdir()
    parts = {
        "arrays.safetensors": save({name: np.asarray(array, order="C") for name, array in arrays.items()}),
        "state.json": json.dumps(state, sort_keys=True).encode(),
    }
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in parts.items()}
    for name, data in (parts | {"manifest.json": json.dumps(hashes, sort_keys=True).encode()}).items():
        files.write_and_flush(temporary / name, data)
    files.flush_folder(temporary)
    os.rename(temporary, final)
    files.flush_folder(run_dir)
    _verified_parts(final)
    for other in _folders(run_dir):
        if other != final:
            files.remove(other)


def remove(run_dir: Path) -> None:
    """Delete all checkpoints of a run, those that were never finished too."""
    for path in run_dir.glob(f"{_PREFIX}*"):
        files.remove(path)


def read_latest(run_dir: Path) -> Checkpoint | None:
    """The newest checkpoint, or ``None`` if the run has none.

    A damaged one is passed over for the one before it, if that is still there; :class:`CheckpointError` if none is whole.
    """
    folders = _folders(run_dir)
    strays = [path for path in run_dir.glob(f"{_PREFIX}*") if path not in folders and path.suffix != ".tmp"]
    problem = CheckpointError(f"{strays[0]} has not the name of a checkpoint; remove it") if strays else None
    for folder in reversed(folders):
        try:
            parts = _verified_parts(folder)
            arrays, state = load(parts["arrays.safetensors"]), json.loads(parts["state.json"])
            return Checkpoint(int(folder.name[len(_PREFIX) :]), arrays, state)
        except (SafetensorError, ValueError, KeyError, OSError, RecursionError, MemoryError) as error:
            problem = problem or CheckpointError(f"{folder} is damaged ({error!r:.200}); train anew with overwrite=true")
    if problem:
        raise problem
    return None


def newest(run_dir: Path) -> int | None:
    """The episode of the newest checkpoint; ``None`` if there is none."""
    folders = _folders(run_dir)
    return int(folders[-1].name[len(_PREFIX) :]) if folders else None


def actor(checkpoint: Checkpoint, card: PolicyCard, hidden: Sequence[int]) -> ActorPolicy:
    """The policy that acts at a checkpoint of our own learner, whose networks have ``hidden`` layers of these widths.

    Raises :class:`CheckpointError` for the checkpoint of another.
    """
    flat, layers, start = checkpoint.arrays.get("agent/parameters", np.empty(0)).astype(np.float64), [], 0
    for inputs, outputs in pairwise([card.inputs, *hidden, card.outputs]):
        weight, bias = flat[start : start + inputs * outputs], flat[start + inputs * outputs :][:outputs]
        start += (inputs + 1) * outputs
        if len(flat) < start:
            raise CheckpointError("the checkpoint holds no networks of the shape that the run's configuration describes")
        layers.append((weight.reshape(inputs, outputs), bias))
    seen = observation.kind(card.observation)
    return ActorPolicy(layers, offset=seen.offset, scale=seen.scale, card=card)


def _folders(run_dir: Path) -> list[Path]:
    return sorted(path for path in run_dir.glob(f"{_PREFIX}*") if re.fullmatch("[0-9]+", path.name[len(_PREFIX) :]))


def _verified_parts(folder: Path) -> dict[str, bytes]:
    if folder.is_symlink() or not folder.is_dir():
        raise CheckpointError(f"{folder} is no folder")
    hashes = json.loads(files.read(folder / "manifest.json"))
    parts = {name: files.read(folder / name, at_most=_MAX_BYTES) for name in _PARTS}
    for name, data in parts.items():
        if not isinstance(hashes, dict) or hashes.get(name) != hashlib.sha256(data).hexdigest():
            raise CheckpointError(f"{name} does not match its hash in manifest.json")
    return parts
