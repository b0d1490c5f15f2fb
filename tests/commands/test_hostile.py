"""The small form of ``tests.hostile``: one hostile case in forty, and a few of each control."""

from __future__ import annotations

import csv
from collections import Counter

from tests import hostile


def test_a_sample_of_hostile_input_runs_nothing_and_writes_nowhere(tmp_path, capsys):
    code = hostile.main(["--every", "40", "--controls", "20", "--out", str(tmp_path / "table.csv")])
    printed = capsys.readouterr().out
    with open(tmp_path / "table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["failures"]) for row in rows] == [0, 0], printed
    assert "NOT CAUGHT" not in printed
    assert code == 0


def test_there_are_as_many_cases_as_promised_and_none_twice():
    for cases, promised in ((list(hostile.files()), 200), (list(hostile.configurations()), 100)):
        assert len(cases) >= promised
        assert max(Counter((case.group, case.what) for case in cases).values()) == 1
