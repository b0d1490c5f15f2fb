"""The committed results: the report is rebuilt from the runs to the last byte, and the texts quote its tables."""

from __future__ import annotations

import csv
import re
import shutil
from pathlib import Path

import pytest

from uarm_rl.configuration import compose
from uarm_rl.report.report import report
from uarm_rl.report.tables import percent

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
REPORTS = [RESULTS, RESULTS / "beta0.3"]


def written(results: Path) -> dict[str, bytes]:
    """The tables that a report has written below ``results``; pictures depend on the fonts that are installed."""
    tables = (path for pattern in ("*", "ablations/*") for path in results.glob(pattern) if path.suffix in (".csv", ".md"))
    return {str(path.relative_to(results)): path.read_bytes() for path in tables}


@pytest.mark.parametrize("results", REPORTS, ids=lambda folder: folder.name)
def test_the_report_is_rebuilt_from_the_committed_runs(results, tmp_path):
    rebuilt = tmp_path / "results"
    committed = written(results)
    made = [name for name in committed if name != "paper.csv"]
    shutil.copytree(results, rebuilt, ignore=shutil.ignore_patterns("*.safetensors", "*.png", "checkpoint-*"))
    for name in made:
        (rebuilt / name).unlink()
    report(rebuilt, compose("train"))
    assert {"table1.csv", "table1.md"} <= set(made)
    assert written(rebuilt) == committed


def tables(text: str) -> list[str]:
    """The Markdown tables in a text."""
    return re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)


def test_the_texts_quote_the_tables_as_they_are():
    folders = [*REPORTS, RESULTS / "ablations"]
    made = {table for folder in folders for path in folder.glob("*.md") for table in tables(path.read_text())}
    quoted = tables((ROOT / "RESULTS.md").read_text()) + tables((ROOT / "docs" / "beta.md").read_text())
    first, fitted = ((RESULTS / f"{name}.md").read_text().split("\n\n")[0] + "\n" for name in ("table1", "paper_fit"))
    assert first in quoted
    assert tables((ROOT / "README.md").read_text())[0] == fitted
    assert [table for table in quoted if table not in made] == []


def test_the_readme_says_which_tolerance_was_fitted_and_what_it_predicts():
    with open(RESULTS / "paper_fit.csv", encoding="utf-8", newline="") as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    readme = " ".join((ROOT / "README.md").read_text().split())
    assert f"with {1000 * float(rows['A']['tolerance_m']):.1f} mm in that place its table and ours agree" in readme
    for method in "ACD":  # which is what agreeing means, B being fitted
        assert float(rows[method]["ci_low"]) <= float(rows[method]["paper_success_rate"]) <= float(rows[method]["ci_high"])


def test_the_readme_says_what_the_second_engine_showed():
    with open(RESULTS / "engines.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    readme = " ".join((ROOT / "README.md").read_text().split())
    everywhere = [
        row["method"] for row in rows if float(row["pybullet_success_rate"]) == float(row["mujoco_success_rate"]) == 1
    ]
    assert f"{', '.join(everywhere[:-1])} and {everywhere[-1]} reach every position in both" in readme
    c, d = (percent(float(row["mujoco_success_rate"])) for row in rows if row["trained_in"] == "mujoco")
    assert f"trained there C reaches {c} and D {d} after 300 episodes" in readme
