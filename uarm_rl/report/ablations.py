"""Why it works: the shorter runs of results/ablations, one figure and one table for each question."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import pandas as pd

from uarm_rl.checks import command
from uarm_rl.report import figures, statistics, tables
from uarm_rl.report.records import (
    DISTURBANCE,
    PROGRESS,
    Runs,
    check_engines,
    find_runs,
    read_config,
    read_evaluations,
    read_seeds,
)
from uarm_rl.report.tables import Document, Heading, Picture, Section, Shown, Table
from uarm_rl.studies import Point, Sweep, belongs, point, studies

ABLATIONS: Final = "ablations"  # below the results folder


class Question(NamedTuple):
    """``studies`` are those that answer it, in the order of the table.

    ``swept`` is the column that a sweep varies; its table and figure go by it. ``timed``: simulated time is a price too:
    the table tells what each run and that of the first of ``studies`` had reached in the time of the shorter.
    ``beside`` are further studies, shown first for comparison, which alone answer nothing.
    """

    title: str
    studies: tuple[str, ...]
    swept: str | None = None
    timed: bool = False
    beside: tuple[str, ...] = ()

    @property
    def shown(self) -> tuple[str, ...]:
        """All of its studies, in the order of the table."""
        return (*self.beside, *self.studies)


#: What is asked, and the studies that answer it.
QUESTIONS: Final = {
    "halves": Question(
        "Waiting until steady, or leaving out stuck transitions: which half of the adaptive buffer does it?", ("halves",)
    ),
    "fixed_hold": Question("Is it the adaptivity, or just a longer hold?", ("fixed_hold",)),
    "servo": Question(
        "From which response time of the servo on does waiting win?",
        ("reference", "instant", "servo", "long_servo"),
        "servo_rise_s",
    ),
    "sigma": Question("How hard must moving the object be punished, and what does it cost?", ("sigma",), "sigma"),
    "observability": Question(
        "How much of what the uniform buffer lacks is what it cannot see?",
        ("observability", "observability_long"),
        "setting",
        beside=("fixed_hold",),
    ),
    "actions": Question("Is it what the actions are relative to?", ("actions",), "setting", beside=("reference",)),
    "horizon": Question("Is it how far a discount looks ahead?", ("semi_markov",), "setting", beside=("fixed_hold", "gamma")),
    "n_step": Question("Is it how slowly credit comes back?", ("n_step",), "setting", beside=("reference",)),
    "tuning": Question("Is uniform badly tuned for its cycle time?", ("tuning",), "setting", beside=("reference",)),
    "every_step": Question("Does storing the moving states too do harm?", ("every_step",), beside=("reference",)),
    "prioritized": Question("Does sampling by priority do the same?", ("prioritized",), "setting", beside=("reference",)),
    "learners": Question(
        "Is it DDPG's alone, or do other learners gain as much?",
        ("learners", "hindsight"),
        "setting",
        beside=("reference", "halves"),
    ),
    "duration": Question(
        "Would the agent find the waiting by itself?", ("learned_duration",), timed=True, beside=("fixed_hold",)
    ),
    "duration_by_time": Question(
        "And with a discount by time?",
        ("learned_duration_by_time",),
        "setting",
        timed=True,
        beside=("fixed_hold", "semi_markov"),
    ),
    "constants": Question(
        "Does what was found hang on the constants that were chosen?",
        ("reference", "gamma", "tolerance", "dwell", "damping", "beta", "threshold"),
        "setting",
    ),
}

#: The questions whose answer is a choice, made on validation positions, and the file that it is made from.
_CHOICES: Final = {"constants": "choice", "observability": "choice-observability", "tuning": "choice-tuning"}

_HEADINGS: Final = {
    "setting": "Changed",
    "servo_rise_s": "Servo rise (s)",
    "sigma": "Sigma (1/m)",
    "equal_time_success": "Validation success in equal simulated time",
    "equal_time_learned": "and that of the learned duration",
    "control_steps_per_decision": "Control steps a decision",
    "object_displacement_m": "Object moved (mm)",
    "training_displacement_m": "Moved while learning (mm per object)",
}
_UNITS: Final = {"m": (1000.0, " mm"), "s": (1.0, " s"), "rad": (1.0, " rad")}
_DISPLACEMENT: Final = "object_displacement_m"
_TRAINING_DISPLACEMENT: Final = "training_displacement_m"
_IN_EQUAL_TIME: Final = ("equal_time_success", "equal_time_learned")
_BOTH: Final = ("adaptive", "uniform")
_LAST_VALIDATIONS: Final = 3  # their mean is the end of a run: one validation has 50 positions


def ablations(results_dir: Path, usual: Mapping[str, Any]) -> Section:
    """ablations.csv and .md, learning_curves.csv and a picture for each question, all in ``results_dir/ablations``.

    ``usual`` is the configuration that a study changes in the settings that it varies.
    """
    folder = results_dir / ABLATIONS
    if not folder.is_dir():
        return Section()
    runs, points = _told_apart(find_runs(folder), usual)
    evaluations = read_evaluations(runs)
    if runs:
        check_engines({str(folder): pd.concat(evaluations.values())})
    columns = {**PROGRESS, **DISTURBANCE}
    progress = {name: read_seeds(folders, "progress.csv", columns) for name, folders in runs.items()}
    curves = {run: tables.curve(rows) for run, rows in progress.items()}
    section = Section()
    found: dict[str, pd.DataFrame] = {}
    trained: set[str] = set()
    tested: set[str] = set()
    for name, question in QUESTIONS.items():
        members = _members(question, points, point(usual))
        chosen = {run: study for run, study in members.items() if len(evaluations[run])}
        trained |= members.keys()
        tested |= chosen.keys()
        if set(chosen.values()) & set(question.studies):
            shortest = min(progress[run]["episode"].max() for run in chosen)
            rows = [_row(run, points[run]["buffer"], evaluations[run], progress[run], shortest) for run in chosen]
            table = pd.DataFrame(rows)
            if question.swept == "setting":
                table["setting"] = [_setting(study, points[run]) for run, study in chosen.items()]
            elif question.swept:
                table = table.sort_values([question.swept, "buffer"], ascending=question.swept != "sigma", kind="stable")
            if question.timed:
                own = next(run for run in table["run"] if chosen[run] in question.studies)
                table[[*_IN_EQUAL_TIME]] = [_in_equal_time(curves[run], curves[own]) for run in table["run"]]
            found[name] = table
            section.contents[f"{ABLATIONS}/{name}.png"] = _picture(question, found[name], curves)
    if found:
        stacked = pd.concat([table.assign(question=name) for name, table in found.items()])
        section.contents[f"{ABLATIONS}/ablations.csv"] = tables.csv(stacked[["question", *stacked.columns.drop("question")]])
        section.contents[f"{ABLATIONS}/ablations.md"] = _document(found)
        learning = pd.concat(curve.assign(run=run) for run, curve in curves.items())
        section.contents[f"{ABLATIONS}/learning_curves.csv"] = tables.csv(learning[["run", *learning.columns.drop("run")]])
    for name, file in _CHOICES.items():
        if name in found and len(choice := _choice(found[name], progress)):
            section.contents[f"{ABLATIONS}/{file}.csv"] = tables.csv(choice)
            section.contents[f"{ABLATIONS}/{file}.md"] = _choice_document(choice)
    section.remarks += _missing(folder, [points[run] for run in trained], [points[run] for run in tested])
    return section


def _told_apart(folders: Runs, usual: Mapping[str, Any]) -> tuple[dict[str, Sequence[Path]], dict[str, Point]]:
    """The runs by the names in their configurations, and what tells them apart; folders may have been renamed."""
    settings = {folder: read_config(seeds[0]) for folder, seeds in folders.items()}
    names = {folder: str(one.get("name")) for folder, one in settings.items()}
    plain = len(set(names.values())) == len(names) and all(re.fullmatch(r"\w[\w.,+ -]*", name) for name in names.values())
    called = {names[folder] if plain else folder: folder for folder in folders}
    return (
        {name: folders[called[name]] for name in sorted(called)},
        {name: point(settings[folder], usual) for name, folder in called.items()},
    )


def _members(question: Question, points: Mapping[str, Point], usual: Point) -> dict[str, str]:
    """The runs of a question in the order of its table, each with the first study that it belongs to."""
    found: dict[str, str] = {}
    for study in question.shown:
        sweep = studies()[study]
        runs = [run for run, one in points.items() if "buffer" in one and belongs(one, sweep, usual)]
        for run in sorted(runs, key=lambda run: [_rank(points[run].get(key), sweep[key]) for key in sweep]):
            found.setdefault(run, study)
    return found


def _rank(value: float | str | None, values: Sequence[Any]) -> float:
    """A number goes by its size, a choice by its place in the study."""
    return values.index(value) if isinstance(value, str) else -math.inf if value is None else value


def _setting(study: str, run: Point) -> str:
    """What a run's study changed but the buffer, with its unit: ``dwell 0.25 s``, ``observation velocity``."""
    varied = [key for key in studies()[study] if key != "buffer" and key in run]
    words = []
    for key in varied:
        factor, unit = _UNITS.get(key.rpartition("_")[2], (1.0, ""))
        name = study if len(varied) == 1 and not isinstance(run[key], str) else key.rpartition(".")[2]
        words.append(f"{name} {run[key] if isinstance(run[key], str) else f'{factor * run[key]:g}{unit}'}")
    label = ", ".join(words).replace("_", " ") or "default"
    return f"{label}, long" if study.endswith("_long") else label


