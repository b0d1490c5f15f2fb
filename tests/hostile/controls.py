"""Broken variants of the package, which the harness must catch."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any, NamedTuple
from unittest import mock


class Control(NamedTuple):
    """How to break the package, and the groups of cases that should then do harm."""

    apply: Callable[[], Any]
    groups: tuple[str, ...]


def unsafe_yaml() -> None:
    """Configurations read with YAML's Python tags."""
    import yaml

    mock.patch.object(yaml, "safe_load", yaml.unsafe_load).start()


def unpickled() -> None:
    """Policies and checkpoints read with ``torch.load``."""
    import torch

    from uarm_rl.learn import checkpoint
    from uarm_rl.task.policy import ActorPolicy

    def load(data: bytes) -> Any:
        return torch.load(io.BytesIO(data), weights_only=False)

    mock.patch.object(ActorPolicy, "load", lambda path: load(path.read_bytes())).start()
    mock.patch.object(checkpoint, "load", load).start()


def unchecked_words() -> None:
    """Hydra's own settings let through."""
    from uarm_rl import cli

    mock.patch.object(cli, "check", return_value=None).start()


def following_links() -> None:
    """A results file opened where it is, links and all."""
    from uarm_rl import files

    mock.patch.object(files, "replace", lambda path, data: path.write_bytes(data)).start()


CONTROLS = {
    "unsafe yaml": Control(unsafe_yaml, ("yaml tag",)),
    "unpickled": Control(unpickled, ("pickle as policy", "pickle as checkpoint")),
    "following links": Control(following_links, ("link as result",)),
    "unchecked words": Control(unchecked_words, ("Hydra's settings, many runs",)),
}
