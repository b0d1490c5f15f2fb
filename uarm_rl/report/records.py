"""What the CSV files of the runs hold: every cell is checked, and a bad one is named; nothing is computed here."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Final, NamedTuple

import pandas as pd
import yaml

from uarm_rl import columns, csvfile, files
from uarm_rl.checks import command, results_folder
from uarm_rl.columns import Columns, pick

#: The folders of the runs of each name, in the order of their seeds.
Runs = Mapping[str, Sequence[Path]]


#: Hidden folders, and names that a spreadsheet would take for formulas.
_HIDDEN: Final = (".", "=", "+", "-", "@")


class ReportError(ValueError):
    """A sentence: why no report can be made of a folder, and what to do."""


#: A style of Matplotlib: a name, or an offset and the lengths of dashes and gaps.
Line = str | tuple[int, tuple[int, ...]]


class Method(NamedTuple):
    """A row of Table 1; ``folder`` is the run's ``name`` below the results folder."""

    label: str
    folder: str
    buffer: str = ""
    reward: str = ""
    colour: str = "#000000"
    line: Line = "-"

    @property
    def words(self) -> str:
        """What a legend says of it."""
        parts = [self.buffer, self.reward] if self.buffer else []
        return f"{self.label}: {', '.join(parts)}" if parts else self.label


#: The paper's four methods, in colours of Okabe and Ito (2008) that colour-blind readers can tell apart, and in lines that
#: can be told apart in grey.
METHODS: Final = (
    Method("A", "adaptive-plain", "adaptive", "plain", "#0072B2", "-"),
    Method("B", "uniform-plain", "uniform", "plain", "#E69F00", "--"),
    Method("C", "adaptive-penalty", "adaptive", "penalty", "#009E73", "-."),
    Method("D", "uniform-penalty", "uniform", "penalty", "#CC79A7", ":"),
)
INVERSE_KINEMATICS: Final = Method("IK", "ik", colour="#000000", line=(0, (1, 3)))
#: Method C trained against the firmware's own motion.
REAL_ARM: Final = Method("real_arm", "real_arm", "adaptive", "penalty", "#D55E00", (0, (6, 1, 1, 1, 1, 1)))
#: Colours and lines of other runs, again and again.
_OTHERS: Final[tuple[tuple[str, Line], ...]] = (
    ("#56B4E9", (0, (4, 2))),
    ("#F0E442", (0, (2, 1))),
    ("#777777", (0, (5, 3, 1, 3))),
    ("#8C564B", (0, (1, 2, 1, 4))),
)

#: Columns that say how restless an arm is: heading in the printed tables, factor to the heading's unit, decimals.
SHAKING: Final = {
    "reversals_per_s": ("Reversals (1/s)", 1.0, 2),
    "rms_jerk": ("RMS jerk (m/s³)", 1.0, 1),
    "tip_travel_last_s_m": ("Tip travel (mm, last second)", 1000.0, 1),
    "time_s": ("Time (s)", 1.0, 2),
    "object_displacement_m": ("Object moved (mm)", 1000.0, 1),
}


RETURNS: Final = ("common_return", "return")
#: Columns that say how an arm leans on the object.
LEANING: Final = {"press_m": ("Pressed (mm)", 1000.0, 1), "contact_n": ("Contact (N)", 1.0, 1)}

EVALUATION: Final = {
    **pick(columns.MEASURED, "position", "success", *RETURNS, *SHAKING),
    **columns.CONDITIONS,
    **columns.SETTLED,
    **columns.LEANING,
    **columns.TOUCHING,
    "final_distance_m": columns.MEASURED["final_distance_m"]._replace(optional=True),
}
BUDGETS: Final = ("experiences", "updates", "decisions", "control_steps")
PROGRESS: Final = pick(columns.PROGRESS, "episode", *BUDGETS, "episode_return", "validation_success_rate")
#: Further columns of the log, on what the object suffered while the policy learned.
DISTURBANCE: Final = pick(columns.PROGRESS, "successes", "object_losses", "object_moved_m")
TRACES: Final = pick(columns.TRACES, "position", "time_s", *columns.STATE)
#: Trials: what the table counts, and what is shown of each where it is known.
TRIALS: Final = {
    **pick(columns.TRIALS, "success", "reached", "emulated"),
    **{
        name: columns.TRIALS[name]._replace(empty=True, optional=True)
        for name in (
            "trial",
            "target_x_m",
            "target_y_m",
            "time_s",
            "final_distance_m",
            "decisions",
            "camera_misfit_px",
            "reason",
        )
    },
}

