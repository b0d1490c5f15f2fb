"""The training loop, against an environment whose answers are written down."""

from __future__ import annotations

import csv
import signal
from itertools import cycle

import numpy as np
import pytest
import torch

from tests.conftest import AGENT, CARD
from uarm_rl.learn import checkpoint, loggers
from uarm_rl.learn import run as session
from uarm_rl.learn.admission import NotStuck
from uarm_rl.learn.ddpg import DDPG
from uarm_rl.learn.driver import alone
from uarm_rl.learn.learner import Learner
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.learn.train import Schedule, Stop, train
from uarm_rl.task import observation
from uarm_rl.task.policy import ActorPolicy

ORDINARY = {
    "reward": -1.0,
    "terminated": False,
    "truncated": False,
    "control_steps": 3,
    "clipped": False,
    "travel_rad": 0.1,
    "object_moved_m": 0.001,
    "object_lost": False,
    "exploded": False,
    "is_success": False,
}
STUCK = ORDINARY | {"reward": -2.0, "clipped": True, "travel_rad": 0.0005, "control_steps": 2}
EXPLODED = ORDINARY | {"reward": -4.0, "truncated": True, "exploded": True, "control_steps": 0}
SUCCESS = ORDINARY | {"reward": -8.0, "terminated": True, "is_success": True}
LOST = ORDINARY | {"reward": -16.0, "truncated": True, "object_lost": True, "object_moved_m": 0.05}
TIMED_OUT = ORDINARY | {"reward": -32.0, "truncated": True}


class Script:
    """An ``AsyncEnv`` that gives the written answers in turn; its observations are numbered."""

    def __init__(self, *answers: dict[str, object]) -> None:
        self.answers = cycle(answers)
        self.resets: list[bool] = []
        self.actions: list[np.ndarray] = []
        self.seen = 0

    def _observe(self) -> np.ndarray:
        self.seen += 1
        return np.full(observation.SIZE, self.seen / 100, np.float32)

    def reset(self, *, home: bool) -> np.ndarray:
        self.resets.append(home)
        return self._observe()

    def step_async(self, action: np.ndarray) -> None:
        self.actions.append(action)

    def step_wait(self) -> tuple[object, ...]:
        info = next(self.answers)
        return self._observe(), info["reward"], info["terminated"], info["truncated"], info

    def state(self) -> dict[str, object]:
        return {}


class Loud:
    """Noise that is too loud for any action, and keeps what it was asked."""

    def __init__(self, value: float = 5.0) -> None:
        self.value = value
        self.asked: list[float | str] = []

    def reset(self) -> None:
        self.asked.append("reset")

    def __call__(self, progress: float) -> np.ndarray:
        self.asked.append(progress)
        return np.array([self.value, -self.value, 0.0])

    def state(self) -> dict[str, object]:
        return {}


def learner(*answers: dict[str, object], noise: float = 0.0, **returns: object) -> Learner:
    agent = DDPG(hidden=[4], **AGENT | returns, action_size=3, generator=torch.Generator().manual_seed(0))
    replay = ReplayBuffer(50, observation_size=observation.SIZE, action_size=3, generator=np.random.default_rng(1))
    return Learner(Script(*answers), agent, agent.policy(CARD), replay, NotStuck(0.001), Loud(noise))


def run(one: Learner, **changes: int) -> list[dict[str, object]]:
    lengths = {"episodes": 1, "experiences_per_episode": 4, "max_decisions_per_episode": 20, "batch_size": 2}
    rest = {"warmup_experiences": 1, "updates_per_experience": 1, "validate_every": 1, "checkpoint_every": 1}
    rows: list[dict[str, object]] = []
    ticks: list[None] = []
    schedule, stop = Schedule(**(lengths | rest | changes)), Stop()

    def end_of_episode(row):
        rows.append(row)
        return ()

    alone(train(one, schedule, lambda: ticks.append(None), end_of_episode, stop), stop)
    assert len(ticks) == one.counters.decisions
    return rows


def test_an_episode_stores_counts_and_resets_as_it_should():
    one = learner(ORDINARY, STUCK, EXPLODED, SUCCESS, LOST, TIMED_OUT)
    (row,) = run(one)
    assert one.env.resets == [True, True, False, False, False]  # only a world that exploded is built anew on the way
    assert {name: row[name] for name in ("experiences", "decisions", "control_steps", "successes")} == {
        "experiences": 4,
        "decisions": 6,
        "control_steps": 14,
        "successes": 1,
    }
    assert (row["object_losses"], row["explosions"], row["admission_rate"]) == (1, 1, 4 / 6)
    assert (row["episode_return"], row["object_moved_m"]) == (-63.0, pytest.approx(0.055))
    stored = one.replay.rows[:4]
    assert stored[:, 23].tolist() == [-1.0, -8.0, -16.0, -32.0]  # neither what is stuck nor what exploded
    assert stored[:, -1].tolist() == pytest.approx([0.9, 0.0, 0.9, 0.9])  # what is only cut off has a future
    # Observations 4, 6, 8 and 10 are those after the resets.
    assert stored[:, 0].tolist() == pytest.approx([0.01, 0.05, 0.07, 0.09])
    assert stored[:, 24].tolist() == pytest.approx([0.02, 0.06, 0.08, 0.10])


