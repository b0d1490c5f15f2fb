"""Runs that survive anything, proved: kill trainings at random instants, fail every call of a save, flip every bit.

    python -m tests.torture [--only kills files cluster hostile] [--trials 300] [--out FILE]     (or: make torture)

Prints a table and exits with 1 if anything differed from what was promised. Every harness
has a control: a deliberately broken variant that it must catch, or it proves nothing. Trainings are forked from one
process that has loaded everything, so that a trial takes a second; what is killed is a process all the same.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import itertools
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np

from tests import cluster, hostile_arm
from tests.disks import counted_calls, damaged_checkpoint, damaged_policy, failing_saves, full_disks, trusting
from tests.hostile import play as hostile
from uarm_rl import configuration, files
from uarm_rl.commands import train as commands_train
from uarm_rl.csvfile import write_rows
from uarm_rl.learn import checkpoint
from uarm_rl.learn.learner import Learner
from uarm_rl.learn.noise import OrnsteinUhlenbeck

#: Two seconds of training: a checkpoint after every second episode, a ring that wraps around.
TOY = (
    "episodes=6",
    "experiences_per_episode=20",
    "max_decisions_per_episode=80",
    "warmup_experiences=20",
    "batch_size=8",
    "agent.hidden=[16,16]",
    "buffer.capacity=70",
    "validate_every=3",
    "checkpoint_every=2",
    "time_limit_s=0.2",
    "simulate_beside=false",
    "resume=true",
)
METHODS = ("A", "B", "C", "D")


class Row(NamedTuple):
    """One line of the table."""

    what: str
    trials: int
    failures: int
    bound: str  # upper end of the 95 % interval of the failure rate, where trials are random
    control: str


def bound(trials: int, failures: int) -> str:
    """The rate that so many random trials without a failure exclude with 95 % confidence."""
    return f"< {100.0 * (1.0 - 0.05 ** (1.0 / trials)):.2g} %" if trials and not failures else ""


# Trainings, and their end


def fork(work: Callable[[], object]) -> int:
    """Run ``work`` in a child process, silently; its process id."""
    if child := os.fork():
        return child
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    try:
        work()
    except SystemExit as stop:
        os._exit(stop.code if isinstance(stop.code, int) else 1)
    except BaseException:
        os._exit(70)
    os._exit(0)


def outcome(run: Path) -> str:
    """One hash of what must be identical: policy, configuration, and progress without the wall time."""
    with open(run / files.PROGRESS, newline="") as file:
        rows = [{key: value for key, value in row.items() if key != "wall_s"} for row in csv.DictReader(file)]
    parts = [(run / files.POLICY).read_bytes(), (run / files.CONFIG).read_bytes(), repr(rows).encode()]
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def settings_of(method: str, folder: Path) -> tuple[dict, Path]:
    settings = configuration.compose("train", (f"experiment={method}", *TOY, f"results_dir={folder}"))
    return settings, folder / settings["name"] / "seed0"


def finish(settings: dict) -> bool:
    """Resume until the end, in a process of its own; true if it got there."""
    return os.waitpid(fork(lambda: commands_train.run(settings)), 0)[1] == 0


def kill_after(settings: dict, delay_s: float, signum: signal.Signals = signal.SIGKILL) -> None:
    child = fork(lambda: commands_train.run(settings))
    time.sleep(delay_s)
    os.kill(child, signum)
    os.waitpid(child, 0)


def kill_inside_save(settings: dict, at: int) -> None:
    """Train, and die at the ``at``-th committing call; not on the way out, but in the middle of it."""

    def work() -> None:
        with counted_calls(at, lambda: os.kill(os.getpid(), signal.SIGKILL)):
            commands_train.run(settings)

    os.waitpid(fork(work), 0)


Kill = Callable[[dict, np.random.Generator, float], None]


def at_any_instant(settings: dict, generator: np.random.Generator, duration_s: float) -> None:
    kill_after(settings, generator.uniform(0.0, duration_s))


def inside_a_save(settings: dict, generator: np.random.Generator, duration_s: float) -> None:
    kill_inside_save(settings, int(generator.integers(1, 43)))


def by_a_signal(settings: dict, generator: np.random.Generator, duration_s: float) -> None:
    """Ctrl-C or SIGTERM, which the training answers itself."""
    signum = (signal.SIGINT, signal.SIGTERM)[generator.integers(2)]
    kill_after(settings, generator.uniform(0.0, duration_s), signum)


def uninterrupted(folder: Path) -> tuple[dict[str, str], float]:
    """Outcome of each method's run that nobody kills, and how long the longest took (s)."""
    expected, duration_s = {}, 0.0
    for method in METHODS:
        settings, run = settings_of(method, folder / method)
        begin = time.perf_counter()
        assert finish(settings), f"the uninterrupted run of {method} failed"
        duration_s = max(duration_s, time.perf_counter() - begin)
        expected[method] = outcome(run)
    return expected, duration_s


