"""Many jobs on one command line: where each writes, what is told of those that fail."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import pytest

from tests.conftest import FAST, uarm_rl
from uarm_rl import cli, configuration

SHORT = ("episodes=1", "experiences_per_episode=20", "warmup_experiences=20", "time_limit_s=0.1", "simulate_beside=false")
TINY = tuple({word.partition("=")[0]: word for word in (*FAST, *SHORT)}.values())
SWEEP = ("train", "-m", "seed=3", "agent.gamma=2,0.9", "name=gamma-${agent.gamma}", *TINY)
TOLD = [
    "failed: agent.gamma=2: agent.gamma must be a number from 0 to 1, got 2",
    "error: 1 of 2 jobs failed: agent.gamma=2",
]


@pytest.fixture
def run(tmp_path, monkeypatch, capsys) -> Callable[..., tuple[int, str]]:
    """A command in this process, which has torch already: exit code and what it said on stderr, progress aside."""
    monkeypatch.chdir(tmp_path)

    def command(*words: str) -> tuple[int, str]:
        try:
            cli.main(words)
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        return code, told(capsys.readouterr().err)

    return command


def told(stderr: str) -> str:
    """What is neither progress nor the note, once a process, of an engine that is not installed."""
    return "\n".join(line for line in stderr.splitlines() if " to go" not in line and "sim=auto takes" not in line)


def test_a_failing_job_is_told_once_and_does_not_stop_the_others(run, tmp_path):
    code, said = run(*SWEEP)
    assert (code, said.splitlines()) == (2, TOLD)
    policy = tmp_path / "results" / "gamma-0.9" / "seed3" / "policy.safetensors"
    before = policy.read_bytes()
    assert run(*SWEEP, "resume=true") == (2, "\n".join(TOLD))
    assert policy.read_bytes() == before


def test_likewise_beside_each_other(tmp_path):
    done = uarm_rl(*SWEEP, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", cwd=tmp_path, fresh=True)
    assert (done.returncode, told(done.stderr).splitlines()) == (2, TOLD)
    assert (tmp_path / "results" / "gamma-0.9" / "seed3" / "policy.safetensors").exists()


@pytest.mark.parametrize(
    ("words", "place", "example"),
    [
        (
            ("train", "agent.gamma=0.9,1"),
            "results/adaptive-penalty/seed0",
            "name=${buffer.name}-${reward.name}-gamma${agent.gamma}",
        ),
        (("train", "servo=instant,stepper"), "adaptive-penalty/seed0", "name=${buffer.name}-${reward.name}-${servo.name}"),
        (("train", "experiment=A,C", "name=x"), "results/x/seed0", "name=${buffer.name}-${reward.name}"),
        (("evaluate", "tolerance_m=0.1,0.2", "out=x.csv"), "results/*/x.csv", "out=tolerance_m${tolerance_m}.csv"),
        (("render", "run=r", "seed=0,1"), "r/episode.gif", "out=seed${seed}.gif"),
    ],
)
def test_jobs_that_would_share_a_place_are_refused_before_the_first(run, tmp_path, words, place, example):
    code, said = run(words[0], "-m", *words[1:])
    name, _, values = next(word for word in words if "," in word).partition("=")
    assert (code, said.count("error: ")) == (2, 1)
    for part in ("2 jobs would write to ", place, f"'{example}'", *(f"{name}={value}" for value in values.split(","))):
        assert part in said
    assert list(tmp_path.iterdir()) == []


def test_the_example_that_is_offered_works(run, tmp_path):
    words = (
        "train",
        "-m",
        *(word for word in TINY if "hidden" not in word),
        "agent.hidden=[4,4],[8,8]",
        "servo=instant,stepper",
    )
    _, said = run(*words)
    assert run(*words, said.split("for example with '")[1].split("'")[0]) == (0, "")
    assert len(list((tmp_path / "results").glob("*/seed0/policy.safetensors"))) == 4


def test_one_job_twice_is_done_once(run, tmp_path):
    assert run("train", "-m", "seed=0,0", *TINY) == (0, "")
    assert [path.name for path in (tmp_path / "results").glob("*/seed*")] == ["seed0"]


def test_studies_sweep_by_themselves_and_share_what_both_have(run, tmp_path):
    words = ("experiment=reference,dwell,A", "dwell_s=0.3,0.4", "seed=0")
    swept, jobs = configuration.combinations(words)
    assert swept == {"experiment", "buffer", "dwell_s"}
    assert len(jobs) == 2 * 2 + 2 * 2 + 2
    composed = [configuration.compose("train", job) for job in jobs]
    assert {(job["buffer"]["name"], job["dwell_s"]) for job in composed} == set(product(("adaptive", "uniform"), (0.3, 0.4)))
    assert run("train", "-m", "experiment=reference,halves", "buffer=uniform", *TINY) == (0, "")
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.glob("*/*/*")] == ["results/uniform-penalty/seed0"]


def test_a_setting_that_is_given_twice_is_told(run, tmp_path):
    code, said = run("train", "-m", "seed=0", "seed=1", *TINY)
    assert (code, said) == (0, "note: seed is given twice, and seed=1 counts; -m seed=0,1 is a run of each")
    assert [path.name for path in (tmp_path / "results").glob("*/seed*")] == ["seed1"]


def test_what_every_job_needs_is_checked_before_the_first(run, tmp_path):
    code, said = run("train", "-m", "seed=0,1", "agent.gama=1")
    assert (code, said.count("error: "), "did you mean agent.gamma?" in said) == (2, 1, True)
    assert list(tmp_path.iterdir()) == []


def test_the_environment_can_be_made_inside_another_hydra_application(tmp_path):
    """As in a script of somebody who uses Hydra too."""
    import hydra

    import uarm_rl as package

    (tmp_path / "theirs.yaml").write_text("seed: 3\n")
    with hydra.initialize_config_dir(str(tmp_path), version_base="1.3"):
        package.make_env("buffer=uniform").close()
        assert hydra.compose("theirs").seed == 3


def test_likewise_through_processes_of_submitit(run, tmp_path):
    words = (*SWEEP, "hydra/launcher=submitit_local", "hydra.launcher.timeout_min=10", "results_dir=there")
    assert run(*words) == (2, TOLD[1])
    assert (tmp_path / "there" / "gamma-0.9" / "seed3" / "policy.safetensors").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("hydra.launcher.n_jobs=2",), "hydra.launcher.n_jobs is for hydra/launcher=joblib, and the launcher here is basic"),
        (
            ("hydra/launcher=joblib", "hydra.launcher.partition=x"),
            "hydra.launcher.partition is for hydra/launcher=submitit_slurm, and the launcher here is joblib",
        ),
        (
            ("hydra/launcher=submitit_slurm", "hydra.launcher.partition=x y"),
            "hydra.launcher.partition must be a name, got 'x y'",
        ),
        (
            ("hydra/launcher=submitit_local", "hydra.launcher.timeout_min=0"),
            "hydra.launcher.timeout_min must be a whole number above 0, got '0'",
        ),
        (("hydra/launcher=submitit_slurm", "hydra.launcher.setup=[a]"), "hydra.launcher.setup=[a] is not for the command line"),
        (("hydra/launcher=submitit_slurm", "results_dir='a;b'"), "results_dir must be a path of letters"),
    ],
)
def test_words_for_launchers_are_few_and_checked(run, tmp_path, words, sentence):
    code, said = run("train", "-m", "seed=0,1", *TINY, *words)
    assert (code, said.split("error: ")[1].startswith(sentence)) == (2, True)
    assert list(tmp_path.iterdir()) == []
