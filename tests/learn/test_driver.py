"""Trainings side by side, against environments whose answers are written down: nobody is at the mercy of the others."""

from __future__ import annotations

import math
import signal

import numpy as np
import pytest

from tests.learn.test_train import EXPLODED, LOST, ORDINARY, STUCK, SUCCESS, learner
from uarm_rl.learn.actor_critic import DivergenceError
from uarm_rl.learn.driver import alone, together
from uarm_rl.learn.learner import Learner
from uarm_rl.learn.train import Schedule, Settle, Stop, Training, train

#: Of different rhythm: some decisions are not admitted, and some updates not due.
SCRIPTS = [(ORDINARY,), (ORDINARY, STUCK, EXPLODED, SUCCESS, LOST), (STUCK, STUCK, STUCK, ORDINARY), (SUCCESS, LOST, STUCK)]

SHORT = Schedule(
    episodes=3,
    experiences_per_episode=12,
    max_decisions_per_episode=60,
    batch_size=4,
    warmup_experiences=3,
    updates_per_experience=2,
    validate_every=1,
    checkpoint_every=1,
)


class Run:
    """A training of three episodes; ``stop_after`` so many it is told to stop."""

    def __init__(self, *script: dict[str, object], stop_after: int = 99, **returns: object) -> None:
        self.learner: Learner = learner(*script, noise=0.3, **returns)
        self.rows: list[dict[str, object]] = []
        self.stop = Stop()
        self._stop_after = stop_after
        self.training: Training[None] = train(self.learner, SHORT, lambda: None, self.end_of_episode, self.stop)

    def end_of_episode(self, row):
        self.rows.append({name: value for name, value in row.items() if name != "wall_s"})
        self.stop.requested |= len(self.rows) >= self._stop_after
        yield Settle(self.learner)  # as a validation elsewhere

    @property
    def numbers(self) -> np.ndarray:
        return self.learner.agent.parameters.numpy()


def drive(*runs: Run, batched: bool = False) -> dict[int, Exception]:
    failures: dict[int, Exception] = {}
    together(
        [run.training for run in runs],
        [run.stop for run in runs],
        batch_size=4,
        device="cpu",
        batched=batched,
        failed=failures.__setitem__,
    )
    return failures


def on_its_own(*script: dict[str, object], **changes: object) -> Run:
    run = Run(*script, **changes)
    alone(run.training, run.stop)
    return run


def test_each_has_the_bytes_that_it_has_alone():
    runs = [Run(*script) for script in SCRIPTS]
    assert drive(*runs) == {}
    for run, script in zip(runs, SCRIPTS, strict=True):
        expected = on_its_own(*script)
        assert run.rows == expected.rows
        assert len(run.rows) == 3
        np.testing.assert_array_equal(run.numbers, expected.numbers)


def test_in_one_go_each_is_nearly_what_it_is_alone():
    runs = [Run(*script) for script in SCRIPTS]
    assert drive(*runs, batched=True) == {}
    for run, script in zip(runs, SCRIPTS, strict=True):
        expected = on_its_own(*script)
        for ours, theirs in zip(run.rows, expected.rows, strict=True):
            assert ours == pytest.approx(theirs, rel=1e-3, abs=1e-5)
        np.testing.assert_allclose(run.numbers, expected.numbers, atol=1e-5)


@pytest.mark.parametrize("batched", [False, True])
def test_one_that_fails_diverges_or_is_stopped_does_not_take_the_others_along(batched):
    broken = ORDINARY | {"reward": math.nan}
    diverging = Run(*SCRIPTS[0])
    diverging.learner.agent.parameters[5] = math.nan
    runs = [Run(*SCRIPTS[0]), Run(*SCRIPTS[1], broken), diverging, Run(*SCRIPTS[2], stop_after=1), Run(*SCRIPTS[3])]
    failures = drive(*runs, batched=batched)
    assert {number: type(error) for number, error in failures.items()} == {1: DivergenceError, 2: DivergenceError}
    assert "the environment returned reward nan" in str(failures[1])
    assert "parameters" in str(failures[2])
    assert [len(run.rows) for run in runs] == [3, 0, 0, 1, 3]
    for number, script in ((0, SCRIPTS[0]), (4, SCRIPTS[3])):
        np.testing.assert_allclose(runs[number].numbers, on_its_own(*script).numbers, atol=1e-5 if batched else 0.0)


def test_a_signal_stops_all_and_a_second_one_interrupts():
    runs = [Run(*script) for script in SCRIPTS[:2]]
    inner = runs[0].end_of_episode

    def interrupt(times):
        def end_of_episode(row):
            for _ in range(times):
                signal.raise_signal(signal.SIGINT)
            return inner(row)

        return end_of_episode

    runs[0].training = train(runs[0].learner, SHORT, lambda: None, interrupt(1), runs[0].stop)
    assert drive(*runs) == {}
    assert [run.stop.signal for run in runs] == [signal.SIGINT] * 2
    assert len(runs[1].rows) <= 1
    again = Run(*SCRIPTS[0])
    again.training = train(again.learner, SHORT, lambda: None, interrupt(2), again.stop)
    with pytest.raises(KeyboardInterrupt):
        drive(again, Run(*SCRIPTS[1]))
