"""Beyond the paper: past obstacles to the object, and motors that are told torques; the runs of results/beyond."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd

from uarm_rl.checks import command
from uarm_rl.report import figures, tables
from uarm_rl.report.learning import TRACES_FILE
from uarm_rl.report.records import PROGRESS, TRACES, Runs, find_runs, methods, read, read_config, read_evaluations, read_seeds
from uarm_rl.report.tables import Document, Section, Table

BEYOND: Final = "beyond"  # below the results folder
#: Controllers that learn nothing, by the file beside a run's evaluation that holds what they do on its layouts.
_CONTROLLERS: Final = {"ik.csv": "inverse kinematics", "planner.csv": "planner"}
_ENDS: Final = {"success_rate": "reached", "touched": "touched an obstacle", "neither": "neither"}
_PAST: Final = (
    "The 100 test layouts, each with one to three obstacles between home and object; interval as in Table 1. Reached: success, "
    "and no part of the arm touched an obstacle on the way. Force: between arm and obstacle, of the attempts that touched. "
    "Inverse kinematics goes straight and sees no obstacle; the planner (RRT-Connect, OMPL) knows all of the layout."
)
_TOLD: Final = (
    "The 100 test positions, interval as in Table 1. Uniform: a torque for each control step; steady speed: it acts until the "
    "joints' speeds are steady; adaptive: until the arm stands, as in the paper. Time: until success, or the time limit."
)


def obstacles(results_dir: Path) -> Section:
    """obstacles.csv and .md and pictures of them: how attempts ended, and how the policies learned."""
    runs = _runs(results_dir, "task", "obstacles")
    evaluations, section = read_evaluations(runs), _begun(results_dir, runs)
    tests = {_buffer(runs[name]): rows for name, rows in evaluations.items() if len(rows)} | dict(_controllers(runs))
    if tests:
        table = pd.DataFrame(_row_past(method, rows) for method, rows in tests.items())
        cells = [
            [
                row["method"],
                str(row["seeds"]),
                tables.success_text(row),
                tables.percent(row["touched"]),
                f"{tables.number(row['force_median_n'], 1)}, {tables.number(row['force_most_n'], 0)}",
                tables.number(row["median_time_s"], 1),
            ]
            for row in tables.records(table)
        ]
        headings = ("Method", "Seeds", "Reached (95 % interval)", "Touched", "Force (N: median, most)", "Median time (s)")
        section.contents["obstacles.csv"] = tables.csv(table)
        section.contents["obstacles.md"] = Document(Table(headings, cells), _PAST)
        height = 1.2 + 0.3 * len(table)
        words = "How attempts ended past one to three obstacles"
        section.contents["obstacles.png"] = figures.picture(
            lambda figure: figures.draw_outcomes(figure, table, _ENDS), words, height
        )
    _add_learning(section, "obstacles_learning.png", runs, evaluations, "How policies learn to come past obstacles")
    return section


def torques(results_dir: Path) -> Section:
    """torque.csv and .md and pictures of them: what each way to wait comes to, and an attempt of each."""
    runs = _runs(results_dir, "servo", "torque")
    evaluations, section = read_evaluations(runs), _begun(results_dir, runs)
    if tests := {name: rows for name, rows in evaluations.items() if len(rows)}:
        table = pd.DataFrame(_row_told(_buffer(runs[name]), runs[name], rows) for name, rows in tests.items())
        cells = [
            [
                row["method"].replace("_", " "),
                str(row["episodes"]),
                str(row["seeds"]),
                tables.success_text(row),
                tables.number(1000.0 * row["final_distance_m"], 1),
                tables.number(row["control_steps_per_decision"], 1),
                tables.number(row["median_time_s"], 1),
            ]
            for row in tables.records(table)
        ]
        headings = (
            "Buffer",
            "Episodes",
            "Seeds",
            "Success (95 % interval)",
            "Median end from the object (mm)",
            "Control steps a decision",
            "Median time (s)",
        )
        section.contents["torque.csv"] = tables.csv(table)
        section.contents["torque.md"] = Document(Table(headings, cells), _TOLD)
    _add_learning(section, "torque.png", runs, evaluations, "Success of policies that tell the motors torques")
    traced = {
        method._replace(label=_buffer(runs[method.folder]).replace("_", " "), buffer=""): pd.DataFrame(
            read(runs[method.folder][0] / TRACES_FILE, TRACES)
        )
        for method in methods(runs)
        if method.folder in runs and (runs[method.folder][0] / TRACES_FILE).exists()
    }
    if traced:
        first = {method: trace[trace["position"] == 0] for method, trace in traced.items()}
        section.contents["torque_traces.png"] = figures.picture(
            lambda figure: figures.draw_shaking(figure, first, position=0), "An attempt of each policy that tells torques"
        )
    return section


def _runs(results_dir: Path, group: str, name: str) -> Runs:
    """The runs in the folder whose configuration has that choice of a group."""
    found = find_runs(results_dir / BEYOND) if (results_dir / BEYOND).is_dir() else {}
    return {run: seeds for run, seeds in found.items() if read_config(seeds[0]).get(group, {}).get("name") == name}


def _buffer(folders: Sequence[Path]) -> str:
    return str(read_config(folders[0])["buffer"]["name"])


def _begun(results_dir: Path, runs: Runs) -> Section:
    """An empty section, with a remark on the runs that are not tested yet."""
    untested = sum(not (folder / "evaluation.csv").exists() for seeds in runs.values() for folder in seeds)
    test = command(results_dir / BEYOND, "evaluate")
    return Section(remarks=[f"beyond the paper, not tested: {untested} runs; {test} does it"] if untested else [])


def _controllers(runs: Runs) -> Iterator[tuple[str, pd.DataFrame]]:
    """What the controllers do on the layouts, from the first run that has it: it is the same for all of them."""
    for file, name in _CONTROLLERS.items():
        for seeds in runs.values():
            having = [folder for folder in seeds if (folder / file).exists()]
            if having:
                yield name, read_evaluations({name: having[:1]}, file)[name]
                break


def _row_past(method: str, rows: pd.DataFrame) -> dict[str, Any]:
    touched = rows["touched"].astype(float)
    success = tables.success(rows)
    force = rows.loc[touched > 0.0, "obstacle_contact_n"]
    return {
        "method": method,
        **success,
        "touched": touched.mean(),
        "neither": 1.0 - success["success_rate"] - touched.mean(),
        "force_median_n": force.median(),
        "force_most_n": force.max(),
        "median_time_s": rows["time_s"].median(),
    }


def _row_told(buffer: str, folders: Sequence[Path], rows: pd.DataFrame) -> dict[str, Any]:
    last = read_seeds(folders, "progress.csv", PROGRESS).groupby("seed").last()
    return {
        "method": buffer,
        "episodes": read_config(folders[0])["episodes"],
        **tables.success(rows),
        "final_distance_m": rows["final_distance_m"].median(),
        "control_steps_per_decision": (last["control_steps"] / last["decisions"]).mean(),
        "median_time_s": rows["time_s"].median(),
    }


def _add_learning(section: Section, file: str, runs: Runs, evaluations: Mapping[str, pd.DataFrame], words: str) -> None:
    """The picture of how the runs that were tested learned, over experiences and over simulated time."""
    curves = {name: tables.curve(read_seeds(runs[name], "progress.csv", PROGRESS)) for name in runs if len(evaluations[name])}
    rows = [
        {"run": name, "buffer": _buffer(runs[name]), **tables.success(evaluations[name])}
        for name, curve in curves.items()
        if len(curve)
    ]
    if rows:
        section.contents[file] = figures.picture(
            lambda figure: figures.draw_runs(figure, pd.DataFrame(rows), curves, tables.RATE, timed=True), words
        )
