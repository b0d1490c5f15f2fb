"""`uarm-rl submit` and `status`: runs on a queue that kills, preempts and loses them end as those of one process."""

from __future__ import annotations

import os
import shlex
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from tests import slurm
from tests.commands.test_multirun import TINY
from tests.learn.test_training import outcome
from uarm_rl import cli, columns, configuration, csvfile, locks
from uarm_rl.commands import status, submitted
from uarm_rl.commands import train as commands_train
from uarm_rl.commands.submitted import Entry

CHANGED = ("episodes=3", "checkpoint_every=1")
WORDS = ("experiment=C", *(word for word in TINY if not word.startswith(("episodes", "checkpoint"))), *CHANGED)
LONGER = tuple(word.replace("episodes=3", "episodes=8") for word in WORDS)


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def say(place, capsys) -> Callable[..., str]:
    """What a command says, on both ways; its exit code is in front where it is not 0."""

    def say(*words: str) -> str:
        code = 0
        try:
            cli.main(words)
        except SystemExit as end:
            code = int(end.code or 0)
        said = capsys.readouterr()
        return f"{code}: " * bool(code) + said.out + said.err

    return say


def queue(place: Path, monkeypatch: pytest.MonkeyPatch, plan: dict[int, str] | None = None, **how: object) -> Path:
    for name, value in slurm.install(place / "slurm", plan, **how).items():
        monkeypatch.setenv(name, value)
    return place / "slurm"


def wait_for(what: Callable[[], object]) -> None:
    ends = time.monotonic() + 100.0
    while not what():
        assert time.monotonic() < ends
        time.sleep(0.05)


def alone(folder: Path, *words: str) -> dict[str, object]:
    """The outcome of a run that nobody disturbs."""
    settings = configuration.compose("train", (*words, f"results_dir={folder}"))
    commands_train.run(settings)
    return outcome(folder / settings["name"] / f"seed{settings['seed']}")


def states(folder: Path) -> dict[int, str]:
    return {one.seed: one.state for one in status.statuses(folder)}


def test_runs_end_the_same_on_a_queue_that_kills_preempts_and_loses_them(place, say, monkeypatch):
    folder = queue(place, monkeypatch, {0: "preempt", 1: "die", 2: "lose"})
    words = (*WORDS, "seed=0,1,2", "results_dir=many here")
    said = say("submit", *words)
    assert "submitted: 3 runs" in said
    assert "follow them with: uarm-rl status results_dir='many here'" in said
    wait_for(lambda: slurm.is_idle(folder))
    assert states(Path("many here")) == {0: "done", 1: "dead", 2: "dead"}
    said = say("status", "results_dir=many here")
    assert all(part in said for part in ("1 done, 2 dead", "its job is gone and never began it"))
    queue(place, monkeypatch, {0: "1"})
    again = shlex.split(said.split("continue: uarm-rl ")[1].splitlines()[0])
    said = say(*again)
    assert all(part in said for part in ("left out: 1 of 3 runs, which are finished", "submitted: 2 runs"))
    assert states(Path("many here"))[1] == "waiting"
    wait_for(lambda: slurm.is_idle(folder))
    logs = "".join(path.read_text() for path in place.glob("many here/submitted-*/1000_0_0_log.out"))
    assert logs.count(slurm.BEGUN) == 2, "it was not preempted"
    for seed in range(3):
        assert outcome(place / "many here" / "adaptive-penalty" / f"seed{seed}") == alone(
            place / "alone", *WORDS, f"seed={seed}"
        ), seed
    assert "left out: 3 of 3" in say(*again)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of processes that go on, as they should
def test_processes_of_this_machine_are_preempted_likewise(place, say):
    words = (*LONGER, "cluster.name=local")
    assert "submitted: 1 runs" in say("submit", *words)
    logs = Path("results")
    wait_for(lambda: any(slurm.BEGUN in path.read_text() for path in logs.glob("submitted-*/*.out")))
    (one,) = status.statuses(Path("results"))
    os.kill(int(one.why.split()[-1]), signal.SIGUSR2)
    assert one.state == "running"
    assert "left out: 1 of 1 runs, which are running or waiting" in say("submit", *words)
    wait_for(lambda: states(Path("results")) == {0: "done"})
    assert sum(path.read_text().count(slurm.BEGUN) for path in logs.glob("submitted-*/*.out")) == 2
    assert outcome(place / "results" / "adaptive-penalty" / "seed0") == alone(place / "alone", *LONGER)


