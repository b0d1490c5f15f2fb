"""List the runs in results/: how far, how good, in which engine, how large, and what is stale.

Examples:
  uarm-rl runs                                        all of them, a line for the seeds in one state
  uarm-rl runs results_dir=mine name='*-plain' state=evaluated
  uarm-rl runs stale=true                             only those whose evaluation is not of what is there now
  uarm-rl runs --compare results/adaptive-plain/seed0 results/adaptive-penalty/seed0
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from datetime import datetime
from fnmatch import fnmatchcase
from itertools import groupby

from uarm_rl import checks
from uarm_rl.checks import UsageError
from uarm_rl.commands.errors import printable
from uarm_rl.configuration import Settings
from uarm_rl.report import tables
from uarm_rl.report.inventory import STATES, Run, inventory, stale_table
from uarm_rl.trained import read_run


def run(settings: Settings) -> None:
    """Print the list, or how two runs differ."""
    if settings["compare"] is not None:
        _compare(settings["compare"])
        return
    results_dir = checks.path("results_dir", settings["results_dir"])
    if settings["state"] is not None:
        checks.one_of("state", settings["state"], STATES)
    found = inventory(results_dir)
    chosen = [one for one in found if _is_wanted(one, settings)]
    if not chosen:
        print(f"{results_dir} holds no such run; {_instead(found, settings['method'])}")
        return
    print(tables.aligned(_HEADINGS, [list(map(printable, cells)) for cells in _rows(chosen)], left=4))
    for sentence in [*(reason for one in chosen for reason in one.stale), stale_table(results_dir, found)]:
        if sentence:
            print(f"stale: {printable(sentence)}")


def _is_wanted(one: Run, settings: Settings) -> bool:
    filters = {
        "name": [one.name],
        "method": [one.method, *one.method.split(", ")],  # all of it, or its buffer or its reward
        "state": [one.state],
        "engine": [one.engine.partition(",")[0]],
    }
    matches = all(
        settings[key] is None or any(fnmatchcase(value, str(settings[key])) for value in values)
        for key, values in filters.items()
    )
    return matches and (bool(one.stale) or not checks.boolean("stale", settings["stale"]))


def _instead(found: Sequence[Run], method: object) -> str:
    """What to do where no run is as wanted."""
    if not found:
        return "uarm-rl train makes one"
    if any(fnmatchcase(one.name, str(method)) for one in found):
        return f"{method} is a name and no method: name={method}"
    methods = "; ".join(dict.fromkeys(one.method for one in found if one.method))
    return f"none of its {len(found)} is what was asked for; the methods there are {methods}"


_HEADINGS = ("Name", "Method", "State", "Engine", "Seeds", "Episodes", "Success (%)", "Changed", "Size (MB)", "Stale")


def _rows(runs: Iterable[Run]) -> Iterable[list[str]]:
    """A row for the seeds of one name that are equally far."""
    for (name, method, state, engine), group in groupby(runs, lambda one: (one.name, one.method, one.state, one.engine)):
        alike = list(group)
        successes = [100.0 * one.success for one in alike if not math.isnan(one.success)]
        changed = datetime.fromtimestamp(max(one.changed_s for one in alike))
        yield [
            name,
            method or "-",
            state,
            engine or "-",
            spans([one.seed for one in alike]),
            episodes(alike),
            f"{sum(successes) / len(successes):.1f}{'' if state == 'evaluated' else ' (validation)'}" if successes else "-",
            f"{changed:%Y-%m-%d %H:%M}",
            f"{sum(one.size for one in alike) / 1e6:.1f}",
            str(sum(bool(one.stale) for one in alike) or "-"),
        ]


def spans(numbers: Sequence[int]) -> str:
    """Numbers in order, as in ``0-2,5``."""
    spans: list[list[int]] = []
    for number in numbers:
        if spans and number == spans[-1][-1] + 1:
            spans[-1][1:] = [number]
        else:
            spans.append([number])
    return ",".join("-".join(map(str, span)) for span in spans)


def episodes(alike: Sequence[Run]) -> str:
    """How many episodes a training has; of one that has not ended, how many it has done, the least to the most."""
    of = str(max(one.episodes for one in alike) or "-")
    done = sorted({one.episode for one in alike})
    return of if alike[0].state in ("trained", "evaluated") else f"{'-'.join(map(str, (done[0], *done[1:][-1:])))} of {of}"


def _compare(folders: object) -> None:
    if not isinstance(folders, list) or len(folders) != 2:
        raise UsageError("compare takes two folders of runs, as in --compare results/a/seed0 results/b/seed0")
    one, other = (checks.path("compare", folder) for folder in folders)
    changed = checks.differences(read_run(one), read_run(other))
    print(f"{one} and {other} {'differ in' if changed else 'have the same settings'}")
    for sentence in changed:
        print(f"  {printable(sentence)}")
