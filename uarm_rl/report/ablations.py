"""Why it works: the shorter runs of results/ablations, one figure and one table for each question."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Final, NamedTuple

import pandas as pd

from uarm_rl.report import figures, statistics, tables
from uarm_rl.report.records import DISTURBANCE, PROGRESS, Runs, command, find_runs, read_evaluations, read_seeds
from uarm_rl.report.tables import Section

ABLATIONS: Final = "ablations"  # below the results folder


class _Question(NamedTuple):
    """``runs`` are names or patterns of names, in the order of the table.

    ``swept`` is the column that a sweep varies; its table and figure go by it.
    """

    title: str
    runs: tuple[str, ...]
    swept: str | None = None


_QUESTIONS: Final = {
    "halves": _Question(
        "Waiting until steady, or leaving out stuck transitions: which half of the adaptive buffer does it?",
        ("uniform-penalty", "unstuck_only-penalty", "steady_only-penalty", "adaptive-penalty"),
    ),
    "fixed_hold": _Question(
        "Is it the adaptivity, or just a longer hold?",
        ("uniform-penalty", "fixed_hold-penalty", "adaptive-penalty"),
    ),
    "servo": _Question(
        "From which response time of the servo on does waiting win?",
        ("instant-*-penalty", "servo*-penalty", "uniform-penalty", "adaptive-penalty", "long-servo*-penalty"),
        "servo_rise_s",
    ),
    "sigma": _Question(
        "How hard must moving the object be punished, and what does it cost?",
        ("adaptive-plain", "sigma*", "adaptive-penalty"),
        "sigma",
    ),
    "constants": _Question(
        "Does what was found hang on the constants that were chosen?",
        ("uniform-penalty", "adaptive-penalty", "gamma*", "tolerance*", "dwell*", "damping*", "beta*", "threshold*"),
        "setting",
    ),
}

_HEADINGS: Final = {
    "setting": "Changed",
    "servo_rise_s": "Servo rise (s)",
    "sigma": "Sigma (1/m)",
    "control_steps_per_decision": "Control steps a decision",
    "object_displacement_m": "Object moved (mm)",
    "training_displacement_m": "Moved while learning (mm per object)",
}
_UNITS: Final = {"dwell": "s", "threshold": "rad"}
_DISPLACEMENT: Final = "object_displacement_m"
_TRAINING_DISPLACEMENT: Final = "training_displacement_m"
_RATE: Final = "validation_success_rate"
_BOTH: Final = ("adaptive", "uniform")
_LAST_VALIDATIONS: Final = 3  # their mean is the end of a run: one validation has 50 positions


def ablations(results_dir: Path) -> Section:
    """ablations.csv and .md, learning_curves.csv and a picture for each question, all in ``results_dir/ablations``."""
    folder = results_dir / ABLATIONS
    if not folder.is_dir():
        return Section()
    runs = find_runs(folder)
    evaluations = read_evaluations(runs)
    columns = {**PROGRESS, **DISTURBANCE}
    progress = {name: read_seeds(folders, "progress.csv", columns) for name, folders in runs.items()}
    curves = {run: _curve(rows) for run, rows in progress.items()}
    section = Section()
    found: dict[str, pd.DataFrame] = {}
    for name, question in _QUESTIONS.items():
        chosen = [run for wanted in question.runs for run in runs if fnmatch(run, wanted) and len(evaluations[run])]
        section.remarks += _missing(folder, name, question, chosen, runs)
        if chosen:
            rows = [_row(run, evaluations[run], progress[run]) for run in chosen]
            found[name] = _ordered(pd.DataFrame(rows), question.swept)
            section.contents[f"{ABLATIONS}/{name}.png"] = _picture(question.swept, found[name], curves)
    if "constants" in found and len(choice := _choice(found["constants"], progress)):
        section.contents[f"{ABLATIONS}/choice.csv"] = tables.csv(choice)
        section.contents[f"{ABLATIONS}/choice.md"] = _choice_markdown(choice).encode()
    if found:
        stacked = pd.concat([table.assign(question=name) for name, table in found.items()])
        section.contents[f"{ABLATIONS}/ablations.csv"] = tables.csv(stacked[["question", *stacked.columns.drop("question")]])
        section.contents[f"{ABLATIONS}/ablations.md"] = _markdown(found).encode()
        learning = pd.concat(curve.assign(run=run) for run, curve in curves.items())
        section.contents[f"{ABLATIONS}/learning_curves.csv"] = tables.csv(learning[["run", *learning.columns.drop("run")]])
    return section


def _curve(progress: pd.DataFrame) -> pd.DataFrame:
    """Validation success over seeds, episode by episode: seeds that were cut short have stored a few experiences less."""
    validated = progress.dropna(subset=[_RATE])
    return tables.over_seeds(validated, "episode", [_RATE], experiences=("experiences", "mean"))


def _row(run: str, evaluation: pd.DataFrame, progress: pd.DataFrame) -> dict[str, Any]:
    """What is known of one name's runs: success, what the object suffered, and under which conditions."""
    moved = tables.outcomes(evaluation, _DISPLACEMENT)
    low, high = statistics.bootstrap_interval([moved], [1.0], tables.generator(), resamples=tables.resamples(evaluation))
    last, sums = progress.groupby("seed").last(), progress.groupby("seed")[[*DISTURBANCE]].sum()
    buffer = "uniform" if "uniform" in run else "adaptive" if "adaptive" in run else run.partition("-")[0]
    if run.startswith("long-"):
        buffer += f", {last['episode'].max():g} episodes"
    objects = last["episode"] + sums["successes"] + sums["object_losses"]
    return {
        "run": run,
        "buffer": buffer,
        **tables.success(evaluation),
        _DISPLACEMENT: moved.mean(),
        "object_displacement_low": low,
        "object_displacement_high": high,
        _TRAINING_DISPLACEMENT: (sums["object_moved_m"] / objects).mean(),
        "control_steps_per_decision": (last["control_steps"] / last["decisions"]).mean(),
        # Medians, because the mean of equal numbers may differ from them in the last bit.
        "servo_rise_s": evaluation["servo_rise_s"].median(),
        "sigma": evaluation["sigma"].median(),
    }


