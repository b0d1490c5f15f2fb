"""Table 1, the reward figure and the learning curves, rebuilt from the CSV files of the runs and nothing else."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from uarm_rl import figures, files, statistics

#: Hidden folders, and names that a spreadsheet would take for formulas.
_HIDDEN: Final = (".", "=", "+", "-", "@")


class ReportError(ValueError):
    """A sentence: why no report can be made of a folder, and what to do."""


class Method(NamedTuple):
    """A row of Table 1; ``folder`` is the run's ``name`` below the results folder."""

    label: str
    folder: str
    buffer: str = ""
    reward: str = ""
    colour: str = ""


#: The paper's four methods, in colours of Okabe and Ito (2008) that colour-blind readers can tell apart.
METHODS: Final = (
    Method("A", "adaptive-plain", "adaptive", "plain", "#0072B2"),
    Method("B", "uniform-plain", "uniform", "plain", "#E69F00"),
    Method("C", "adaptive-penalty", "adaptive", "penalty", "#009E73"),
    Method("D", "uniform-penalty", "uniform", "penalty", "#CC79A7"),
)
INVERSE_KINEMATICS: Final = Method("IK", "ik")

#: Columns that say how restless an arm is: heading in the printed tables, factor to the heading's unit, decimals.
SHAKING: Final = {
    "reversals_per_s": ("Reversals (1/s)", 1.0, 2),
    "rms_jerk": ("RMS jerk (m/s³)", 1.0, 1),
    "tip_travel_last_s_m": ("Tip travel (mm, last second)", 1000.0, 1),
    "time_s": ("Time (s)", 1.0, 2),
    "object_displacement_m": ("Object moved (mm)", 1000.0, 1),
}
CAPTION: Final = (
    "Success: share of the test positions, mean over seeds; its interval is Wilson's for one seed, a bootstrap over "
    "seeds and positions for several. The columns after the paper's success are means over seeds and positions."
)
SMOOTHING_EPISODES: Final = 20
_BOOTSTRAP_SEED: Final = 20190701  # any fixed number: the same files give the same interval

_HEADINGS: Final = (
    "Method",
    "Buffer",
    "Reward",
    "Seeds",
    "Success (95 % interval)",
    "Paper",
    *(row[0] for row in SHAKING.values()),
)
_EVALUATE_ALIKE: Final = "evaluate all runs on the same positions with `uarm-rl evaluate overwrite=true`"
_REMEDIES: Final = {
    "evaluation.csv": "delete it and run `uarm-rl evaluate`",
    "progress.csv": "restore it, or train again with `uarm-rl train overwrite=true`",
    "paper.csv": "restore it, or delete it to use the packaged one",
}


class _Kind(NamedTuple):
    """What the cells of a column may hold; an empty cell is NaN, one without a finite number infinity."""

    allows: Callable[[float], bool]
    words: str


_FINITE: Final = _Kind(math.isfinite, "a finite number")
_WHOLE: Final = _Kind(lambda value: value.is_integer() and abs(value) < 2**53, "a whole number")
_OUTCOME: Final = _Kind(lambda value: value in (0.0, 1.0), "0 or 1")
_RATE: Final = _Kind(lambda value: 0.0 <= value <= 1.0, "a number from 0 to 1")
_RATE_OR_EMPTY: Final = _Kind(lambda value: math.isnan(value) or 0.0 <= value <= 1.0, "empty or a number from 0 to 1")

_RETURNS: Final = ("common_return", "return")
_EVALUATION: Final = {"position": _WHOLE, "success": _OUTCOME, **dict.fromkeys((*_RETURNS, *SHAKING), _FINITE)}
_PROGRESS: Final = {
    "episode": _WHOLE,
    "experiences": _WHOLE,
    "episode_return": _FINITE,
    "validation_success_rate": _RATE_OR_EMPTY,
}


