"""Table 1, the reward figure, the learning curves and the shaking figure, from the CSV files of the runs and nothing else.

``report`` also calls the other sections of the report, each a module of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd

from uarm_rl import files
from uarm_rl.report import figures, tables
from uarm_rl.report.ablations import ABLATIONS, ablations
from uarm_rl.report.arm_trials import arm_trials
from uarm_rl.report.comparisons import comparisons
from uarm_rl.report.records import (
    METHODS,
    PROGRESS,
    RETURNS,
    SHAKING,
    TRACES,
    Method,
    ReportError,
    Runs,
    command,
    find_runs,
    methods,
    read,
    read_evaluations,
    read_paper,
    read_seeds,
)
from uarm_rl.report.robustness import held_out, holds, tolerance
from uarm_rl.report.sample_efficiency import budgets
from uarm_rl.report.tables import Section

CAPTION: Final = (
    "Success: share of the test positions, mean over seeds; its interval is Wilson's for one seed, a bootstrap over "
    "seeds and positions for several. The columns after the paper's success are means over seeds and positions."
)
SMOOTHING_EPISODES: Final = 20

_HEADINGS: Final = (
    "Method",
    "Buffer",
    "Reward",
    "Seeds",
    "Success (95 % interval)",
    "Paper",
    *(row[0] for row in SHAKING.values()),
)
_TRACES: Final = "evaluation-traces.csv"


def report(results_dir: Path) -> str:
    """Rebuild the tables and pictures in ``results_dir`` from the CSV files below it; returns Table 1 to print.

    Reads ``<name>/seed<k>/progress.csv``, ``evaluation.csv`` and the other evaluations there, ``paper.csv`` (if absent,
    the packaged one), and the runs in ``ablations/``. Tables and pictures show every run that is there. Raises
    :class:`ReportError`, with nothing written, if a file cannot be used.
    """
    found = find_runs(results_dir)
    if not found and not (results_dir / ABLATIONS).is_dir():
        raise ReportError(f"{results_dir} holds no run; make one with `uarm-rl train`, then `uarm-rl evaluate`")
    shown = methods(found)
    runs = {method.folder: found.get(method.folder, []) for method in shown}
    evaluations = read_evaluations(runs)
    progress = {folder: read_seeds(seeds, "progress.csv", PROGRESS) for folder, seeds in runs.items()}

    table = [_row(method, evaluations[method.folder], read_paper(results_dir)) for method in shown]
    cells = [_cells(row, trained=len(runs[method.folder])) for row, method in zip(table, shown, strict=True)]
    sections = [
        Section(
            {
                "table1.csv": tables.csv(pd.DataFrame(table)),
                "table1.md": f"{tables.markdown(_HEADINGS, cells, left=3)}\n{CAPTION}\n".encode(),
            },
            _remarks(results_dir, runs),
        ),
        _rewards(shown, evaluations),
        _learning(shown, progress),
        _shaking(results_dir, runs),
        comparisons(evaluations),
        budgets(shown, progress, evaluations),
        tolerance(results_dir, shown, runs, evaluations),
        held_out(results_dir, shown, runs, evaluations),
        holds(results_dir, shown, runs, evaluations),
        ablations(results_dir),
        arm_trials(results_dir),
    ]
    names = _write(results_dir, sections)
    remarks = [remark for section in sections for remark in section.remarks]
    wrote = [f"wrote {_shown(results_dir / name)}" for name in names]
    return "\n".join([tables.aligned(_HEADINGS, cells, left=3), "", *remarks, *wrote])


# Table 1


def _row(method: Method, rows: pd.DataFrame, paper: Mapping[str, float]) -> dict[str, Any]:
    """The row of table1.csv for one method; NaN where nothing is known."""
    return {
        "method": method.label,
        "buffer": method.buffer,
        "reward": method.reward,
        **tables.success(rows),
        "paper_success_rate": paper.get(method.label, float("nan")),
        **rows[[*SHAKING]].mean(),
    }


def _cells(row: Mapping[str, Any], *, trained: int) -> list[str]:
    """The row of a printed table, under ``_HEADINGS``."""
    evaluated = row["seeds"]
    return [
        row["method"],
        row["buffer"] or "-",
        row["reward"] or "-",
        "-" if not trained else str(evaluated) if evaluated == trained else f"{evaluated} of {trained}",
        tables.success_text(row),
        tables.percent(row["paper_success_rate"]),
        *(f"{row[column] * factor:.{decimals}f}" if evaluated else "-" for column, (_, factor, decimals) in SHAKING.items()),
    ]


def _remarks(results_dir: Path, runs: Runs) -> list[str]:
    """What the table cannot show because it was not run."""
    absent = [f"{method.label} ({method.folder})" for method in METHODS if not runs[method.folder]]
    waiting = [str(_shown(run)) for seeds in runs.values() for run in seeds if not (run / "evaluation.csv").exists()]
    return [
        *([f"not trained: {', '.join(absent)}"] if absent else []),
        *([f"not evaluated ({command(results_dir, 'evaluate')} does it): {', '.join(waiting)}"] if waiting else []),
    ]


# The figures


def _rewards(shown: Sequence[Method], evaluations: Mapping[str, pd.DataFrame]) -> Section:
    """The paper's Fig. 3: the reward of each method on each test position."""
    curves = {folder: tables.over_seeds(rows, "position", RETURNS) for folder, rows in evaluations.items()}
    drawn = [method for method in shown if len(curves[method.folder])]
    if not drawn:
        return Section(remarks=["no reward figure: no run has been evaluated yet"])
    return Section(
        {
            "reward_curve.csv": tables.csv(tables.stacked(shown, curves)),
            "reward_curve.png": figures.picture(
                lambda figure: figures.draw_rewards(figure, drawn, curves), 1.2 + 0.8 * len(drawn)
            ),
        }
    )


