"""Checkpoints: whole or not at all on the disk, and nothing but a checkpoint of such a learner is taken for one."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from copy import deepcopy

import numpy as np
import pytest
import torch

from tests import disks
from tests.conftest import AGENT, CARD
from tests.hostile.tensors import BROKEN
from uarm_rl import files
from uarm_rl.learn import checkpoint
from uarm_rl.learn.admission import AdmitAll
from uarm_rl.learn.async_env import InlineEnv
from uarm_rl.learn.checkpoint import Checkpoint, CheckpointError
from uarm_rl.learn.ddpg import DDPG
from uarm_rl.learn.learner import Learner
from uarm_rl.learn.noise import OrnsteinUhlenbeck
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.learn.returns import Transition
from uarm_rl.task import observation

ARRAYS = {"agent/parameters": np.arange(40, dtype=np.float32), "replay/transitions": np.ones((3, 5), np.float32)}


def test_a_checkpoint_comes_back_as_it_was(tmp_path):
    state = {"counters": {"episode": 7}, "generator": np.random.default_rng(3).bit_generator.state}
    checkpoint.write(tmp_path, Checkpoint(7, ARRAYS, state))
    episode, arrays, loaded = checkpoint.read_latest(tmp_path)
    assert episode == 7
    assert loaded == state  # 128-bit integers of the generator included
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)


def test_only_the_newest_is_kept(tmp_path):
    for episode in (1, 2, 30):
        checkpoint.write(tmp_path, Checkpoint(episode, ARRAYS, {"episode": episode}))
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint-000030"]


def test_no_checkpoint_is_none(tmp_path):
    assert checkpoint.read_latest(tmp_path) is None


def test_what_a_crash_leaves_behind_is_passed_over(tmp_path):
    checkpoint.write(tmp_path, Checkpoint(1, ARRAYS, {"episode": 1}))
    unfinished = tmp_path / "checkpoint-000002.tmp"
    unfinished.mkdir()
    (unfinished / "arrays.safetensors").write_bytes(b"half")
    torn = tmp_path / "checkpoint-000003"
    torn.mkdir()
    (torn / "state.json").write_text("{}")
    assert checkpoint.read_latest(tmp_path)[0] == 1
    checkpoint.write(tmp_path, Checkpoint(2, ARRAYS, {"episode": 2}))  # the leftover of the same name does not disturb it
    assert checkpoint.read_latest(tmp_path)[0] == 2


@pytest.mark.parametrize("part", ["arrays.safetensors", "state.json", "manifest.json"])
def test_a_flipped_bit_is_refused(tmp_path, part):
    checkpoint.write(tmp_path, Checkpoint(1, ARRAYS, {"episode": 1}))
    path = tmp_path / "checkpoint-000001" / part
    data = bytearray(path.read_bytes())
    for place in range(0, len(data), 23):
        data[place] ^= 0x10
        path.write_bytes(data)
        with pytest.raises(CheckpointError, match="is damaged"):
            checkpoint.read_latest(tmp_path)
        data[place] ^= 0x10


@pytest.mark.parametrize("content", BROKEN.values(), ids=BROKEN)
def test_tensors_that_are_none_are_refused_though_their_hash_is_right(tmp_path, monkeypatch, learner, content):
    """By the reader, or where the library takes them (its metadata may be anything) by the learner, which misses its own."""
    monkeypatch.setattr(checkpoint, "save", lambda arrays: content)
    checkpoint.write(tmp_path, Checkpoint(3, ARRAYS, saved(learner).state))
    with pytest.raises(CheckpointError, match=r"is damaged|does not fit this configuration"):
        learner.restore(checkpoint.read_latest(tmp_path))


def test_numbers_that_are_not_finite_are_not_written(tmp_path):
    checkpoint.write(tmp_path, Checkpoint(1, ARRAYS, {}))
    with pytest.raises(CheckpointError, match="replay/transitions holds numbers that are not finite"):
        checkpoint.write(tmp_path, Checkpoint(2, ARRAYS | {"replay/transitions": np.array([1.0, np.nan], np.float32)}, {}))
    assert checkpoint.read_latest(tmp_path)[0] == 1


@pytest.mark.parametrize("harness", [disks.failing_saves, disks.full_disks])
def test_whatever_fails_during_a_save_the_last_checkpoint_loads(tmp_path, harness):
    saves, lost = harness(tmp_path)
    assert saves > 40
    assert lost == 0


def test_a_disk_that_keeps_other_bytes_than_were_written_is_noticed_before_the_last_checkpoint_goes(tmp_path, monkeypatch):
    checkpoint.write(tmp_path, Checkpoint(1, ARRAYS, {}))
    write = files.write_and_flush
    monkeypatch.setattr(files, "write_and_flush", lambda path, data: write(path, data[:-1] + b"!"))
    with pytest.raises(ValueError, match=r"does not match its hash|delimiter"):
        checkpoint.write(tmp_path, Checkpoint(2, ARRAYS, {}))
    assert checkpoint.read_latest(tmp_path).episode == 1


# What a learner takes over


@pytest.fixture(scope="module")
def learner() -> Learner:
    """One that has learned a little, without the simulator: restoring is about what is kept, not about an arm."""

    class Env:
        np_random = np.random.default_rng(3)

        def reset(self, **how: object) -> None:
            pass

    networks = torch.Generator().manual_seed(0)
    agent = DDPG(hidden=[4, 4], **AGENT, action_size=3, generator=networks)
    replay = ReplayBuffer(8, observation_size=observation.SIZE, action_size=3, generator=np.random.default_rng(1))
    zeros = np.zeros(observation.SIZE, np.float32)
    for reward in range(11):
        replay.add(Transition(zeros, np.zeros(3, np.float32), reward, zeros, 0.9 * (reward % 2)))
    amplitudes = {"initial_amplitude": 0.5, "final_amplitude": 0.1, "decay_fraction": 0.5}
    noise = OrnsteinUhlenbeck(theta=0.15, **amplitudes, action_size=3, generator=np.random.default_rng(2))
    noise.reset()
    made = Learner(InlineEnv(Env, 0), agent, agent.policy(CARD), replay, AdmitAll(), noise)
    made.counters.restore({"episode": 3, "experiences": 11, "decisions": 30, "control_steps": 90, "updates": 20, "wall_s": 1.5})
    return made


def saved(learner: Learner) -> Checkpoint:
    return deepcopy(learner.snapshot()())


def test_a_learner_takes_over_what_it_saved(learner):
    before = saved(learner)
    learner.agent.parameters.zero_()
    learner.replay.rows.fill(0.0)
    learner.noise.reset()
    learner.counters.episode = 9
    learner.restore(before)
    after = saved(learner)
    assert (after.episode, after.state) == (before.episode, before.state)
    assert after.arrays.keys() == before.arrays.keys()
    assert all(np.array_equal(array, after.arrays[name]) for name, array in before.arrays.items())


def places(node: object) -> Iterator[tuple[dict[str, object], str]]:
    """Every key of nested dicts, with the dict that holds it."""
    for key, value in node.items() if isinstance(node, dict) else ():
        yield node, key
        yield from places(value)


VALUES = (
    None,
    True,
    "os.system",
    [],
    {},
    -1,
    1.5,
    10**30,
    2**80,
    math.nan,
    1e300,
    [math.nan] * 3,
    [[0, 0, 0]] * 3,
    {"_target_": "os.system"},
)


def test_a_hostile_value_in_the_state_is_refused_or_does_no_harm(learner):
    good = saved(learner)
    state = deepcopy(good.state)
    refused = harmless = 0
    for place, key in list(places(state)):
        kept = place[key]
        for value in VALUES:
            place[key] = value
            try:
                learner.restore(good._replace(state=state))
            except CheckpointError:
                refused += 1
            else:  # it goes on learning, and what it saves is a state again
                learner.replay.sample(4)
                assert np.isfinite(learner.noise(0.5)).all()
                learner.restore(saved(learner))
                json.dumps(saved(learner).state, allow_nan=False)
                harmless += 1
        place[key] = kept
    assert refused > 4 * harmless > 0
    learner.restore(good)


def test_a_state_that_lacks_something_is_refused(learner):
    good = saved(learner)
    state = deepcopy(good.state)
    for place, key in list(places(state)):
        kept = place.pop(key)
        with pytest.raises(CheckpointError, match="does not fit this configuration"):
            learner.restore(good._replace(state=state))
        place[key] = kept
    learner.restore(good._replace(state=state))


def test_a_checkpoint_from_before_discounts_were_stored_is_taken_over(learner):
    """Terminations, 0 or 1, stood in their place, and what was stored was what was experienced."""
    now = saved(learner)
    rows = now.arrays["replay/transitions"].copy()
    rows[:, -1] = rows[:, -1] == 0
    counters = {name: value for name, value in now.state["counters"].items() if name != "experiences"}
    arrays = {name: array for name, array in now.arrays.items() if name != "replay/transitions"} | {"replay/rows": rows}
    learner.restore(Checkpoint(now.episode, arrays, now.state | {"counters": counters}))
    again = saved(learner)
    assert again.state == now.state
    assert {name: array.tobytes() for name, array in again.arrays.items()} == {
        name: array.tobytes() for name, array in now.arrays.items()
    }


def test_a_state_of_another_episode_than_its_folder_is_refused(learner):
    with pytest.raises(CheckpointError, match="it holds episode 3"):
        learner.restore(saved(learner)._replace(episode=4))


SHAPES = {
    "one more row": lambda array: np.atleast_1d(array).repeat(2, axis=0),
    "no rows": lambda array: np.atleast_1d(array)[:0],
    "three axes": lambda array: array[None, None],
    "float64": lambda array: array.astype("float64"),
    "whole numbers": lambda array: array.astype("int32"),
    "booleans": lambda array: array > 0,
}


@pytest.mark.parametrize("turn", SHAPES.values(), ids=SHAPES)
def test_arrays_of_another_shape_or_type_are_refused(learner, turn):
    good = saved(learner)
    for name, array in good.arrays.items():
        for arrays in (good.arrays | {name: turn(array)}, {key: kept for key, kept in good.arrays.items() if key != name}):
            with pytest.raises(CheckpointError, match="does not fit this configuration"):
                learner.restore(good._replace(arrays=arrays))
    learner.restore(good)