def report(results_dir: Path) -> str:
    """Rebuild the tables and pictures in ``results_dir`` from the CSV files below it; returns Table 1 to print.

    Reads ``<name>/seed<k>/progress.csv`` and ``evaluation.csv``, and ``paper.csv`` (if absent, the packaged one).
    The pictures show methods A to D, the tables every run. Raises :class:`ReportError`, with nothing written, if a
    file cannot be used.
    """
    found = _find_runs(results_dir)
    methods = _methods(found)
    runs = {method.folder: found.get(method.folder, []) for method in methods}
    paper = _read_paper(results_dir)
    evaluations = {folder: _read_seeds(seeds, "evaluation.csv", _EVALUATION) for folder, seeds in runs.items()}
    progress = {folder: _read_seeds(seeds, "progress.csv", _PROGRESS) for folder, seeds in runs.items()}
    _check_positions(results_dir, evaluations)

    table = [_row(method, evaluations[method.folder], paper) for method in methods]
    cells = [_cells(row, trained=len(runs[method.folder])) for row, method in zip(table, methods, strict=True)]
    rewards = {folder: _over_seeds(rows, "position", _RETURNS) for folder, rows in evaluations.items()}
    learning = {folder: _learning_curve(rows) for folder, rows in progress.items()}
    contents = {
        "table1.csv": _csv(pd.DataFrame(table)),
        "table1.md": _markdown(cells).encode(),
        "reward_curve.csv": _csv(_stacked(methods, rewards)),
        "reward_curve.png": figures.picture(lambda figure: figures.draw_rewards(figure, METHODS, rewards)),
        "learning_curves.csv": _csv(_stacked(methods, learning)),
        "learning_curves.png": figures.picture(
            lambda figure: figures.draw_learning(figure, METHODS, learning, smoothed_over=SMOOTHING_EPISODES)
        ),
    }
    _write(results_dir, contents)
    return "\n".join([_aligned(cells), "", *_remarks(runs), *(f"wrote {_shown(results_dir / name)}" for name in contents)])


# From files to frames


def _find_runs(results_dir: Path) -> dict[str, list[Path]]:
    """The run folders of each ``name`` below ``results_dir``, in order."""
    if not results_dir.is_dir():
        raise ReportError(f"{results_dir} is not a folder; name one with results_dir=PATH or make one with `uarm-rl train`")
    runs: dict[str, list[Path]] = {}
    for folder in sorted(results_dir.glob("*/seed*")):
        is_run = (folder / "progress.csv").exists() or (folder / "evaluation.csv").exists()
        if is_run and re.fullmatch(r"seed\d+", folder.name) and not folder.parent.name.startswith(_HIDDEN):
            runs.setdefault(folder.parent.name, []).append(folder)
    if not runs:
        raise ReportError(f"{results_dir} holds no run; make one with `uarm-rl train`, then `uarm-rl evaluate`")
    return runs


def _methods(runs: Mapping[str, object]) -> list[Method]:
    """The paper's four, run or not; then whatever else was run."""
    known = {method.folder for method in (*METHODS, INVERSE_KINEMATICS)}
    reference = [INVERSE_KINEMATICS] if INVERSE_KINEMATICS.folder in runs else []
    return [*METHODS, *reference, *(Method(folder, folder) for folder in sorted(set(runs) - known))]


def _read_seeds(folders: Sequence[Path], file: str, columns: Mapping[str, _Kind]) -> pd.DataFrame:
    """One file of every seed that has it, one below the other, with the column ``seed``."""
    having = [folder for folder in folders if (folder / file).exists()]
    none = pd.DataFrame(columns=[*columns, "seed"], dtype=float)
    tables = [pd.DataFrame(_read(folder / file, columns)).assign(seed=folder.name) for folder in having]
    table: pd.DataFrame = pd.concat(tables, ignore_index=True) if tables else none
    return table


