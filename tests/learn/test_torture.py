"""The small form of ``make torture``: a few kills, every failing call of a save, every bit of the files."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path


def test_the_small_torture_finds_nothing(tmp_path):
    options = ["--trials", "6", "--controls", "0", "--no-hostile", "--out", str(tmp_path / "table.csv")]
    command = [sys.executable, "-m", "tests.torture", *options]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with open(tmp_path / "table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["failures"]) for row in rows] == [0] * 8
    assert [int(row["trials"]) for row in rows][:4] == [4, 2, 2, 2]
    assert all(int(row["trials"]) > 40 for row in rows[4:])