def test_there_is_one_gradient_step_an_experience_after_the_warm_up():
    rows = run(learner(ORDINARY), episodes=3, warmup_experiences=2)
    # The step for an experience is taken while the next decision is carried out, hence one behind.
    assert [row["updates"] for row in rows] == [1, 5, 9]
    assert ["critic_loss" in row for row in rows] == [True, True, True]
    assert "critic_loss" not in run(learner(ORDINARY), warmup_experiences=4)[0]


def test_there_may_be_more_gradient_steps_an_experience():
    assert [row["updates"] for row in run(learner(ORDINARY), episodes=2, updates_per_experience=3)] == [6, 18]


def test_later_rewards_are_added_up_as_far_as_a_chain_goes():
    """It ends before what is not admitted, and behind a success, a loss and an episode: what is left is stored with less."""
    one = learner(ORDINARY, ORDINARY, STUCK, ORDINARY, SUCCESS, LOST, n_steps=3)
    rows = run(one, episodes=2)
    first = [(-1 - 0.9, 0.81), (-1, 0.9), (-1 - 0.9 * 8, 0.0), (-8, 0.0)]
    second = [(-16, 0.9), (-1 - 0.9, 0.81), (-1, 0.9), (-1, 0.9)]
    assert [(row[23], row[-1]) for row in one.replay.rows[:8].tolist()] == [pytest.approx(pair) for pair in first + second]
    assert [row["experiences"] for row in rows] == [4, 8]
    assert one.replay.added == 8


def test_one_gradient_step_an_experience_waits_until_it_is_stored():
    one, drawn_from = learner(ORDINARY, n_steps=3), []
    sample = one.replay.sample
    one.replay.sample = lambda *how: drawn_from.append(one.replay.added) or sample(*how)
    run(one, experiences_per_episode=6, warmup_experiences=0)
    assert drawn_from == [1, 2, 3]


def test_noise_begins_anew_with_an_episode_and_knows_how_far_the_training_is():
    one = learner(ORDINARY, noise=5.0)
    run(one, episodes=2, experiences_per_episode=2)
    assert one.noise.asked == ["reset", 0.0, 0.25, "reset", 0.5, 0.75]
    assert all(action.dtype == np.float32 and action[:2].tolist() == [1.0, -1.0] for action in one.env.actions)


def test_without_noise_the_policy_acts():
    one = learner(ORDINARY)
    expected = one.policy.act(np.full(observation.SIZE, 0.01, np.float32)).copy()
    run(one)
    np.testing.assert_array_equal(one.env.actions[0], expected)
    np.testing.assert_array_equal(one.replay.rows[0, 20:23], expected)


def test_an_episode_ends_although_nothing_is_admitted():
    rows = run(learner(STUCK), episodes=2, max_decisions_per_episode=7)
    assert [(row["experiences"], row["decisions"], row["admission_rate"]) for row in rows] == [(0, 7, 0.0), (0, 14, 0.0)]


def run_in(folder, one, schedule, validate):
    stop, log = Stop(), loggers.Csv().opened(folder, {})
    value_range = (-100.0, 100.0)
    return alone(session.run(folder, one, schedule, validate=validate, value_range=value_range, log=log, stop=stop), stop)


def test_a_run_validates_in_time_and_leaves_progress_and_policy(tmp_path):
    one, validated = learner(ORDINARY), []

    def validate(policy):
        validated.append(policy)
        return iter([True, False, False, True, False])

    schedule = Schedule(
        3, 4, 20, batch_size=2, warmup_experiences=1, updates_per_experience=1, validate_every=2, checkpoint_every=1
    )
    assert run_in(tmp_path, one, schedule, validate)
    with open(tmp_path / "progress.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["validation_success_rate"] for row in rows] == ["", "0.4", "0.4"]  # the last one always
    assert [row["experiences"] for row in rows] == ["4", "8", "12"]
    assert validated == [one.policy] * 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["policy.safetensors", "progress.csv"]
    shown = np.full(observation.SIZE, 0.1, np.float32)
    saved = ActorPolicy.load(tmp_path / "policy.safetensors")
    np.testing.assert_allclose(saved.act(shown), one.policy.act(shown), atol=1e-6)


def test_a_stop_during_a_validation_does_not_wait_for_its_end(tmp_path):
    one, asked = learner(ORDINARY), []

    def validate(policy):
        for position in range(50):
            asked.append(position)
            if position == 1:
                signal.raise_signal(signal.SIGINT)
            yield True

    schedule = Schedule(
        4, 4, 20, batch_size=2, warmup_experiences=1, updates_per_experience=1, validate_every=2, checkpoint_every=4
    )
    assert not run_in(tmp_path, one, schedule, validate)
    assert asked == [0, 1]
    assert checkpoint.read_latest(tmp_path).episode == 1


@pytest.mark.parametrize(
    ("q_min", "q_max", "saturation", "problems"),
    [
        (-4.0, 2.0, 0.9, ""),
        (-4.1, 2.0, 0.5, "critic in [-4.1, 2], possible is [-4, 2]"),
        (-4.0, 2.1, 0.5, "critic in [-4, 2.1], possible is [-4, 2]"),
        (-1.0, 1.0, 0.91, "actor saturated in 91% of its outputs"),
        (-5.0, 1.0, 1.0, "critic in [-5, 1], possible is [-4, 2]; actor saturated in 100% of its outputs"),
        (None, None, None, ""),  # an episode without a gradient step
    ],
)
def test_a_training_that_goes_astray_is_warned_of_in_words(q_min, q_max, saturation, problems):
    row = {"q_min": q_min, "q_max": q_max, "saturation": saturation}
    assert session.warning(row, (-4.0, 2.0)) == problems