def _row(run: str, buffer: str, evaluation: pd.DataFrame, progress: pd.DataFrame, shortest: float) -> dict[str, Any]:
    """What is known of one name's runs: success, what the object suffered, and under which conditions.

    Runs of more episodes than the ``shortest`` of the table are told as such.
    """
    moved = tables.outcomes(evaluation, _DISPLACEMENT)
    low, high = statistics.bootstrap_interval([moved], [1.0], tables.generator(), resamples=tables.resamples(evaluation))
    last, sums = progress.groupby("seed").last(), progress.groupby("seed")[[*DISTURBANCE]].sum()
    episodes = last["episode"].max()
    objects = last["episode"] + sums["successes"] + sums["object_losses"]
    return {
        "run": run,
        "buffer": f"{buffer}, {episodes:g} episodes" if episodes > shortest else buffer,
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


def _in_equal_time(*curves: pd.DataFrame) -> list[float]:
    """The validation success of both when as much time is simulated as the shorter has in all; NaN if none was yet."""
    shorter = min(curve["control_steps"].max() for curve in curves)
    return [curve.loc[curve["control_steps"] <= shorter, f"{tables.RATE}_mean"].tail(1).mean() for curve in curves]


def _choice(constants: pd.DataFrame, progress: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """How well both methods end on the validation positions with each constant, the only ones a choice may look at.

    ``score`` is the mean of the two methods, and ``standard_error`` its spread over the seeds that both have.
    """
    names = zip(constants["run"], constants["setting"], constants["buffer"], strict=True)
    ends = [_end(progress[run]).assign(setting=setting, buffer=buffer) for run, setting, buffer in names]
    rates = pd.concat(ends).pivot_table(index=["setting", "seed"], columns="buffer", values=tables.RATE, sort=False)
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
    last = progress.dropna(subset=[tables.RATE]).groupby("seed").tail(_LAST_VALIDATIONS)
    end: pd.DataFrame = last.groupby("seed", as_index=False)[[tables.RATE]].mean()
    return end


def _choice_document(choice: pd.DataFrame) -> Document:
    rates = [*_BOTH, "score", "standard_error"]
    cells = [
        [row["setting"], str(row["seeds"]), *(tables.percent(row[rate]) for rate in rates)] for row in tables.records(choice)
    ]
    headings = ("Changed", "Seeds", "Adaptive", "Uniform", "Score", "Standard error")
    words = (
        f"Success on the validation positions, mean of the last {_LAST_VALIDATIONS} validations of each run. "
        "The score is the mean of both methods; its standard error is over seeds."
    )
    return Document(Table(headings, cells, title="Both methods with each setting, on the validation positions"), words)


def _picture(question: Question, table: pd.DataFrame, curves: Mapping[str, pd.DataFrame]) -> Picture:
    swept, words = question.swept, question.title
    if swept == "servo_rise_s":
        return figures.picture(lambda figure: figures.draw_servo_sweep(figure, table), words, 2.6)
    if swept == "sigma":
        return figures.picture(lambda figure: figures.draw_sigma_sweep(figure, table), words)
    if swept == "setting":
        return figures.picture(lambda figure: figures.draw_settings(figure, table), words, 2.6)
    return figures.picture(lambda figure: figures.draw_runs(figure, table, curves, tables.RATE, timed=question.timed), words)


def _missing(folder: Path, trained: Sequence[Point], tested: Sequence[Point]) -> list[str]:
    """A remark on the runs of the studies that are not there or not evaluated, and the command for them."""
    asked = dict.fromkeys(study for question in QUESTIONS.values() for study in question.shown)
    lacking = {study: count for study in asked if (count := _absent(studies()[study], tested))}
    if not lacking:
        return []
    untrained = [study for study in lacking if _absent(studies()[study], trained)]
    words = f"train -m resume=true experiment={','.join(untrained)}" if untrained else "evaluate"
    runs = ", ".join(f"{count} of {study}" for study, count in lacking.items())
    return [f"ablations, missing runs: {runs}; {command(folder, words)} makes up for it"]


def _absent(sweep: Sweep, runs: Sequence[Point]) -> int:
    """How many of a study's points no run has."""
    wanted = (dict(zip(sweep, values, strict=True)) for values in product(*sweep.values()))
    return sum(not any(one.items() <= run.items() for run in runs) for one in wanted)


def _document(found: Mapping[str, pd.DataFrame]) -> Document:
    parts: list[Heading | Table | Shown] = []
    for name, table in found.items():
        swept = QUESTIONS[name].swept
        in_time = _IN_EQUAL_TIME if QUESTIONS[name].timed else ()
        further = [*([swept] if swept else []), *in_time, "control_steps_per_decision", _DISPLACEMENT, _TRAINING_DISPLACEMENT]
        cells = [
            [row["run"], str(row["seeds"]), tables.success_text(row), *(_cell(column, row[column]) for column in further)]
            for row in tables.records(table)
        ]
        headings = ("Run", "Seeds", "Success (95 % interval)", *(_HEADINGS[column] for column in further))
        parts += [Heading(QUESTIONS[name].title), Table(headings, cells), Shown(f"{name}.png")]
    return Document(*parts)


def _cell(column: str, value: float | str) -> str:
    if isinstance(value, str):
        return value
    if math.isnan(value):
        return "-"
    if column in _IN_EQUAL_TIME:
        return tables.percent(value)
    return f"{1000.0 * value:.1f}" if column.endswith("displacement_m") else f"{value:.3g}"