def kills(
    trials: int, generator: np.random.Generator, folder: Path, kill: Kill, expected: dict[str, str], duration_s: float
) -> tuple[int, int]:
    """Kill each of ``trials`` runs one to three times and let it finish; (kills, runs that end differently)."""
    seeds = generator.integers(2**63, size=trials).tolist()
    tasks = [
        (folder / f"trial{n}", method, seed, duration_s, kill)
        for n, (method, seed) in enumerate(zip(itertools.cycle(METHODS), seeds, strict=False))
    ]
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), multiprocessing.get_context("fork")) as pool:
        results = list(pool.map(kill_and_finish, tasks))
    return sum(kills for kills, _, _ in results), sum(outcome != expected[method] for _, method, outcome in results)


def kill_and_finish(task: tuple[Path, str, int, float, Kill]) -> tuple[int, str, str]:
    """One trial: kill a run one to three times, then let it finish; (kills, method, outcome)."""
    folder, method, seed, duration_s, kill = task
    generator = np.random.default_rng(seed)
    settings, run = settings_of(method, folder)
    kills = int(generator.integers(1, 4))
    for _ in range(kills):
        kill(settings, generator, duration_s)
    ended = outcome(run) if finish(settings) else "did not finish"
    shutil.rmtree(folder)
    return kills, method, ended


# Controls: what each harness must catch


def forgetting_the_noise() -> mock._patch:
    """A resume that does not restore the noise's generator."""
    return mock.patch.object(OrnsteinUhlenbeck, "restore", return_value=None)


def saving_in_place() -> mock._patch:
    """A save that writes where it reads: the checkpoint's final folder, emptied first, without a manifest to check."""

    def broken(run_dir, saved):
        _, arrays, state = saved
        folder = run_dir / "checkpoint-000000"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        parts = {"arrays.safetensors": checkpoint.save(arrays), "state.json": checkpoint.json.dumps(state).encode()}
        hashes = {name: hashlib.sha256(data).hexdigest() for name, data in parts.items()}
        for name, data in (parts | {"manifest.json": checkpoint.json.dumps(hashes).encode()}).items():
            files.write_and_flush(folder / name, data)

    return mock.patch.object(checkpoint, "write", broken)


def saving_the_present() -> mock._patch:
    """A stop that saves the weights as they are in the middle of an episode, not as they were at its beginning."""

    snapshot = Learner.snapshot

    def broken(learner, next_experiences):
        before = snapshot(learner, next_experiences)
        present = {f"agent/{name}": tensor.numpy() for name, tensor in learner.agent.tensors().items()}
        return lambda: before()._replace(arrays=before().arrays | present)

    return mock.patch.object(Learner, "snapshot", broken)


def surroundings(folder: Path, most: int, expected: str) -> tuple[int, int]:
    """The same run in processes with another hash seed, working folder, locale, time zone; (runs, that differ)."""
    different = 0
    changes = (
        *({"PYTHONHASHSEED": seed} for seed in ("0", "1", "4294967295")),
        *({"LC_ALL": locale, "LANG": locale} for locale in ("C", "C.UTF-8", "POSIX", "de_DE.UTF-8", "tr_TR.UTF-8")),
        {"TZ": "Pacific/Kiritimati"},
        {"PYTHONOPTIMIZE": "1"},
        {"COLUMNS": "20", "TERM": "dumb"},
    )[:most]
    for number, change in enumerate(changes):
        elsewhere = folder / f"folder {number}"
        elsewhere.mkdir(parents=True)
        words = ["train", "experiment=C", *TOY]
        subprocess.run(
            [sys.executable, "-m", "uarm_rl.cli", *words],
            cwd=elsewhere,
            env={**os.environ, **change},
            capture_output=True,
            check=True,
        )
        different += outcome(elsewhere / "results" / "adaptive-penalty" / "seed0") != expected
    return len(changes), different


