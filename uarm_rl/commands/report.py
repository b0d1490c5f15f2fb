"""Rebuild all tables and figures from the CSV files in results/, and a page of them all.

report.html in the results folder is one file that needs no network: tables that sort, figures, recorded tests in 3-D (extra
`view`), trials of the arm, and where every number comes from.

Examples:
  uarm-rl report                                      tables and pictures in results/ and results/ablations/
  uarm-rl report results_dir=demo                     the same for another folder of runs
  uarm-rl evaluate && uarm-rl report                  test what is new, then report
"""

from __future__ import annotations

from pathlib import Path

from uarm_rl import checks
from uarm_rl.configuration import Settings, compose
from uarm_rl.report.report import PAGE, report


def run(settings: Settings) -> None:
    """Rebuild table and figures."""
    folder = output(settings)
    print(report(folder, compose("train", ("sim=pybullet",))))
    print(f"open {folder / PAGE} in a browser: all of it on one page")


def output(settings: Settings) -> Path:
    """The folder of the runs, which takes the tables and figures."""
    return checks.path("results_dir", settings["results_dir"])
