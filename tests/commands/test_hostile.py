"""The small form of ``tests.hostile``: one case in fifty, and one of each control. And values, which need no process."""

from __future__ import annotations

import math
from collections import Counter
from contextlib import closing

import numpy as np
import yaml

from tests.hostile import files, play, words
from uarm_rl import configuration
from uarm_rl.checks import UsageError


def test_a_sample_of_hostile_input_runs_nothing_and_writes_nowhere():
    for row, cases, failed, control in play.rows(every_nth=53, control_nth=40):
        assert failed == [], row
        assert cases >= 3
        assert "seen" in control
        assert "NOT CAUGHT" not in control


def test_every_kind_of_attack_is_there_and_no_case_twice():
    cases = [*files.cases(), *words.cases()]
    assert max(Counter((case.group, case.what) for case in cases).values()) == 1
    attacked = {group for control in play.CONTROLS.values() for group in control.groups}
    assert attacked <= {case.group for case in cases}


VALUES = (None, True, "os.system", [], {"a": 1}, 0, -1, 1e308, 1e-320, 10**400, math.nan, math.inf)


def test_a_hostile_value_in_a_run_is_refused_or_does_no_harm(tmp_path):
    """Of all that an environment is built from; most of it is refused, and what is taken gives finite numbers."""
    settings = configuration.compose("train", ("time_limit_s=0.1",))
    numbers = {"control_hz", "max_delta_rad", "tolerance_m", "dwell_s", "time_limit_s"}
    used = [(settings, key) for key in (*numbers, "buffer")]
    for group in (settings["sim"], settings["servo"], settings["reward"], settings["buffer"]["hold"]):
        used += [(group, key) for key in group if key != "gui"]
    refused = harmless = 0
    for place, key in used:
        kept = place[key]
        for value in VALUES:
            place[key] = value
            (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
            try:
                read = configuration.read_run(tmp_path)
                env = configuration.build_env(read, time_limit_s=read["time_limit_s"])
            except (ValueError, UsageError):
                refused += 1
                continue
            with closing(env):
                env.reset(seed=0)
                observation, reward, *_ = env.step(np.zeros(3, np.float32))
                assert np.isfinite([*observation, reward]).all(), f"{key}={value!r}"
            harmless += 1
        place[key] = kept
    assert refused > 8 * harmless > 0