def _learning(shown: Sequence[Method], progress: Mapping[str, pd.DataFrame]) -> Section:
    """Experiences, validation success and smoothed return after each episode, over seeds."""
    curves = {}
    for folder, rows in progress.items():
        returns = rows.groupby("seed")["episode_return"]
        smoothed = returns.transform(lambda one_seed: one_seed.rolling(SMOOTHING_EPISODES, min_periods=1).mean())
        values = ("validation_success_rate", "smoothed_return")
        experiences = {"experiences": ("experiences", "mean")}
        curve = tables.over_seeds(rows.assign(smoothed_return=smoothed), "episode", values, **experiences)
        curve["experiences"] = curve["experiences"].round().astype(int)
        curves[folder] = curve
    drawn = [method for method in shown if len(curves[method.folder])]
    if not drawn:
        return Section(remarks=["no learning curves: no run has finished an episode yet"])
    return Section(
        {
            "learning_curves.csv": tables.csv(tables.stacked(shown, curves)),
            "learning_curves.png": figures.picture(
                lambda figure: figures.draw_learning(figure, drawn, curves, smoothed_over=SMOOTHING_EPISODES),
                4.8,
            ),
        }
    )


def _shaking(results_dir: Path, runs: Runs) -> Section:
    """shaking.png: what A and B (or else C and D) do on the same position, from the traces of the lowest seed.

    Of the recorded positions it is the one that takes the uniform method longest: an arm that shakes comes to no end.
    """
    pairs = [(METHODS[0], METHODS[1]), (METHODS[2], METHODS[3])]
    for pair in pairs:
        recorded = [[run / _TRACES for run in runs[method.folder] if (run / _TRACES).exists()] for method in pair]
        if all(recorded):
            traces = {method: pd.DataFrame(read(paths[0], TRACES)) for method, paths in zip(pair, recorded, strict=True)}
            common = sorted(set.intersection(*(set(trace["position"]) for trace in traces.values())))
            if common:
                durations_s = traces[pair[1]].groupby("position")["time_s"].max()
                position = int(durations_s[common].idxmax())
                chosen = {method: trace[trace["position"] == position] for method, trace in traces.items()}
                picture = figures.picture(lambda figure: figures.draw_shaking(figure, chosen, position=position))  # noqa: B023
                return Section({"shaking.png": picture})
    if not all(runs[method.folder] for method in pairs[0]) and not all(runs[method.folder] for method in pairs[1]):
        return Section()  # nothing to compare
    record = command(results_dir, "evaluate traces=3")
    return Section(remarks=[f"no shaking.png: {_TRACES} is missing for A and B, or C and D; {record} records it"])


# Files


def _shown(path: Path) -> Path:
    """``path`` relative to the current folder if it lies below it."""
    return path.absolute().relative_to(Path.cwd()) if path.absolute().is_relative_to(Path.cwd()) else path


def _write(results_dir: Path, sections: Iterable[Section]) -> list[str]:
    """Replace the files, each atomically; their names."""
    contents = {name: content for section in sections for name, content in section.contents.items()}
    try:
        for name, content in contents.items():
            files.replace(results_dir / name, content)
    except OSError as error:
        raise ReportError(f"{results_dir} cannot take the report ({error.strerror}); make it writable") from error
    return [*contents]
