"""Recorded tests in 3-D, methods beside each other on the same position: a section of the page, from the traces of the runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import pandas as pd

from uarm_rl.checks import command
from uarm_rl.report.learning import TRACES_FILE
from uarm_rl.report.records import METHODS, TRACES, Method, Runs, read, read_config, seed_number
from uarm_rl.report.tables import Document, Replay, Section, Stage

if TYPE_CHECKING:
    from uarm_rl.view.replay import Episode

#: So much the page holds: of each group the first positions, of each name the lowest seed, and so many groups.
_POSITIONS: Final = 4
_GROUPS: Final = 8
_STEPS: Final = 2000  # control steps of an episode
_STEP_S: Final = 0.05  # of traces that do not tell
_WORDS: Final = (
    "The arm as the simulation had it, control step by control step: of each method the lowest seed, two side by side "
    "where both were recorded, first the test position that takes longest. The line is the way of the cup's tip, the red "
    "box the object, the dark mark on it the target. Drag turns the view, the wheel comes nearer, the bar below is the "
    "time in seconds."
)


class _Recorded(NamedTuple):
    """What one method's lowest seed did: its rows of traces, success at each position, and the size of the object (m)."""

    method: Method
    traces: pd.DataFrame
    success: Mapping[int, float]
    object_size_m: float


def replays(results_dir: Path, shown: Sequence[Method], runs: Runs, evaluations: Mapping[str, pd.DataFrame]) -> Section:
    """A stage with the recorded tests of the paper's methods in pairs, then of the others; none if nothing was recorded.

    Without viser a sentence says what is missing.
    """
    recorded = {method.folder: one for method in shown if (one := _recorded(method, runs, evaluations))}
    if not recorded:
        record_them = command(results_dir, "evaluate traces=3")
        return Section(page=Document(f"Nothing was recorded; {record_them} records the first positions."))
    try:
        from uarm_rl.view.replay import record
    except ModuleNotFoundError as error:
        return Section(remarks=[f"report.html has no replays: {error}"], page=Document(f"There are no replays here: {error}."))
    kept = [(group, position) for group in _groups(recorded) for position in _common(group)]
    scenes = [[_episode(one, position) for one in group] for group, position in kept]
    page = record(
        scenes, step_s=min(map(_step_s, recorded.values())), object_size_m=next(iter(recorded.values())).object_size_m
    )
    stage = [
        Replay(
            " and ".join(one.method.label for one in group),
            f"Test position {position}",
            "; ".join(_outcome(one, position) for one in group) + ".",
            recording,
        )
        for (group, position), recording in zip(kept, page.recordings, strict=True)
    ]
    return Section(page=Document(_WORDS, Stage(page.before, page.after, stage)))


def _recorded(method: Method, runs: Runs, evaluations: Mapping[str, pd.DataFrame]) -> _Recorded | None:
    folder = next((folder for folder in runs[method.folder] if (folder / TRACES_FILE).exists()), None)
    if folder is None:
        return None
    rows = evaluations[method.folder]
    own = rows[rows["seed"] == seed_number(folder)]
    success = dict(zip(own["position"].astype(int), own["success"], strict=True))
    sim: Any = read_config(folder).get("sim")
    size_m = sim.get("object_size_m") if isinstance(sim, dict) else None
    return _Recorded(
        method,
        pd.DataFrame(read(folder / TRACES_FILE, TRACES)),
        success,
        float(size_m) if isinstance(size_m, (int, float)) and 0 < size_m < 1 else 0.03,
    )


def _step_s(one: _Recorded) -> float:
    """The time from one control step to the next."""
    step_s = one.traces["time_s"].drop_duplicates().sort_values().diff().min()
    return _STEP_S if math.isnan(step_s) else float(step_s)


def _groups(recorded: Mapping[str, _Recorded]) -> list[list[_Recorded]]:
    """The paper's methods in pairs that differ in the buffer; then the others, two by two."""
    a, b, c, d = (method.folder for method in METHODS)
    others = [folder for folder in recorded if folder not in (a, b, c, d)]
    pairs = [[a, b], [c, d], *(others[first : first + 2] for first in range(0, len(others), 2))]
    groups = [[recorded[folder] for folder in pair if folder in recorded] for pair in pairs]
    return [group for group in groups if group][:_GROUPS]


def _common(group: Sequence[_Recorded]) -> list[int]:
    """The positions that all of a group have; first the one that takes longest, where there is most to see."""
    longest = [one.traces.groupby(one.traces["position"].astype(int))["time_s"].max() for one in group]
    common: pd.Series[float] = pd.concat(longest, axis=1, join="inner").max(axis=1)
    return [int(str(position)) for position in common.sort_values(ascending=False, kind="stable").index][:_POSITIONS]


def _episode(one: _Recorded, position: int) -> Episode:
    from uarm_rl.view.replay import Episode

    rows = one.traces[one.traces["position"] == position][:_STEPS]
    red, green, blue = bytes.fromhex(one.method.colour.removeprefix("#"))
    joints, cups, targets = (
        rows[list(names)].to_numpy()
        for names in (
            ("joint1_rad", "joint2_rad", "joint3_rad"),
            ("cup_x_m", "cup_y_m", "cup_z_m"),
            ("object_x_m", "object_y_m", "object_z_m"),
        )
    )
    return Episode(one.method.label, (red, green, blue), joints, cups, targets)


def _outcome(one: _Recorded, position: int) -> str:
    """How it ended, as in ``A reached it after 3.70 s``."""
    time_s = one.traces.loc[one.traces["position"] == position, "time_s"].max()
    ended = {1.0: f"reached it after {time_s:.2f} s", 0.0: f"ended after {time_s:.2f} s without having reached it"}
    return f"{one.method.label} {ended.get(one.success.get(position, -1.0), f'moved for {time_s:.2f} s')}"
