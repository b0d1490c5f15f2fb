"""CSV files: whole or not at all."""

from __future__ import annotations

import errno
import os
import sys

import numpy as np
import pytest

from tests.disks import COMMITS, counted_calls
from uarm_rl.csvfile import Logbook, write_rows


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


@pytest.mark.skipif(sys.version_info < (3, 11), reason="pathlib of Python 3.10 keeps names of its own of what fails here")
@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EIO, errno.EACCES], ids=errno.errorcode.get)
def test_whatever_fails_during_a_replacement_a_whole_file_is_there(tmp_path, error):
    def fail():
        raise OSError(error, os.strerror(error), "disk")

    path = tmp_path / "a.csv"
    # Removing what is left over, opening, flushing, renaming; then the new file is there, and its folder is opened and flushed.
    for at, content in enumerate(("x\n1\n", "x\n1\n", "x\n1\n", "x\n1\n", "x\n2\n", "x\n2\n"), start=1):
        write_rows(path, ("x",), [{"x": 1}])
        with pytest.raises(OSError, match="disk"), counted_calls(at, fail, (*COMMITS, "open")):
            write_rows(path, ("x",), [{"x": 2}])
        assert path.read_text() == content
        assert list(tmp_path.iterdir()) == [path]
    with counted_calls(7, fail, (*COMMITS, "open")) as calls:
        write_rows(path, ("x",), [{"x": 3}])
    assert calls == [6]
