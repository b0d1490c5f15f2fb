"""A run folder's lock, and what is noticed where it does not reach from one machine to the other."""

from __future__ import annotations

import errno
import os
import threading
import time
from pathlib import Path

import pytest

from uarm_rl import locks
from uarm_rl.files import HOLDER

OTHER = "node7 4711 another-machine\n"


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(locks, "BEAT_S", 0.05)


def test_who_holds_a_folder_is_known_and_nothing_is_left(tmp_path):
    assert locks.holder(tmp_path) == ""
    with locks.held(tmp_path):
        before = locks.read(tmp_path / HOLDER)
        assert locks.holder(tmp_path) == str(before)
        assert locks.holder(tmp_path).endswith(f", process {os.getpid()}")
        with pytest.raises(locks.LockError, match=rf"another process is training in {tmp_path} \(.*process {os.getpid()}\)"):
            locks.held(tmp_path).__enter__()
        ends = time.monotonic() + 10.0
        while locks.read(tmp_path / HOLDER) == before:
            assert time.monotonic() < ends, "the note is not renewed"
            time.sleep(0.01)
    assert locks.holder(tmp_path) == ""
    assert not (tmp_path / HOLDER).exists()


def test_a_lock_that_does_not_reach_this_machine_is_noticed(tmp_path):
    """As on a disk that is mounted without locks between machines: the other's lock is not seen, its note is."""
    (tmp_path / HOLDER).write_text(OTHER)
    assert locks.holder(tmp_path) == "node7, process 4711"
    done = threading.Event()

    def live() -> None:
        while not done.wait(0.02):
            os.utime(tmp_path / HOLDER)

    thread = threading.Thread(target=live)
    thread.start()
    try:
        with pytest.raises(locks.LockError, match=r"node7, process 4711\), and its lock does not reach this machine"):
            locks.held(tmp_path).__enter__()
    finally:
        done.set()
        thread.join()
    assert (tmp_path / HOLDER).read_text() == OTHER


def test_what_a_machine_that_died_left_is_taken_over(tmp_path):
    (tmp_path / HOLDER).write_text(OTHER)
    with locks.held(tmp_path):
        assert "node7" not in locks.holder(tmp_path)
    (tmp_path / HOLDER).write_text(OTHER)
    old = time.time() - 2 * locks.STALE_S
    os.utime(tmp_path / HOLDER, (old, old))
    assert locks.holder(tmp_path) == ""


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_a_disk_without_locks_is_said(tmp_path, monkeypatch, number):
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(pytest.importorskip("fcntl"), "flock", refuse)
    with pytest.raises(locks.LockError, match="this disk has no locks"):
        locks.held(tmp_path).__enter__()
    assert locks.holder(tmp_path) == ""


@pytest.mark.parametrize("content", [b"", b"a b", b"\x1b[2J 1 2", b"\xff" * 5000, b"a b c d"])
def test_a_note_of_something_else_is_none(tmp_path, content):
    (tmp_path / HOLDER).write_bytes(content)
    assert locks.holder(tmp_path) == ""
    with locks.held(tmp_path):
        pass


def test_a_link_in_the_place_of_a_lock_is_refused(tmp_path):
    (tmp_path / ".lock").symlink_to(tmp_path / "victim")
    with pytest.raises(locks.LockError, match="is no plain file"):
        locks.held(tmp_path).__enter__()
    assert list(Path(tmp_path).iterdir()) == [tmp_path / ".lock"]