def killed_runs(trials: int, controls: int, seed: int, folder: Path) -> Iterator[Row]:
    generator = np.random.default_rng(seed)
    expected, duration_s = uninterrupted(folder / "uninterrupted")
    for title, count, kill, control in (
        ("runs killed at a random instant, resumed", trials - trials // 3, at_any_instant, forgetting_the_noise),
        ("runs killed inside a save, resumed", trials // 3, inside_a_save, saving_in_place),
        ("runs stopped by Ctrl-C or SIGTERM, resumed", trials // 3, by_a_signal, saving_the_present),
    ):
        killed, different = kills(count, generator, folder / control.__name__, kill, expected, duration_s)
        with control():
            _, caught = kills(controls, generator, folder / f"{control.__name__}-control", kill, expected, duration_s)
        words = f"{control.__name__.replace('_', ' ')}: {caught} of {controls} differ" if controls else "not run"
        if controls and not caught:
            words = f"NOT CAUGHT: {words}"
        yield Row(f"{title} ({killed} kills)", count, different, bound(count, different), words)
    yield Row("runs in other surroundings", *surroundings(folder / "surroundings", trials // 3, expected["C"]), "", "")


def files_and_disks(folder: Path) -> Iterator[Row]:
    (folder / "saves").mkdir()
    yield Row("saves with one call that fails", *failing_saves(folder / "saves"), "exhaustive", "")
    (folder / "full").mkdir()
    yield Row("saves on a disk that is full after n bytes", *full_disks(folder / "full"), "exhaustive", "")
    for name, harness in (("checkpoint", damaged_checkpoint), ("policy", damaged_policy)):
        (folder / name).mkdir()
        done, taken = harness(folder / name)
        words = ""
        if name == "checkpoint":
            (folder / "trusting").mkdir()
            with trusting():
                caught = harness(folder / "trusting")[1]
            words = f"trusting: {caught} taken" if caught else "NOT CAUGHT: trusting"
        yield Row(f"damaged {name} files, every bit and length", done, taken, "exhaustive", words)


def many_machines(folder: Path, seed: int) -> Iterator[Row]:
    """24 runs on queues and machines that come and go."""
    words = ("experiment=A,B,C,D", "seed=0,1,2,3,4,5", *TOY)
    expected = {}
    for method, number in itertools.product(METHODS, range(6)):
        settings = configuration.compose(
            "train", (f"experiment={method}", *TOY, f"seed={number}", f"results_dir={folder / 'alone'}")
        )
        assert finish(settings)
        name = f"{settings['name']}/seed{number}"
        expected[name] = outcome(folder / "alone" / name)
    for what, trials, failures, control in cluster.rows(folder / "many", words, expected, outcome, seed):
        yield Row(what, trials, failures, bound(trials, failures), control)


def hostile_input() -> Iterator[Row]:
    """Files, configurations, joint commands and answers of an arm that mean harm."""
    for row, cases, failed, control in hostile.rows():
        print(*failed, sep="\n", end="\n" * bool(failed))
        yield Row(row, cases, len(failed), "a list", control)
    tried, unsafe = hostile_arm.references(1_000_000)
    with hostile_arm.blind(), hostile_arm.silence():
        seen = hostile_arm.references(1000)[1]
    control = f"{'' if seen else 'NOT CAUGHT: '}not looking where the cup goes: {seen} of 1000 seen"
    yield Row("hostile joint commands, judged on the wire", tried, unsafe, bound(tried, unsafe), control)
    tried, broken = hostile_arm.streams(10_000)
    yield Row("arms that answer nonsense, or nothing", tried, broken, bound(tried, broken), "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=300, help="runs that are killed, a third of them inside a save")
    parser.add_argument("--controls", type=int, default=16, help="runs of each broken variant")
    parts = ("kills", "files", "cluster", "hostile")
    parser.add_argument("--only", nargs="+", choices=parts, default=parts, help="parts of the table")
    parser.add_argument("--seed", type=int, default=0, help="of the instants")
    parser.add_argument("--sim", default="auto", help="engine of the trainings: auto, pybullet or mujoco")
    parser.add_argument("--out", type=Path, help="CSV file for the table")
    arguments = parser.parse_args()
    global TOY  # the children are forks
    TOY = (*TOY, f"sim={arguments.sim}")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        lines = {
            "kills": killed_runs(arguments.trials, arguments.controls, arguments.seed, Path(folder)),
            "files": files_and_disks(Path(folder)),
            "cluster": many_machines(Path(folder), arguments.seed),
            "hostile": hostile_input(),
        }
        for row in itertools.chain.from_iterable(lines[part] for part in arguments.only):
            rows.append(row)
            print(f"{row.what:58} {row.trials:6} trials  {row.failures:3} failures  {row.bound:12} {row.control}", flush=True)
    if arguments.out:
        write_rows(arguments.out, Row._fields, [row._asdict() for row in rows])
    sys.exit(any(row.failures or row.control.startswith("NOT") for row in rows))


if __name__ == "__main__":
    main()
