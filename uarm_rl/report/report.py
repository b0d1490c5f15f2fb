"""The whole report, from the CSV files of the runs and nothing else: each section is a module of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from uarm_rl import files, progress
from uarm_rl.checks import UsageError, command
from uarm_rl.files import CONFIG
from uarm_rl.report import tables
from uarm_rl.report.ablations import ABLATIONS, ablations
from uarm_rl.report.arm_trials import arm_trials
from uarm_rl.report.beyond import BEYOND, obstacles, torques
from uarm_rl.report.comparisons import comparisons
from uarm_rl.report.engines import engines
from uarm_rl.report.leaning import leaning
from uarm_rl.report.learning import learning, rewards, shaking
from uarm_rl.report.page import page
from uarm_rl.report.paper_fit import paper_fit
from uarm_rl.report.provenance import provenance
from uarm_rl.report.records import PROGRESS, ReportError, find_runs, in_engines, methods, read_evaluations, read_seeds
from uarm_rl.report.replays import replays
from uarm_rl.report.robustness import held_out, holds, tolerance
from uarm_rl.report.sample_efficiency import budgets
from uarm_rl.report.table1 import table1
from uarm_rl.report.tables import Section

#: The report in one file for readers, below the results folder.
PAGE: Final = "report.html"


def report(results_dir: Path, usual: Mapping[str, Any]) -> str:
    """Rebuild tables, pictures and ``report.html`` in ``results_dir`` from the CSV files below it; returns Table 1 to print.

    Reads ``<name>/seed<k>/progress.csv``, ``evaluation.csv`` and the other evaluations there, ``paper.csv`` (if absent,
    the packaged one), and the runs in ``ablations/`` and ``beyond/``. Tables and pictures show every run that is there. Raises
    :class:`UsageError` if the folder holds no run, and :class:`ReportError`, with nothing written, if a file of one cannot be
    used. ``usual`` is the configuration that the studies
    in ``ablations/`` change.
    """
    if (results_dir / CONFIG).exists():
        raise UsageError(f"{results_dir} is a run; did you mean results_dir={results_dir.parent.parent}, where all runs are?")
    found = find_runs(results_dir)
    if not found and not any((results_dir / folder).is_dir() for folder in (ABLATIONS, BEYOND)):
        raise UsageError(f"{results_dir} holds no run; make one with {command(results_dir, 'train')}")
    shown = methods(found)
    runs = {method.folder: found.get(method.folder, []) for method in shown}
    evaluations = read_evaluations(runs)
    shown = in_engines(shown, runs, evaluations)
    logs = {folder: read_seeds(seeds, "progress.csv", PROGRESS) for folder, seeds in runs.items()}

    made: dict[str, Callable[[], Section]] = {
        "Table 1: success beside the paper's": lambda: table1(results_dir, shown, runs, evaluations),
        "The paper's table at a fitted tolerance": lambda: paper_fit(results_dir, shown, runs, evaluations),
        "Reward on each test position": lambda: rewards(shown, evaluations),
        "Learning": lambda: learning(shown, logs),
        "Waiting and shaking": lambda: shaking(results_dir, shown, runs),
        "Which differences can be shown": lambda: comparisons(evaluations),
        "What success cost": lambda: budgets(shown, logs, evaluations),
        "Other tolerances": lambda: tolerance(results_dir, shown, runs, evaluations),
        "Held-out positions": lambda: held_out(results_dir, shown, runs, evaluations),
        "Other holds": lambda: holds(results_dir, shown, runs, evaluations),
        "Leaning on the object": lambda: leaning(results_dir, shown, runs, evaluations),
        "Two engines": lambda: engines(results_dir, methods(found), runs, evaluations),
        "Past obstacles": lambda: obstacles(results_dir),
        "Told torques": lambda: torques(results_dir),
        "Why it works: shorter runs": lambda: ablations(results_dir, usual),
        "Replays": lambda: replays(results_dir, shown, runs, evaluations),
        "Trials of the arm": lambda: arm_trials(results_dir),
        "Where the numbers come from": lambda: provenance(results_dir),
    }
    each = ((title, make()) for title, make in made.items())  # inside `shown`, which ends what it shows before an error is told
    sections = dict(progress.shown(each, len(made), "section", "report"))
    names = _write(results_dir, sections)
    texts = [section.text for section in sections.values() if section.text]
    remarks = [remark for section in sections.values() for remark in section.remarks]
    wrote = [f"wrote {tables.shown(results_dir / name)}" for name in names]
    return "\n".join([*texts, "", *remarks, *wrote])


def _write(results_dir: Path, sections: Mapping[str, Section]) -> list[str]:
    """Replace the files, each atomically, the page last; their names."""
    contents = {name: content for section in sections.values() for name, content in section.files().items()}
    contents[PAGE] = page(sections)
    try:
        for name, content in contents.items():
            files.replace(results_dir / name, content)
    except OSError as error:
        raise ReportError(f"{results_dir} cannot take the report ({error.strerror}); make it writable") from error
    return [*contents]
