"""The Tab key, asked as a shell asks."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import uarm_rl
from uarm_rl.commands.completion import candidates


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "results" / "mine" / "seed0").mkdir(parents=True)
    (tmp_path / "resume.txt").touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("uarm-rl tr", ["train"]),
        ("uarm-rl --v", ["--version"]),
        ("uarm-rl train buffer=ad", ["buffer=adaptive"]),
        ("uarm-rl train experiment=ha", ["experiment=halves"]),
        ("uarm-rl train experiment=A,rea", ["experiment=A,real_arm"]),
        ("uarm-rl train sim=", ["sim=auto", "sim=fine", "sim=mujoco", "sim=pybullet"]),
        ("uarm-rl train sim.g", ["sim.gui="]),
        ("uarm-rl evaluate hold=un", ["hold=until_steady"]),
        ("uarm-rl evaluate bu", []),  # a group that this command does not have
        ("uarm-rl train buf", ["buffer=", "buffer."]),
        ("uarm-rl train agent.ga", ["agent.gamma=", "agent.gamma_per="]),
        ("uarm-rl train servo=stepper servo.fe", ["servo.feed="]),
        ("uarm-rl train --epi", ["--episodes"]),
        ("uarm-rl run-real --dry", ["--dry-run"]),
        ("uarm-rl train --servo st", ["stepper"]),
        ("uarm-rl train --servo=st", ["--servo=stepper"]),
        ("uarm-rl run-real --dry-run=t", ["--dry-run=true"]),
        ("uarm-rl report ", ["results_dir="]),
        ("uarm-rl jog li", ["limits=", "limits."]),
        ("uarm-rl train --mul", ["--multirun"]),
        ("uarm-rl train resume=", ["resume=true", "resume=false"]),
        ("uarm-rl train episodes=", ["episodes=1500"]),
        ("uarm-rl evaluate run=res", ["run=results/", "run=resume.txt"]),
        ("uarm-rl render run=results/mine/", ["run=results/mine/seed0/"]),
        ("uarm-rl render --run results/m", ["results/mine/"]),
        ("uarm-rl train nosuch=3 epi", ["episodes="]),
        ("uarm-rl train hyd", []),  # one run has no launcher
        ("uarm-rl train -m hyd", ["hydra/launcher=", "hydra."]),
        ("uarm-rl train -m hydra/launcher=submitit_", ["hydra/launcher=submitit_slurm", "hydra/launcher=submitit_local"]),
        ("uarm-rl train -m hydra/launcher=joblib hydra.launcher.", ["hydra.launcher.n_jobs="]),
        ("uarm-rl train -m hydra/launcher=submitit_slurm hydra.launcher.par", ["hydra.launcher.partition="]),
        ("uarm-rl train -m hydra/launcher=ray hydra.launcher.ray.", ["hydra.launcher.ray.init.", "hydra.launcher.ray.remote."]),
        (
            "uarm-rl train -m hydra/launcher=ray hydra.launcher.ray.init.",
            ["hydra.launcher.ray.init.address=", "hydra.launcher.ray.init.num_cpus="],
        ),
        ("uarm-rl train -m hydra/launcher=nosuch hydra.launcher.", []),
        ("uarm-rl nosuch ep", []),
        ("", []),
    ],
)
def test_what_a_word_may_become(folder, line, expected):
    assert sorted(candidates(line)) == sorted(expected)


def test_bash_completes(folder):
    script = """
        eval "$(uarm-rl -sc install=bash)"
        complete -p uarm-rl > /dev/null || exit 1
        for COMP_LINE in "uarm-rl train --epi" "uarm-rl evaluate run=results/m"; do
            COMP_WORDS=($COMP_LINE) COMP_CWORD=2
            hydra_bash_completion
            printf "%s\\n" "${COMPREPLY[@]}"
        done
        eval "$(uarm-rl -sc uninstall=bash)"
    """
    program = folder / "bin" / "uarm-rl"
    program.parent.mkdir()
    program.write_text(f"#!{sys.executable}\nfrom uarm_rl.cli import main\n\nmain()\n")
    program.chmod(0o755)
    environment = {"PATH": f"{program.parent}:/usr/bin:/bin"}
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.split() == ["--episodes", "run=results/mine/"], done.stderr
    assert done.stderr == ""


def test_other_questions_are_refused(tmp_path):
    done = uarm_rl("-sc", "query=tcsh", cwd=tmp_path)
    assert (done.returncode, "where SHELL is bash, fish or zsh" in done.stderr) == (2, True)