#: The engine of the published runs, and of whatever does not say its engine because it is older.
OLDEST_ENGINE: Final = "pybullet"
_MIXED: Final = "no number of a report may be of two engines, so give those of one another name, or another folder"

_REMEDIES: Final = {
    "evaluation.csv": "delete it and evaluate the run again",
    "progress.csv": "restore it, or train again under another name",
    "trials.csv": "delete it, or restore it",
    "paper.csv": "restore it, or delete it to use the packaged one",
    "trajectories.csv": "delete it, or make it again with benchmarks/engines.py",
}


def find_runs(results_dir: Path) -> dict[str, list[Path]]:
    """The run folders of each ``name`` below ``results_dir``, in order."""
    runs: dict[str, list[Path]] = {}
    for folder in results_folder(results_dir).glob("*/seed*"):
        is_run = (folder / "progress.csv").exists() or (folder / "evaluation.csv").exists()
        if is_run and re.fullmatch(r"seed\d+", folder.name) and not folder.parent.name.startswith(_HIDDEN):
            runs.setdefault(folder.parent.name, []).append(folder)
    return {name: sorted(runs[name], key=seed_number) for name in sorted(runs)}


def seed_number(folder: Path) -> int:
    """The seed that a run's folder is named after."""
    return int(folder.name.removeprefix("seed"))


def methods(runs: Runs) -> list[Method]:
    """The paper's four, run or not; then whatever else was run, with the buffer and the reward of its configuration."""
    others = [method for method in (INVERSE_KINEMATICS, REAL_ARM) if method.folder in runs]
    known = {method.folder for method in (*METHODS, *others)}
    own = [
        Method(name, name, *_buffer_and_reward(runs[name][0]), *_OTHERS[number % len(_OTHERS)])
        for number, name in enumerate(sorted(set(runs) - known))
    ]
    return [*METHODS, *others, *own]


def _buffer_and_reward(folder: Path) -> tuple[str, str]:
    """The names of both in a run's configuration; empty where it does not tell."""
    settings = read_config(folder)
    buffer, reward = (
        settings[group].get("name") if isinstance(settings.get(group), dict) else None for group in ("buffer", "reward")
    )
    return (buffer, reward) if isinstance(buffer, str) and isinstance(reward, str) else ("", "")


def trained_in(folders: Sequence[Path]) -> str:
    """The engine that the runs of one name were trained in; empty if no configuration tells.

    Raises :class:`ReportError` if it is not the same for all of them.
    """
    sims = [settings.get("sim") for settings in map(read_config, folders) if settings]
    names = {str(sim.get("name", OLDEST_ENGINE)) if isinstance(sim, dict) else OLDEST_ENGINE for sim in sims}
    if len(names) > 1:
        raise ReportError(f"the runs in {folders[0].parent} were trained in {_and(names)}; {_MIXED}")
    return next(iter(names), "")


def check_engines(*tests: Mapping[str, pd.DataFrame]) -> None:
    """Raises :class:`ReportError` if evaluations that one name has in these tests were made in different engines."""
    for name in dict.fromkeys(name for test in tests for name in test):
        if len(names := {engine for test in tests if name in test for engine in test[name]["engine"]}) > 1:
            raise ReportError(f"the evaluations of {name} were made in {_and(names)}; {_MIXED}")


def _and(names: Collection[str]) -> str:
    return " and ".join(sorted(names))


def in_engines(methods: Sequence[Method], runs: Runs, evaluations: Mapping[str, pd.DataFrame]) -> list[Method]:
    """The methods, with the engine in the label where it is another than that of the published runs."""
    named = []
    for method in methods:
        trained, tested = trained_in(runs[method.folder]), next(iter(evaluations[method.folder]["engine"]), "")
        engines = [*dict.fromkeys(engine for engine in (trained, tested) if engine)]
        plain = engines in ([], [OLDEST_ENGINE])
        named.append(method if plain else method._replace(label=f"{method.label} ({', tested in '.join(engines)})"))
    return named


