"""Say of the runs in results/ which are done, running, waiting or dead, and what continues those that died.

Examples:
  uarm-rl status                        all of them, a line for the seeds in one state
  uarm-rl status results_dir=mine state=dead
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Final, NamedTuple

from uarm_rl import checks, trained
from uarm_rl.checks import UsageError
from uarm_rl.commands import submitted
from uarm_rl.commands.errors import printable
from uarm_rl.commands.runs import episodes, spans
from uarm_rl.commands.submitted import Entry
from uarm_rl.configuration import Settings
from uarm_rl.files import PRUNED
from uarm_rl.report import tables
from uarm_rl.report.inventory import Run, inventory
from uarm_rl.report.records import seed_number

STATES: Final = ("done", "running", "waiting", "dead")
_DONE: Final = ("trained", "evaluated")


class Status(NamedTuple):
    """A run that has begun, or was submitted and has no folder yet, with its last entry in a list, if it has one."""

    name: str
    seed: int
    state: str
    why: str
    run: Run | None
    listed: Path | None
    entry: Entry | None


def run(settings: Settings) -> None:
    """Print the states, and below them a command for each list, or run, of which something died."""
    results_dir = checks.path("results_dir", settings["results_dir"])
    if settings["state"] is not None:
        checks.one_of("state", settings["state"], STATES)
    found = list(statuses(results_dir))
    shown = [one for one in found if settings["state"] in (None, one.state)]
    if not shown:
        of = f"none of its {len(found)} is {settings['state']}" if found else "uarm-rl train or submit makes one"
        print(f"{results_dir} holds no such run; {of}")
        return
    print(tables.aligned(_HEADINGS, [list(map(printable, cells)) for cells in _rows(shown)], left=3))
    counts = {state: sum(one.state == state for one in found) for state in STATES}
    print(", ".join(f"{number} {state}" for state, number in counts.items() if number))
    for line in _continuations(results_dir, found):
        print(printable(line))


def statuses(results_dir: Path) -> Iterator[Status]:
    """All runs of a folder and of its lists, by name and seed.

    What files and locks say counts; the queue is asked what they cannot know. Without it a run that was submitted and never
    began waits, and one that began and is in nobody's hands is dead.
    """
    begun = {one.folder: one for one in inventory(results_dir)}
    last = {
        results_dir / entry.folder: (path, entry) for path, entries in submitted.lists(results_dir).items() for entry in entries
    }
    known = submitted.words_of_jobs([entry.job for _, entry in last.values()])
    places = sorted({*begun, *last}, key=lambda folder: (folder.parent, seed_number(folder)))
    for folder in places:
        one = begun.get(folder)
        path, entry = last.get(folder, (None, None))
        word = known.get(entry.job, "") if entry else ""
        state, why = _state(one, entry, word)
        name = one.name if one else folder.parent.relative_to(results_dir).as_posix()
        yield Status(name, seed_number(folder), state, why, one, path, entry)


def _state(one: Run | None, entry: Entry | None, word: str) -> tuple[str, str]:
    """A run's state and what there is to say of it. ``word`` is of its job, empty if it has none."""
    if one and one.state in _DONE:
        return "done", one.state
    if one and one.holder:
        return "running", one.holder
    if one and (one.folder.parent / PRUNED).exists():
        return "done", "ended by its sweep"
    if word == "running":
        return "running", "its job begins"
    if word == "waiting" or (word == "unknown" and not one):
        return "waiting", "in the queue" if word == "waiting" else "no queue here says more"
    if entry is None:
        return "dead", "nobody trains it"
    if not entry.job:
        return "dead", "the queue did not take it"
    if word == "unknown":
        return "dead", "nobody trains it, and no queue here says more"
    return "dead", "its job is gone" if one else "its job is gone and never began it"


_HEADINGS: Final = ("Name", "State", "Where (or why)", "Seeds", "Episodes")


def _rows(found: Sequence[Status]) -> Iterator[list[str]]:
    """A row for the seeds of one name in one state."""
    for (name, state, why), group in groupby(found, lambda one: (one.name, one.state, one.why)):
        alike = list(group)
        begun = [one.run for one in alike if one.run]
        yield [name, state, why, spans([one.seed for one in alike]), episodes(begun) if begun else "-"]


def _continuations(results_dir: Path, found: Sequence[Status]) -> Iterator[str]:
    """What continues that which died, a line to copy each. A list is data: its words are quoted for the shell, one by one."""
    dead = [one for one in found if one.state == "dead"]
    again = {(one.listed, one.entry.words): one.entry for one in dead if one.entry}
    for (path, _), entry in again.items():
        try:
            words = [word for word in shlex.split(entry.words) if not word.startswith("results_dir=")]
        except ValueError:
            yield f"continue: {path} has words that cannot be read; submit its runs as they were submitted before"
            continue
        yield f"continue: {shlex.join(['uarm-rl', 'submit', *words, f'results_dir={results_dir}'])}"
    for one in dead:
        if one.run and not one.entry:
            yield f"continue: {_alone(results_dir, one.run)}"


def _alone(results_dir: Path, one: Run) -> str:
    try:
        words: Sequence[str] = trained.words_for(trained.read_run(one.folder))
    except (UsageError, ValueError) as error:
        return f"the command that began {one.folder}, with resume=true ({error})"
    where = one.folder.parent.parent
    return shlex.join(["uarm-rl", "train", *words, f"results_dir={where}", "resume=true"])