def _choice(constants: pd.DataFrame, progress: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """How well both methods end on the validation positions with each constant, the only ones a choice may look at.

    ``score`` is the mean of the two methods, and ``standard_error`` its spread over the seeds that both have.
    """
    names = zip(constants["run"], constants["setting"], constants["buffer"], strict=True)
    ends = [_end(progress[run]).assign(setting=setting, buffer=buffer) for run, setting, buffer in names]
    rates = pd.concat(ends).pivot_table(index=["setting", "seed"], columns="buffer", values=_RATE, sort=False)
    both = rates.reindex(columns=[*_BOTH]).dropna()
    columns = {name: (name, "mean") for name in (*_BOTH, "score")}
    choice: pd.DataFrame = (
        both.assign(score=both.mean(axis=1))
        .groupby("setting", sort=False)
        .agg(seeds=("score", "size"), **columns, standard_error=("score", "sem"))
        .reset_index()
    )
    return choice


def _end(progress: pd.DataFrame) -> pd.DataFrame:
    """The validation success at the end of each seed's run."""
    last = progress.dropna(subset=[_RATE]).groupby("seed").tail(_LAST_VALIDATIONS)
    end: pd.DataFrame = last.groupby("seed", as_index=False)[[_RATE]].mean()
    return end


def _choice_markdown(choice: pd.DataFrame) -> str:
    rates = [*_BOTH, "score", "standard_error"]
    cells = [
        [row["setting"], str(row["seeds"]), *(tables.percent(row[rate]) for rate in rates)] for row in tables.records(choice)
    ]
    headings = ("Changed", "Seeds", "Adaptive", "Uniform", "Score", "Standard error")
    words = (
        f"Success on the validation positions, mean of the last {_LAST_VALIDATIONS} validations of each run. "
        "The score is the mean of both methods; its standard error is over seeds."
    )
    return f"{tables.markdown(headings, cells)}\n{words}\n"


def _ordered(table: pd.DataFrame, swept: str | None) -> pd.DataFrame:
    """Sweeps from instant to slow and from no punishment to much, the others in the order of the question."""
    ordered = table
    if swept == "setting":
        names = table["run"].str.rpartition("-")[0].str.replace(r"(?<=[a-z])(?=\d)", " ", regex=True)
        changed = names.map(_worded).mask(table["run"].str.endswith("-penalty"), "default")
        ordered = table.assign(setting=changed)
    elif swept:
        ordered = table.sort_values([swept, "buffer"], ascending=swept != "sigma", kind="stable")
    return ordered


def _worded(setting: str) -> str:
    """A changed constant with its unit, from the run's name: ``dwell 0.25`` is ``dwell 0.25 s``."""
    name, _, value = setting.partition(" ")
    if name == "tolerance":
        return f"tolerance {1000.0 * float(value):g} mm"
    return f"{setting} {_UNITS[name]}" if name in _UNITS else setting


def _picture(swept: str | None, table: pd.DataFrame, curves: Mapping[str, pd.DataFrame]) -> bytes:
    if swept == "servo_rise_s":
        return figures.picture(lambda figure: figures.draw_servo_sweep(figure, table), 2.6)
    if swept == "sigma":
        return figures.picture(lambda figure: figures.draw_sigma_sweep(figure, table))
    if swept == "setting":
        return figures.picture(lambda figure: figures.draw_settings(figure, table), 2.6)
    return figures.picture(lambda figure: figures.draw_runs(figure, table, curves, _RATE))


def _missing(folder: Path, name: str, question: _Question, chosen: Sequence[str], runs: Runs) -> list[str]:
    """A remark on the runs of a question that are not there or not evaluated, and the command for them."""
    absent = [wanted for wanted in question.runs if not any(fnmatch(run, wanted) for run in chosen)]
    if not absent:
        return []
    trained = all(any(fnmatch(run, wanted) for run in runs) for wanted in absent)
    remedy = f"{command(folder, 'evaluate')} tests them" if trained else f"train them into {folder} first"
    return [f"ablation {name}, missing: {', '.join(absent)}; {remedy}"]


def _markdown(found: Mapping[str, pd.DataFrame]) -> str:
    text = []
    for name, table in found.items():
        swept = _QUESTIONS[name].swept
        further = [*([swept] if swept else []), "control_steps_per_decision", _DISPLACEMENT, _TRAINING_DISPLACEMENT]
        cells = [
            [row["run"], str(row["seeds"]), tables.success_text(row), *(_cell(column, row[column]) for column in further)]
            for row in tables.records(table)
        ]
        headings = ("Run", "Seeds", "Success (95 % interval)", *(_HEADINGS[column] for column in further))
        text.append(f"## {_QUESTIONS[name].title}\n\n{tables.markdown(headings, cells)}\n![{name}]({name}.png)\n")
    return "\n".join(text)


def _cell(column: str, value: float | str) -> str:
    if isinstance(value, str):
        return value
    if math.isnan(value):
        return "-"
    return f"{1000.0 * value:.1f}" if column.endswith("displacement_m") else f"{value:.3g}"