def _read_paper(results_dir: Path) -> dict[str, float]:
    """The paper's success rate of each method."""
    with resources.as_file(resources.files("uarm_rl") / "paper.csv") as packaged:
        own = results_dir / "paper.csv"
        table = _read(own if own.exists() else packaged, {"method": None, "success_rate": _RATE})
    return dict(zip(table["method"], table["success_rate"], strict=True))


def _read(path: Path, columns: Mapping[str, _Kind | None]) -> dict[str, list[Any]]:
    """The named columns of a CSV file: numbers of their kind, or text where the kind is ``None``."""
    remedy = _REMEDIES[path.name]
    try:
        text = io.StringIO(files.read(path).decode(), newline="")
        header, *rows = [*csv.reader(text, strict=True)] or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ReportError(f"{path} cannot be read ({error}); {remedy}") from error
    if missing := [column for column in columns if column not in header]:
        raise ReportError(f"{path} lacks the column {missing[0]}; {remedy}")
    if not rows and path.name != "progress.csv":  # a training that has just begun has no row yet
        raise ReportError(f"{path} holds no row below its header; {remedy}")
    table: dict[str, list[Any]] = {column: [] for column in columns}
    for line, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise ReportError(f"{path}, line {line}: {len(row)} values for {len(header)} columns; {remedy}")
        for column, kind in columns.items():
            text = row[header.index(column)]
            value = text if kind is None else _number(text)
            if kind is not None and not kind.allows(value):
                raise ReportError(f"{path}, line {line}: {column} is {text!r} and must be {kind.words}; {remedy}")
            table[column].append(value)
    return table


def _number(text: str) -> float:
    try:
        value = float(text or "nan")
    except ValueError:
        return math.inf
    return value if math.isfinite(value) or not text else math.inf


def _check_positions(results_dir: Path, evaluations: Mapping[str, pd.DataFrame]) -> None:
    """All runs were tested on the same positions, each once."""
    first: tuple[Path, list[int]] | None = None
    for folder, rows in evaluations.items():
        for seed, positions in rows.groupby("seed")["position"]:
            run, numbers = results_dir / folder / str(seed), sorted(positions)
            first = first or (run, numbers)
            if len(set(numbers)) < len(numbers):
                raise ReportError(f"{run / 'evaluation.csv'} holds a position twice; {_REMEDIES['evaluation.csv']}")
            if numbers != first[1]:
                spans = [f"{run} ({len(n)} positions, {n[0]:g} to {n[-1]:g})" for run, n in (first, (run, numbers))]
                raise ReportError(f"{' and '.join(spans)} were evaluated on different positions; {_EVALUATE_ALIKE}")


# From frames to tables


def _row(method: Method, rows: pd.DataFrame, paper: Mapping[str, float]) -> dict[str, Any]:
    """The row of table1.csv for one method; NaN where nothing is known."""
    row: dict[str, Any] = {
        "method": method.label,
        "buffer": method.buffer,
        "reward": method.reward,
        "seeds": rows["seed"].nunique(),
        "success_rate": rows["success"].mean(),
        "ci_low": math.nan,
        "ci_high": math.nan,
        "paper_success_rate": paper.get(method.label, math.nan),
        **rows[[*SHAKING]].mean(),
    }
    if len(rows):
        outcomes = rows.pivot(index="seed", columns="position", values="success").to_numpy()
        generator = np.random.default_rng(_BOOTSTRAP_SEED)
        row["ci_low"], row["ci_high"] = statistics.success_interval(outcomes, generator)
    return row


def _over_seeds(rows: pd.DataFrame, key: str, values: Sequence[str], **further: tuple[str, str]) -> pd.DataFrame:
    """For each ``key`` the number of seeds, and mean, min and max over them of each value."""
    spread = {f"{value}_{how}": (value, how) for value in values for how in ("mean", "min", "max")}
    groups = rows.astype({key: int}).groupby(key, as_index=False)
    table: pd.DataFrame = groups.agg(seeds=("seed", "nunique"), **further, **spread)
    return table


