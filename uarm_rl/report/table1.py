"""Table 1: the success of every method beside the paper's, how restless its arm is, and how it leans on the object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd

from uarm_rl.checks import command
from uarm_rl.report import tables
from uarm_rl.report.records import LEANING, METHODS, SHAKING, Method, Runs, read_config, read_paper
from uarm_rl.report.tables import Content, Document, Section, Table

_FURTHER: Final = {**SHAKING, **LEANING}
_EPISODES: Final = 1500  # paper 4.1
_METHODS: Final = (
    "A and C learn from what the arm does once it is at rest (adaptive), B and D from every control step (uniform); C and D "
    "are punished for moving the object (penalty). A position is reached when the cup stays for half a second within the "
    "tolerance, 5 mm unless a run says otherwise, of the middle of the object's upper surface."
)
_SILENCE: Final = (
    "The paper does not say how near the cup has to come, so its column is no aim at 5 mm. Where `uarm-rl evaluate "
    "until=time_limit` has been run too, the next section has ours and the paper's at one tolerance that was fitted."
)
_CAPTION: Final = (
    "Success: share of the test positions, mean over seeds; its interval is Wilson's for one seed, a bootstrap over "
    "seeds and positions for several. The columns behind the paper's are means over seeds and positions. Reversals: "
    "control steps a second that move against the one before. Jerk and travel: of the cup's tip. Time: until the "
    "success, or all of the time limit. Pressed: the deepest that the cup was below the object's upper surface. Contact: "
    "the largest force between them."
)
_HEADINGS: Final = (
    "Method",
    "Buffer",
    "Reward",
    "Seeds",
    "Success (95 % interval)",
    "Paper",
    *(row[0] for row in _FURTHER.values()),
)
_LABELS: Final = {method.folder: method.label for method in METHODS}  # in the paper


def table1(results_dir: Path, methods: Sequence[Method], runs: Runs, evaluations: Mapping[str, pd.DataFrame]) -> Section:
    """table1.csv and .md; its ``text`` is the same table for a terminal."""
    paper = read_paper(results_dir)
    rows = [_row(method, evaluations[method.folder], paper) for method in methods]
    cells = [_cells(row, trained=len(runs[method.folder])) for row, method in zip(rows, methods, strict=True)]
    contents: dict[str, Content] = {
        "table1.csv": tables.csv(pd.DataFrame(rows)),
        "table1.md": Document(Table(_HEADINGS, cells, left=3), *(short := _short(methods, runs)), _METHODS, _SILENCE, _CAPTION),
    }
    text = "\n".join([tables.aligned(_HEADINGS, cells, left=3), *short])
    return Section(contents, _remarks(results_dir, runs), text)


def _short(methods: Sequence[Method], runs: Runs) -> list[str]:
    """A sentence for each method whose training was shorter than the paper's."""
    lengths = {
        method.label: [read_config(run).get("episodes") for run in runs[method.folder]] for method in methods if method.buffer
    }
    return [
        f"{label} was trained for {episodes} of the paper's {_EPISODES} episodes."
        for label, several in lengths.items()
        for episodes in dict.fromkeys(several)
        if isinstance(episodes, int) and episodes < _EPISODES
    ]


def _row(method: Method, rows: pd.DataFrame, paper: Mapping[str, float]) -> dict[str, Any]:
    """The row of table1.csv for one method; NaN where nothing is known."""
    return {
        "method": method.label,
        "buffer": method.buffer,
        "reward": method.reward,
        **tables.success(rows),
        "paper_success_rate": paper.get(_LABELS.get(method.folder, method.label), float("nan")),
        **rows[[*_FURTHER]].mean(),
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
        *(tables.number(row[column] * factor, decimals) for column, (_, factor, decimals) in _FURTHER.items()),
    ]


def _remarks(results_dir: Path, runs: Runs) -> list[str]:
    """What the table cannot show because it was not run."""
    absent = [f"{method.label} ({method.folder})" for method in METHODS if not runs[method.folder]]
    waiting = [str(tables.shown(run)) for seeds in runs.values() for run in seeds if not (run / "evaluation.csv").exists()]
    return [
        *([f"not trained: {', '.join(absent)}"] if absent else []),
        *([f"not evaluated ({command(results_dir, 'evaluate')} does it): {', '.join(waiting)}"] if waiting else []),
    ]
