"""Which runs the words of a command line stand for, and between which bounds they search."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast

from uarm_rl.checks import UsageError
from uarm_rl.configuration import our_hydra
from uarm_rl.studies import studies


def combinations(overrides: Iterable[str]) -> tuple[frozenset[str], list[list[str]]]:
    """The keys that are given several values, and the overrides of every job.

    A study sweeps by itself what it varies; where the command line gives one of these keys too, the command line counts.
    """
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser

    swept: set[str] = set()
    jobs: list[list[str]] = []
    with our_hydra() as hydra:
        parser = OverridesParser.create(config_loader=hydra.config_loader)
        given = [override for override in parser.parse_overrides([*overrides]) if not override.is_hydra_override()]
        experiments = [override for override in given if override.get_key_element() == "experiment"]
        others = [override for override in given if override.get_key_element() != "experiment"]
        for experiment in BasicSweeper.split_arguments(experiments, None)[0]:
            study = studies().get("".join(experiment).partition("=")[2], {})
            words = [*experiment, *(f"{key}={','.join(map(str, values))}" for key, values in study.items())]
            jobs += BasicSweeper.split_arguments([*parser.parse_overrides(words), *others], None)[0]
            swept |= set(study)
        swept |= {override.get_key_element() for override in given if override.is_sweep_override()}
    return frozenset(swept), jobs


def search_space(overrides: Iterable[str]) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """The settings that are to be searched, as ``commands/sweep.py`` takes them, and the other words."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    space: dict[str, dict[str, Any]] = {}
    others = []
    with our_hydra() as hydra:
        for override in OverridesParser.create(config_loader=hydra.config_loader).parse_overrides([*overrides]):
            name, value = override.get_key_element(), cast(Any, override.value())
            if not override.is_sweep_override():
                others.append(str(override.input_line))
            elif override.is_interval_sweep():
                low, high, log = value.start, value.end, "log" in value.tags
                if not low < high or (log and low <= 0):
                    raise UsageError(
                        f"{override.input_line} is no interval to search: the first number must be the smaller one"
                    )
                space[name] = {"low": low, "high": high, "log": log, "whole": isinstance(low, int) and isinstance(high, int)}
            elif choices := [*override.sweep_string_iterator()]:
                space[name] = {"choices": choices}
            else:
                raise UsageError(f"{override.input_line} is no search; name the values, or give an interval(LOW,HIGH)")
    return space, others