def test_a_queue_that_is_full_loses_nothing(place, say, monkeypatch):
    folder = queue(place, monkeypatch, full=True)
    said = say("submit", *WORDS, "seed=0,1")
    assert said.startswith("1: error: the cluster did not take the runs: ")
    assert "job submit limit" in said
    assert "nothing is lost: results/submitted-" in said
    said = say("status")
    assert all(part in said for part in ("the queue did not take it", "2 dead", "continue: uarm-rl submit experiment=C"))
    assert slurm.is_idle(folder)


def test_without_a_queue_files_and_locks_say_what_they_can(place, say, monkeypatch):
    monkeypatch.setenv("PATH", str(place))
    runs = place / "results" / "adaptive-penalty"
    hostile = "experiment=C '$(touch canary)' `touch canary`"
    (place / "results").mkdir()
    submitted.write(
        place / "results" / "submitted-1.csv",
        [Entry(f"adaptive-penalty/seed{seed}", f"7_{seed}", hostile) for seed in range(3)],
    )
    begin(runs / "seed0", "agent.hidden=[8,8]", "hold@buffer.hold=fixed", "agent.gamma=0.8", "name=adaptive-penalty")
    begin(runs / "seed1")
    begin(runs / "seed5", "seed=5", "agent.hidden=[8,8]", "hold@buffer.hold=fixed", "name=adaptive-penalty", "servo=stepper")
    with locks.held(runs / "seed1"):
        assert states(place / "results") == {0: "dead", 1: "running", 2: "waiting", 5: "dead"}
        said = say("status", "state=dead")
    lines = [shlex.split(line.removeprefix("continue: ")) for line in said.splitlines() if line.startswith("continue")]
    assert lines[0][:4] == ["uarm-rl", "submit", "experiment=C", "$(touch canary)"]
    assert lines[1][:2] == ["uarm-rl", "train"]
    settings = configuration.compose("train", lines[1][2:])
    assert (settings["seed"], settings["agent"]["hidden"], settings["servo"]["name"]) == (5, [8, 8], "stepper")
    assert commands_train.output(settings) == Path("results/adaptive-penalty/seed5")


@pytest.mark.parametrize("folder", ["../../etc/passwd", "/abs/seed3", "x", "\x1b[2J/seed1", "a/seed1x"])
def test_a_list_that_names_no_run_is_refused(place, say, folder):
    (place / "results").mkdir()
    submitted.write(place / "results" / "submitted-1.csv", [Entry(folder, "0:0", "a")])
    said = say("status")
    assert "error: results/submitted-1.csv names " in said
    assert "which is no run's folder" in said


def begin(run: Path, *words: str) -> None:
    """A run that began and was killed."""
    settings = configuration.compose("train", words)
    run.mkdir(parents=True)
    left = ("resume", "overwrite", "results_dir", "simulate_beside", "logger")
    kept = {key: value for key, value in settings.items() if key not in left}
    (run / "config.yaml").write_text(yaml.safe_dump(kept))
    (run / ".lock").touch()
    csvfile.write_rows(run / "progress.csv", columns.PROGRESS, [])


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("cluster.name=cloud",), "cluster.name must be slurm or local, got 'cloud'"),
        (("cluster.partition='a b'",), "cluster.partition must be a name, got 'a b'"),
        (("cluster.minutes=0",), "cluster.minutes must be a whole number from 1 to 525600, got 0"),
        (("cluster.minutes=1,2", "name=x-${cluster.minutes}"), "cluster says where all runs go; give it one value"),
        (("overwrite=true",), "submit never deletes a run"),
        (("agent.gamma=2",), "agent.gamma must be a number from 0 to 1, got 2"),
        (("results_dir='a%b'",), "results_dir must be a path of letters"),
        (("hydra/launcher=joblib",), "submit takes no hydra/launcher=joblib; cluster.name=local or slurm says"),
        (("name=${cluster.name}",), "the cluster did not take the runs: Could not detect"),
    ],
)
def test_what_no_cluster_could_do_is_refused_in_a_sentence(say, place, monkeypatch, words, sentence):
    monkeypatch.setenv("PATH", str(place))
    said = say("submit", *WORDS, *words)
    assert f"error: {sentence}" in said
    assert "Traceback" not in said
