"""Recorded episodes: the viewer's page once, a recording each, the same bytes in every process."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("viser")

PROGRAM = """
import hashlib
import numpy as np
from uarm_rl.view.replay import Episode, record

def episode(title, steps):
    way = np.linspace(0.2, 0.25, steps)[:, np.newaxis] * [1.0, 0.3, 0.2]
    return Episode(title, (0, 90, 180), way, way, way)

made = record([[episode("A", 4), episode("B", 2)], [episode("<b>C", 3)]], step_s=0.05)
print(hashlib.sha256("".join(made.recordings).encode()).hexdigest())
print(len(made.recordings), "</html>" in made.after, "</script>" in made.after, any("<" in one for one in made.recordings))
"""


def test_every_process_records_the_same_and_says_nothing_else():
    said = set()
    for seed in ("1", "2"):
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        )
        said.add((done.stdout.partition("\n")[2], done.stdout, done.stderr))
    assert len(said) == 1
    (rest, _, errors), *_ = said
    assert (rest, errors) == ("2 True True False\n", "")
