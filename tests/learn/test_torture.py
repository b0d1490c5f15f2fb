"""The small form of ``make torture``: a few kills. What it does to files is tested with the checkpoints and policies."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path


def test_runs_that_are_killed_end_as_if_they_were_not(tmp_path):
    options = ["--only", "kills", "--trials", "3", "--controls", "0", "--out", str(tmp_path / "table.csv")]
    command = [sys.executable, "-m", "tests.torture", *options]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with open(tmp_path / "table.csv", newline="") as file:
        assert [(row["trials"], row["failures"]) for row in csv.DictReader(file)] == [(trials, "0") for trials in "2111"]
