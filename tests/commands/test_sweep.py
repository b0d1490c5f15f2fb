"""`uarm-rl sweep`: a study in one file, which goes on where it was, ends what is hopeless, and is not taken for another."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import optuna
import pytest
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

from tests.commands.test_multirun import TINY
from tests.learn.test_training import outcome
from uarm_rl import cli, configuration
from uarm_rl.commands import status
from uarm_rl.commands import train as commands_train
from uarm_rl.learn import checkpoint

WORDS = (
    *(word for word in TINY if not word.startswith(("episodes", "validate", "checkpoint"))),
    *("episodes=4", "validate_every=2", "checkpoint_every=1"),
)
SEARCHED = ("agent.actor_lr=tag(log,interval(1e-4,1e-2))", "buffer=adaptive,uniform")


@pytest.fixture
def sweep(tmp_path, monkeypatch, capsys) -> Callable[..., str]:
    """What the command says; its exit code is in front where it is not 0."""
    monkeypatch.chdir(tmp_path)

    def sweep(*words: str) -> str:
        code = 0
        try:
            cli.main(("sweep", *WORDS, *words))
        except SystemExit as end:
            code = int(end.code or 0)
        said = capsys.readouterr()
        return f"{code}: " * bool(code) + said.out + said.err

    return sweep


def study() -> optuna.Study:
    storage = JournalStorage(JournalFileBackend("results/sweep/study.journal"))
    return optuna.load_study(study_name="uarm-rl", storage=storage)


def test_a_study_goes_on_where_it_was_stopped_and_each_trial_is_a_run(sweep, monkeypatch):
    write = checkpoint.write

    def write_and_interrupt(run_dir, saved):
        write(run_dir, saved)
        if saved.episode == 2 and "trial0001" in str(run_dir):
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "write", write_and_interrupt)
        assert sweep(*SEARCHED, "sweep.trials=2").startswith("130: ")
    said = sweep(*SEARCHED, "sweep.trials=2")
    assert "trial 1: agent.actor_lr=" in said
    assert "resuming after episode 2 of 4" in said
    assert "trial 0: " not in said
    assert "results/sweep: 2 trials done\nbest: " in said
    trials = [trial for trial in study().get_trials() if trial.state.name == "COMPLETE"]
    assert [trial.user_attrs.get("continues", trial.number) for trial in trials] == [0, 1]
    assert trials[1].params == study().get_trials()[1].params
    words = [f"{name}={value}" for name, value in trials[1].params.items()]
    settings = configuration.compose("train", (*WORDS, *words, "results_dir=alone", "name=trial0001"))
    commands_train.run(settings)
    assert outcome(Path("alone/trial0001/seed0")) == outcome(Path("results/sweep/trial0001/seed0"))
    said = sweep(SEARCHED[0].replace("1e-2", "2e-2"), SEARCHED[1], "sweep.trials=3")
    assert "error: results/sweep holds another study, with agent.actor_lr.high=0.01, not 0.02; take sweep.study=NAME" in said
    said = sweep(*SEARCHED, "agent.tau=0.1", "sweep.trials=3")
    assert "another study, with agent.tau=0.005, not 0.1" in said


def test_a_trial_that_is_worse_than_most_is_ended(sweep):
    sweep(*SEARCHED, "sweep.trials=1")
    for _ in range(5):  # as if others had found better ones
        study().add_trial(
            optuna.trial.create_trial(
                params=study().trials[0].params,
                distributions=study().trials[0].distributions,
                intermediate_values=dict.fromkeys(range(1, 5), 1.0),
                value=1.0,
            )
        )
    said = sweep(*SEARCHED, "sweep.trials=7")
    assert "trial 6 is worse than most at its episode, and ended" in said
    assert "6 trials done, 1 pruned" in said
    assert [one.why for one in status.statuses(Path("results"))] == ["trained", "ended by its sweep"]
    assert "ended" not in sweep(*SEARCHED, "sweep.trials=7")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ((), "sweep searches nothing; give a setting several values"),
        (("agent.tau=interval(2,1)",), "agent.tau=interval(2,1) is no interval to search"),
        (("agent.tau=interval(0.1,0.2)", "sweep.study=../x"), "sweep.study must be a name of letters"),
        (("agent.tau=interval(0.1,0.2)", "sweep.trials=0"), "sweep.trials must be a whole number from 1"),
        (("agent.gama=interval(0.1,0.2)",), "sweep has no setting 'agent.gama'; did you mean agent.gamma?"),
        (("agent.gamma=interval(2.0,3.0)",), "agent.gamma must be a number from 0 to 1, got 2"),
        (("seed=glob(*)",), "seed=glob(*) is no search"),
        (("hydra/sweeper=optuna",), "hydra/sweeper=optuna is not for the command line; uarm-rl sweep searches"),
    ],
)
def test_what_cannot_be_searched_is_said_before_anything_is_done(sweep, tmp_path, words, sentence):
    said = sweep(*words)
    assert f"error: {sentence}" in said
    assert list(tmp_path.iterdir()) == []
