"""Which engine simulates: what `sim=auto` takes, what is said of it, and what is refused, as a user sees it."""

from __future__ import annotations

import csv
import subprocess
import sys

import pytest
import yaml

from tests.conftest import FAST, needs_mujoco, needs_pybullet, uarm_rl
from uarm_rl import configuration

NOTE = "note: PyBullet is not installed, so sim=auto takes MuJoCo; "


def error(done: subprocess.CompletedProcess[str]) -> str:
    """The one sentence that a command failed with."""
    assert done.returncode != 0
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error: "))
    assert "Traceback" not in done.stderr
    return line


@needs_pybullet
def test_auto_is_pybullet_where_it_is_installed_to_the_last_byte():
    composed = (configuration.compose("train", overrides) for overrides in ((), ("sim=auto",), ("sim=pybullet",)))
    assert len({yaml.safe_dump(settings, sort_keys=False) for settings in composed}) == 1


@needs_mujoco
def test_without_pybullet_auto_trains_in_mujoco_says_so_once_and_records_it(tmp_path, without):
    words = ("train", *FAST, "results_dir=r", "-m", "seed=0,1")
    done = uarm_rl(*words, cwd=tmp_path, environment=without("pybullet"))
    assert done.returncode == 0, done.stderr
    assert [line.startswith(NOTE) for line in done.stderr.splitlines() if line.startswith("note: ")] == [True]
    recorded = yaml.safe_load((tmp_path / "r" / "adaptive-penalty" / "seed1" / "config.yaml").read_text())
    assert recorded["sim"] == configuration.compose("train", ("sim=mujoco",))["sim"]
    again = uarm_rl("train", *FAST, "results_dir=r", "sim=pybullet", "resume=true", cwd=tmp_path)
    assert "was begun with sim=mujoco, not pybullet; resume it as it was begun" in error(again)


@needs_mujoco
def test_without_pybullet_an_evaluation_says_its_engine(tmp_path, without):
    (tmp_path / "where.csv").write_text("x_m,y_m,z_m\n0.2,0,0.03\n")
    words = ("evaluate", "policy=ik", "positions=where.csv", "out=where-ik.csv", "results_dir=r")
    done = uarm_rl(*words, cwd=tmp_path, environment=without("pybullet"))
    assert NOTE in done.stderr
    with open(tmp_path / "r" / "ik" / "seed0" / "where-ik.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["success"], row["engine"]) == ("1", "mujoco")


@needs_mujoco
def test_without_pybullet_the_environment_is_mujocos_with_its_overrides(without):
    code = (
        "import gymnasium, uarm_rl\n"
        "for env in (gymnasium.make('uarm_rl/UArmSuction-v0').unwrapped, uarm_rl.make_env('sim.friction=0.5')):\n"
        "    env.reset(seed=0); print(type(env.arm).__name__); env.close()"
    )
    environment = without("pybullet")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == ["MujocoArm", "MujocoArm"]
    assert done.stderr.count(NOTE) == 1


@pytest.mark.parametrize(
    ("package", "remedy"),
    [
        ("pybullet", "elsewhere sim=mujoco trains, evaluates and renders"),
        ("mujoco", "pip install -c constraints.txt -e '.[mujoco]'"),
    ],
)
def test_an_engine_that_is_not_installed_is_named_with_the_way_out(tmp_path, without, package, remedy):
    done = uarm_rl("train", *FAST, f"sim={package}", cwd=tmp_path, environment=without(package))
    sentence = error(done)
    assert sentence.startswith(f"error: {package} is not installed")
    assert remedy in sentence
    assert NOTE not in done.stderr
    assert list(tmp_path.glob("results/*")) == []
