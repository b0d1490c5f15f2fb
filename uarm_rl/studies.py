"""Studies: the experiments in ``conf/`` that hold what they vary and with which values, and which of them a run belongs to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any

import yaml

#: What a study varies, by dotted name, with the values: numbers, or the choices of a group.
Sweep = Mapping[str, Sequence[Any]]
#: What a run has of all that any study varies.
Point = Mapping[str, Any]


@cache
def studies() -> dict[str, Sweep]:
    """The sweep of each study, which stands where Hydra has it too: ``hydra.sweeper.params``."""
    found: dict[str, Sweep] = {}
    for path in (resources.files("uarm_rl.conf") / "experiment").iterdir():
        if hydra := yaml.safe_load(path.read_text(encoding="utf-8")).get("hydra"):
            texts = {key: str(values).split(",") for key, values in hydra["sweeper"]["params"].items()}
            found[path.name.removesuffix(".yaml")] = {key: [yaml.safe_load(text) for text in texts[key]] for key in texts}
    return found


def point(settings: Mapping[str, Any], usual: Mapping[str, Any] | None = None) -> Point:
    """What a configuration has of all that any study varies; what it does not have yet, being older, is as ``usual``."""
    if not settings:  # a configuration that cannot be read says nothing
        return {}
    values = {key: _value(settings, key, usual or {}) for sweep in studies().values() for key in sweep}
    return {key: value for key, value in values.items() if value is not None}


def _value(settings: Mapping[str, Any], key: str, usual: Mapping[str, Any]) -> Any:
    """A setting by its dotted name, or the name of a group; one of another name than the usual has settings of its own."""
    found: Any = settings
    default: Any = usual
    for part in key.rpartition("@")[2].split("."):
        there, default = isinstance(found, Mapping), default.get(part) if isinstance(default, Mapping) else None
        found = found.get(part, default) if there else None
        if isinstance(found, Mapping) and isinstance(default, Mapping) and found.get("name") != default.get("name"):
            default = None
    return found.get("name") if isinstance(found, Mapping) else found


def belongs(run: Point, sweep: Sweep, usual: Point) -> bool:
    """Whether a run differs from the usual in nothing but what the study varies: any number, but only the study's choices."""
    return all(
        isinstance(value, (int, float)) or value in sweep[key] if key in sweep else value == usual.get(key)
        for key, value in run.items()
    )
