"""Checkpoints and CSV files: whole or not at all."""

from __future__ import annotations

import errno
import os
import shutil

import numpy as np
import pytest

from uarm_rl.csvfile import Logbook, write_rows
from uarm_rl.learn import checkpoint
from uarm_rl.learn.checkpoint import Checkpoint

ARRAYS = {"agent/parameters": np.arange(40, dtype=np.float32), "replay/rows": np.ones((3, 5), np.float32)}


def test_a_checkpoint_comes_back_as_it_was(tmp_path):
    state = {"counters": {"episode": 7}, "generator": np.random.default_rng(3).bit_generator.state}
    checkpoint.write(tmp_path, Checkpoint(7, ARRAYS, state))
    episode, arrays, loaded = checkpoint.read_latest(tmp_path)
    assert episode == 7
    assert loaded == state  # 128-bit integers of the generator included
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
        with pytest.raises(checkpoint.CheckpointError, match="is damaged"):
            checkpoint.read_latest(tmp_path)
        data[place] ^= 0x10


def test_log_rows_are_on_disk_at_once_and_numbers_are_plain(tmp_path):
    log = Logbook(tmp_path / "a.csv", ("episode", "loss", "rate"))
    log.add({"episode": 1, "loss": 0.123456789123})
    log.add({"episode": 2, "loss": np.float32(0.5).item(), "rate": 1.0})
    assert (tmp_path / "a.csv").read_text() == "episode,loss,rate\n1,0.123456789,\n2,0.5,1\n"
    with pytest.raises(ValueError, match="column 'los' was not declared"):
        log.add({"los": 1})
    log.close()


def test_a_log_continues_behind_the_rows_of_the_checkpoint(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("episode\n1\n2\n3\n4")  # the last row was cut off by a crash
    log = Logbook(path, ("episode",), keep_rows=2)
    log.add({"episode": 3})
    log.close()
    assert path.read_text() == "episode\n1\n2\n3\n"


@pytest.mark.parametrize("text", ["episode\n1\n", "other\n1\n2\n", "", "episode\n1\n2"])
def test_a_log_that_does_not_fit_the_checkpoint_is_refused(tmp_path, text):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match="does not hold the 2 rows"):
        Logbook(path, ("episode",), keep_rows=2)
    assert path.read_text() == text


def test_a_failed_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.csv"
    write_rows(path, ("x",), [{"x": 1}])
    with pytest.raises(KeyError):
        write_rows(path, ("x",), [{"y": 1}])
    assert path.read_text() == "x\n1\n"


def test_a_checkpoint_of_numbers_that_are_not_finite_is_not_written(tmp_path):
    checkpoint.write(tmp_path, Checkpoint(1, ARRAYS, {}))
    with pytest.raises(checkpoint.CheckpointError, match="replay/rows holds numbers that are not finite"):
        checkpoint.write(tmp_path, Checkpoint(2, ARRAYS | {"replay/rows": np.array([1.0, np.nan], np.float32)}, {}))
    assert checkpoint.read_latest(tmp_path)[0] == 1


class Disk:
    """Fails the n-th call of the operating system that a save makes, in one of several ways."""

    def __init__(self, monkeypatch, fail_at, error):
        self.calls = 0
        for name in ("fsync", "rename", "replace", "open"):
            real = getattr(os, name)
            monkeypatch.setattr(os, name, self._wrap(real, fail_at, error))

    def _wrap(self, real, fail_at, error):
        def call(*arguments, **keywords):
            self.calls += 1
            if self.calls == fail_at:
                raise OSError(error, os.strerror(error), "disk")
            return real(*arguments, **keywords)

        return call


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EIO, errno.EACCES], ids=errno.errorcode.get)
def test_whatever_fails_during_a_save_the_last_checkpoint_loads(tmp_path, monkeypatch, error):
    checkpoint.write(tmp_path, Checkpoint(1, ARRAYS, {"episode": 1}))
    failures = 0
    for fail_at in range(1, 100):
        with monkeypatch.context() as patch:
            disk = Disk(patch, fail_at, error)
            try:
                checkpoint.write(tmp_path, Checkpoint(2, ARRAYS, {"episode": 2}))
            except OSError:
                failures += 1
        if disk.calls < fail_at:
            break
        assert checkpoint.read_latest(tmp_path)[0] in (1, 2)
        if checkpoint.read_latest(tmp_path)[0] == 2:  # it was renamed before the failure; begin again
            shutil.rmtree(tmp_path / "checkpoint-000002")
            checkpoint.write(tmp_path, Checkpoint(1, ARRAYS, {"episode": 1}))
    assert failures >= 7
    assert checkpoint.read_latest(tmp_path)[0] == 2


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EIO, errno.EACCES], ids=errno.errorcode.get)
def test_whatever_fails_during_a_replacement_a_whole_file_is_there(tmp_path, monkeypatch, error):
    path = tmp_path / "a.csv"
    write_rows(path, ("x",), [{"x": 1}])
    for fail_at in range(1, 4):
        with monkeypatch.context() as patch:
            Disk(patch, fail_at, error)
            with pytest.raises(OSError, match="disk"):
                write_rows(path, ("x",), [{"x": 2}])
        assert path.read_text() in ("x\n1\n", "x\n2\n")
        assert list(tmp_path.iterdir()) == [path]
