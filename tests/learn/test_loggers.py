"""Loggers: the tools that are installed hold what progress.csv holds, on this machine, and change nothing of the run."""

from __future__ import annotations

import csv
import sqlite3
import struct
from pathlib import Path

import pytest

from tests.conftest import FAST, uarm_rl

RUN = "results/adaptive-penalty/seed0"
Curve = list[tuple[int, float]]


def train(folder: Path, logger: str, *words: str) -> Path:
    done = uarm_rl("train", *FAST, f"logger={logger}", "simulate_beside=false", *words, cwd=folder, timeout_s=400)
    assert done.returncode == 0, done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()] == [f"{RUN}:", "trained:"]
    return folder / RUN


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    return train(tmp_path_factory.mktemp("plain"), "csv")


def curve(run: Path) -> Curve:
    """The validations of a run, by experiences."""
    with open(run / "progress.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["validation_success_rate"]]
    return [(int(row["experiences"]), float(row["critic_loss"])) for row in rows]


def in_tensorboard(run: Path) -> Curve:
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(run / "tensorboard")).Reload()
    steps = {event.step for event in events.Scalars("validation_success_rate")}
    return [(event.step, event.value) for event in events.Scalars("critic_loss") if event.step in steps]


def in_wandb(run: Path) -> Curve:
    """From the records of its file: after seven bytes, checksum, length and type, then a message, as in LevelDB's log."""
    from wandb.proto.wandb_internal_pb2 import Record

    (file,) = run.glob("wandb/offline-run-*/run-*.wandb")
    data, place, points, message = file.read_bytes(), 7, [], b""
    while place + 7 <= len(data):
        length, kind = struct.unpack_from("<HB", data, place + 4)
        message += data[place + 7 : place + 7 + length]
        place += 7 + length
        if (left := -place % 2**15) < 7:  # no record begins in a block's last bytes
            place += left
        if kind in (1, 4):  # whole, or its last part
            row = {item.key or item.nested_key[0]: item.value_json for item in Record.FromString(message).history.item}
            if "validation_success_rate" in row:
                points.append((int(row["experiences"]), float(row["critic_loss"])))
            message = b""
    return points


def in_sqlite(file: Path, query: str) -> Curve:
    with sqlite3.connect(file) as database:
        return database.execute(query).fetchall()


def in_mlflow(run: Path) -> Curve:
    (experiment,) = in_sqlite(run.parents[1] / "mlflow.db", "SELECT name FROM experiments WHERE name = 'uarm-rl'")
    assert experiment == ("uarm-rl",)
    assert ("agent.gamma", "0.9") in in_sqlite(run.parents[1] / "mlflow.db", "SELECT key, value FROM params")
    query = (
        "SELECT step, value FROM metrics WHERE key = 'critic_loss' AND step IN "
        "(SELECT step FROM metrics WHERE key = 'validation_success_rate') ORDER BY step"
    )
    return in_sqlite(run.parents[1] / "mlflow.db", query)


def in_trackio(run: Path) -> Curve:
    query = (
        "SELECT step, json_extract(metrics, '$.critic_loss') FROM metrics "
        "WHERE json_extract(metrics, '$.validation_success_rate') IS NOT NULL ORDER BY step"
    )
    return in_sqlite(run.parents[1] / "trackio" / "uarm-rl.db", query)


@pytest.mark.parametrize("read", [in_tensorboard, in_wandb, in_mlflow, in_trackio])
def test_a_tool_holds_what_the_log_holds_and_the_run_is_the_same(tmp_path, plain, read):
    name = read.__name__.removeprefix("in_")
    pytest.importorskip(name)
    run = train(tmp_path, name)
    expected = curve(run)
    assert len(expected) == 2
    assert read(run) == [(step, pytest.approx(value, rel=1e-6)) for step, value in expected]
    for file in ("config.yaml", "policy.safetensors"):
        assert (run / file).read_bytes() == (plain / file).read_bytes()
    assert curve(run) == curve(plain)


def test_a_link_in_the_place_of_a_log_is_refused(tmp_path):
    pytest.importorskip("tensorboard")
    (tmp_path / RUN).mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / RUN / "tensorboard").symlink_to(tmp_path / "elsewhere")
    words = ("train", *FAST, "logger=tensorboard", "simulate_beside=false", "resume=true")
    done = uarm_rl(*words, cwd=tmp_path)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (
        1,
        f"error: {RUN}/tensorboard is a link; remove it, or leave logger= out",
    )
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_what_a_logger_cannot_use_is_said_before_anything_is_done(tmp_path):
    for words, part in (
        (("logger=wandb", "logger.mode=loud"), "logger.mode must be offline or online, got 'loud'"),
        (("logger=mlflow", "logger.uri=''"), "logger.uri must be a text"),
        (("logger=paper",), "there is no logger=paper; logger is one of csv, mlflow, tensorboard, trackio, wandb"),
    ):
        done = uarm_rl("train", *words, cwd=tmp_path)
        assert (done.returncode, part in done.stderr) == (2, True), done.stderr
    assert list(tmp_path.iterdir()) == []
