"""The small form of ``tests.hostile``: one case in a hundred, and one of each control. And values, which need no process."""

from __future__ import annotations

import copy
import math
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest
import yaml

from tests.conftest import needs_pybullet
from tests.hostile import files, play, words
from uarm_rl import checks, cli, configuration, trained
from uarm_rl.checks import UsageError
from uarm_rl.commands import COMMANDS


def test_a_sample_of_hostile_input_runs_nothing_and_writes_nowhere():
    for row, cases, failed, control in play.rows(every_nth=97, control_nth=40):
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
                read = trained.read_run(tmp_path)
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


#: Of every kind a configuration has; what is not among a key's own kind is refused before anything is opened or made.
KINDS = {
    bool: (True,),
    float: (1.5, 1e308),
    str: ("abc", "1.5"),
    list: ([1.5], [["abc"]]),
    dict: ({"a": 1},),
    type(None): (None,),
}


def kind(value: object) -> type:
    return float if type(value) is int else type(value)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_setting_of_every_command_refuses_another_kind_by_name(command):
    groups = {name: choices for name, choices in configuration.groups_of(command).items() if name != "experiment"}
    if command in ("submit", "sweep"):  # which have the groups of train
        groups = {}
    composed = [configuration.compose(command, incomplete=True)]
    composed += [configuration.compose(command, (f"{name}={one}",), incomplete=True) for name in groups for one in groups[name]]
    for settings in composed:
        for name, usual in every_setting(settings, ""):
            if usual in (None, "???", [], {}):
                continue
            for wrong in [value for of, values in KINDS.items() if of is not kind(usual) for value in values]:
                changed = copy.deepcopy(settings)
                inner = changed
                *path, last = name.split(".")
                for part in path:
                    inner = inner[part]
                inner[last] = wrong
                with pytest.raises(ValueError, match=re.escape(name)):
                    checks.like("", changed, settings)


def every_setting(settings: dict[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    """Settings and groups by their dotted names."""
    for key, value in settings.items():
        yield f"{prefix}{key}", value
        if isinstance(value, dict):
            yield from every_setting(value, f"{prefix}{key}.")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("train", "agent.hidden=64"), "agent.hidden must be a list, as in agent.hidden=[400,300], got 64"),
        (("train", "agent.hidden=[]"), "agent.hidden must be a list, as in agent.hidden=[400,300], got []"),
        (("train", "agent.hidden=[64,abc]"), "each of agent.hidden must be a whole number, got 'abc'"),
        (("train", "time_limit_s=null"), "time_limit_s must be a number, got None"),
        (("train", "servo=5"), "there is no servo=5; servo is one of instant, second_order, stepper, torque"),
        (("train", "sim.name=box"), "sim.name must be one of pybullet, mujoco, got 'box'"),
        (("doctor", "calibration=3"), "calibration must be a text, got 3"),
        (("doctor", "--calibration"), "calibration must be a text, got True; is its value missing behind it?"),
        (("doctor", "policy=null"), "policy must be a text, got None"),
        pytest.param(
            ("emulate", "colour=red"), "colour must be a list, as in colour=[217,38,26], got 'red'", marks=needs_pybullet
        ),
        (("run-real", "resume=7", "dry_run=true"), "resume must be true or false, got 7"),
        (("report", "results_dir=[1]"), "results_dir must be a text, got [1]"),
    ],
)
def test_what_is_refused_is_told_in_one_sentence_and_leaves_nothing(words, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    assert (end.value.code, capsys.readouterr().err) == (2, f"error: {sentence}\n")
    assert list(tmp_path.iterdir()) == []