def _learning_curve(rows: pd.DataFrame) -> pd.DataFrame:
    """Experiences, validation success and smoothed return after each episode, over seeds."""
    returns = rows.groupby("seed")["episode_return"]
    smoothed = returns.transform(lambda one_seed: one_seed.rolling(SMOOTHING_EPISODES, min_periods=1).mean())
    values = ("validation_success_rate", "smoothed_return")
    curve = _over_seeds(rows.assign(smoothed_return=smoothed), "episode", values, experiences=("experiences", "mean"))
    curve["experiences"] = curve["experiences"].round().astype(int)
    return curve


def _stacked(methods: Sequence[Method], curves: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """The curves of all methods, one below the other, told apart by the first column."""
    table: pd.DataFrame = pd.concat([curves[method.folder] for method in methods])
    table.insert(0, "method", [method.label for method in methods for _ in range(len(curves[method.folder]))])
    return table


def _csv(table: pd.DataFrame) -> bytes:
    return table.to_csv(index=False, float_format="%.6g", lineterminator="\n").encode()


# From tables to text


def _cells(row: Mapping[str, Any], *, trained: int) -> list[str]:
    """The row of a printed table, under ``_HEADINGS``."""
    evaluated = row["seeds"]
    success = f"{_percent(row['success_rate'])} ({_percent(row['ci_low'], '')} to {_percent(row['ci_high'])})"
    return [
        row["method"],
        row["buffer"] or "-",
        row["reward"] or "-",
        "-" if not trained else str(evaluated) if evaluated == trained else f"{evaluated} of {trained}",
        success if evaluated else "-",
        _percent(row["paper_success_rate"]),
        *(f"{row[column] * factor:.{decimals}f}" if evaluated else "-" for column, (_, factor, decimals) in SHAKING.items()),
    ]


def _percent(rate: float, unit: str = " %") -> str:
    return "-" if math.isnan(rate) else f"{round(100.0 * rate, 1):g}{unit}"


def _markdown(cells: Sequence[Sequence[str]]) -> str:
    rule = ["---"] * 3 + ["---:"] * (len(_HEADINGS) - 3)
    lines = ["| " + " | ".join(row) + " |" for row in (_HEADINGS, rule, *cells)]
    return "\n".join([*lines, "", CAPTION, ""])


def _aligned(cells: Sequence[Sequence[str]]) -> str:
    """The table in columns of equal width, with the brackets of the headings on a second line."""
    names, _, brackets = zip(*(heading.partition(" (") for heading in _HEADINGS), strict=True)
    rows = [names, [bracket.rstrip(")") for bracket in brackets], *cells]
    sides = "<<<" + ">" * (len(names) - 3)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=True)) for row in rows]
    lines.insert(2, "  ".join("-" * width for width in widths))
    return "\n".join(line.rstrip() for line in lines)


def _remarks(runs: Mapping[str, Sequence[Path]]) -> list[str]:
    """What the table cannot show because it was not run."""
    absent = [f"{method.label} ({method.folder})" for method in METHODS if not runs[method.folder]]
    waiting = [str(_shown(run)) for seeds in runs.values() for run in seeds if not (run / "evaluation.csv").exists()]
    return [
        *([f"not trained: {', '.join(absent)}"] if absent else []),
        *([f"not evaluated (`uarm-rl evaluate` does it): {', '.join(waiting)}"] if waiting else []),
    ]


def _shown(path: Path) -> Path:
    """``path`` relative to the current folder if it lies below it."""
    return path.absolute().relative_to(Path.cwd()) if path.absolute().is_relative_to(Path.cwd()) else path


def _write(results_dir: Path, contents: Mapping[str, bytes]) -> None:
    """Replace the files, each atomically."""
    try:
        for name, content in contents.items():
            files.replace(results_dir / name, content)
    except OSError as error:
        raise ReportError(f"{results_dir} cannot take the report ({error.strerror}); make it writable") from error