def read_config(folder: Path) -> dict[str, Any]:
    """A run's configuration as it was written; empty where there is none that can be read."""
    try:
        settings = yaml.safe_load(files.read(folder / files.CONFIG, at_most=1 << 20))
    except (OSError, yaml.YAMLError, ValueError, RecursionError):
        return {}
    return settings if isinstance(settings, dict) else {}


def read_seeds(folders: Sequence[Path], file: str, columns: Columns) -> pd.DataFrame:
    """One file of every seed that has it, one below the other, with the column ``seed``."""
    having = [folder for folder in folders if (folder / file).exists()]
    none = pd.DataFrame(columns=[*columns, "seed"], dtype=float)
    tables = [pd.DataFrame(read(folder / file, columns)).assign(seed=seed_number(folder)) for folder in having]
    table: pd.DataFrame = pd.concat(tables, ignore_index=True) if tables else none
    return table


def read_evaluations(runs: Runs, file: str = "evaluation.csv") -> dict[str, pd.DataFrame]:
    """The evaluations of every name, which must all have been made on the same positions, each once."""
    evaluations = {name: read_seeds(folders, file, EVALUATION) for name, folders in runs.items()}
    for rows in evaluations.values():
        for column, oldest in (("engine", OLDEST_ENGINE), ("object", "solid"), ("cup", "rigid")):
            rows[column] = rows[column].replace("", oldest)
    check_engines(evaluations)
    paths = {(name, seed_number(folder)): folder / file for name, folders in runs.items() for folder in folders}
    first: tuple[Path, list[int]] | None = None
    for name, rows in evaluations.items():
        for seed, positions in rows.groupby("seed")["position"]:
            path, numbers = paths[name, int(str(seed))], sorted(positions)
            first = first or (path, numbers)
            if len(set(numbers)) < len(numbers):
                raise ReportError(f"{path} holds a position twice; {_remedy(path)}")
            if numbers != first[1]:
                spans = [f"{p.parent} ({len(n)} positions, {n[0]:g} to {n[-1]:g})" for p, n in (first, (path, numbers))]
                remedy = "delete one of the two files and evaluate its run as the other one was"
                raise ReportError(f"{' and '.join(spans)} were evaluated on different positions; {remedy}")
    return evaluations


def read_paper(results_dir: Path) -> dict[str, float]:
    """The paper's success rate of each method."""
    with resources.as_file(resources.files("uarm_rl.report") / "paper.csv") as packaged:
        own = results_dir / "paper.csv"
        table = read(own if own.exists() else packaged, columns.PAPER)
    return dict(zip(table["method"], table["success_rate"], strict=True))


def lacking(runs: Runs, file: str) -> str:
    """How many of the evaluated runs lack ``file``, as in ``3 of 12 runs``; empty if none. The reference does not count."""
    evaluated = [
        folder
        for name, folders in runs.items()
        for folder in folders
        if (folder / "evaluation.csv").exists() and name != INVERSE_KINEMATICS.folder
    ]
    without = [folder for folder in evaluated if not (folder / file).exists()]
    return f"{len(without)} of {len(evaluated)} runs" if without else ""


def missing(results_dir: Path, what: str, runs: Runs, options: Mapping[str, str]) -> list[str]:
    """A remark that names the files which evaluated runs lack, and the command that makes the first."""
    absent = [(file, option, which) for file, option in options.items() if (which := lacking(runs, file))]
    if not absent:
        return []
    named = ", ".join(f"{file} ({which})" for file, _, which in absent)
    return [f"{what}, missing: {named}; {command(results_dir, f'evaluate {absent[0][1]} out={absent[0][0]}')} makes it"]


def read(path: Path, columns: Columns) -> dict[str, list[Any]]:
    """The named columns of a CSV file: numbers of their kind, or text."""
    try:
        table = csvfile.read(path, columns)
    except csvfile.CsvError as error:
        raise ReportError(f"{error}; {_remedy(path)}") from error
    except OSError as error:
        raise ReportError(f"{path} cannot be read ({error}); {_remedy(path)}") from error
    if not table.lines and path.name != "progress.csv":  # a training that has just begun has no row yet
        raise ReportError(f"{path} holds no row below its header; {_remedy(path)}")
    return table.values


def _remedy(path: Path) -> str:
    return _REMEDIES.get(path.name, f"delete it and evaluate again, with out={path.name}")
