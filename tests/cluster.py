"""Many runs on machines that come and go: each must end with the bytes of a run that nobody disturbed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from tests import slurm
from uarm_rl import locks
from uarm_rl.commands import status
from uarm_rl.files import HOLDER

ROUNDS = 12  # of the same command, until all runs are done
LIMIT_S = 900.0  # of a round
#: A resume that does not restore the noise's generator, in every process that has this as its `sitecustomize`.
FORGETFUL = "from uarm_rl.learn.noise import OrnsteinUhlenbeck\nOrnsteinUhlenbeck.restore = lambda self, state: None\n"

Outcome = Callable[[Path], str]


def command(*words: str, cwd: Path, environment: Mapping[str, str]) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "uarm_rl", *words], cwd=cwd, env={**os.environ, **environment}, capture_output=True, text=True
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done.stdout + done.stderr


def are_done(results: Path, runs: int) -> bool:
    found = list(status.statuses(results))
    return len(found) == runs and all(one.state == "done" for one in found)


def different(results: Path, expected: Mapping[str, str], outcome: Outcome) -> int:
    """How many runs did not end as they should, or did not end."""
    ends = {}
    for name in expected:
        with suppress(OSError):
            ends[name] = outcome(results / name)
    return sum(ends.get(name) != hashed for name, hashed in expected.items())


def on_a_queue(
    folder: Path, words: Sequence[str], expected: Mapping[str, str], outcome: Outcome, seed: int, *, control: bool = False
) -> tuple[int, int]:
    """Through `uarm-rl submit`, on a queue that kills, preempts, loses and delays; (what befell them, how many differ)."""
    generator, befell = np.random.default_rng(seed), 0
    folder.mkdir()
    results, environment = folder / "results", dict[str, str]()
    if control:
        (folder / "sitecustomize.py").write_text(FORGETFUL)
        environment["PYTHONPATH"] = os.pathsep.join([str(folder), str(Path(__file__).parents[1])])
    for number in range(ROUNDS):
        kinds = ("preempt",) if control else ("preempt", "kill", "die", "lose", "1", "0") if number < 4 else ("0",)
        plan = {task: str(generator.choice(kinds)) for task in range(len(expected))}
        environment |= slurm.install(folder / "slurm", plan, later_s=1.5)
        said = command("submit", *words, "cluster.at_once=3", f"results_dir={results}", cwd=folder, environment=environment)
        submitted = int(said.partition("submitted: ")[2].partition(" ")[0] or 0)
        befell += sum(what not in "01" for task, what in plan.items() if task < submitted)
        ends = time.monotonic() + LIMIT_S
        while not slurm.is_idle(folder / "slurm") and time.monotonic() < ends:
            time.sleep(0.2)
        if are_done(results, len(expected)):
            break
    return befell, different(results, expected, outcome)


def on_this_machine(
    folder: Path, words: Sequence[str], expected: Mapping[str, str], outcome: Outcome, seed: int
) -> tuple[int, int]:
    """Through submitit's processes of this machine, of which one after the other is preempted or killed; likewise."""
    generator, befell = np.random.default_rng(seed), 0
    folder.mkdir()
    results = folder / "results"
    for _ in range(ROUNDS):
        said = command(
            "submit", *words, "cluster.name=local", "cluster.at_once=2", f"results_dir={results}", cwd=folder, environment={}
        )
        ends = time.monotonic() + LIMIT_S
        while "submitted" in said and time.monotonic() < ends and not are_done(results, len(expected)):
            time.sleep(float(generator.uniform(0.5, 3.0)))
            holders = [
                note for path in sorted(results.rglob(HOLDER)) if (note := locks.read(path)) and locks.holder(path.parent)
            ]
            if holders and befell < 8:
                number = (signal.SIGUSR2, signal.SIGTERM, signal.SIGUSR1, signal.SIGKILL)[befell % 4]
                with suppress(ProcessLookupError):
                    os.kill(int(holders[int(generator.integers(len(holders)))].process), number)
                    befell += 1
            if all(one.state in ("done", "dead") for one in status.statuses(results)):
                break
        if are_done(results, len(expected)):
            break
    return befell, different(results, expected, outcome)


def on_ray(folder: Path, words: Sequence[str], expected: Mapping[str, str], outcome: Outcome, seed: int) -> tuple[int, int]:
    """Through Hydra's launcher of Ray, on two nodes of this machine, of which one is killed in the middle; likewise."""
    from ray.cluster_utils import Cluster

    folder.mkdir()
    results = folder / "results"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        other = cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        launch = ("hydra/launcher=ray", "hydra.launcher.ray.init.address=auto")
        environment = {**os.environ, "RAY_ADDRESS": cluster.address}
        with open(folder / "said", "w") as said:
            training = subprocess.Popen(
                [sys.executable, "-m", "uarm_rl", "train", "-m", *words, *launch],
                cwd=folder,
                env=environment,
                stdout=said,
                stderr=said,
            )
        while len(list(results.glob("*/*/policy.safetensors"))) < len(expected) // 3:
            assert training.poll() is None, (folder / "said").read_text()
            time.sleep(0.1)
        cluster.remove_node(other, allow_graceful=False)
        training.wait(LIMIT_S)
    finally:
        cluster.shutdown()
    return 1, different(results, expected, outcome)


def rows(folder: Path, words: Sequence[str], expected: Mapping[str, str], outcome: Outcome, seed: int) -> Iterator[tuple]:
    """What was tried, how often, how many differ, the control."""
    folder.mkdir()
    befell, wrong = on_a_queue(folder / "queue", words, expected, outcome, seed)
    one = [name for name in expected if name.startswith("adaptive-penalty")]
    few = ("experiment=C", *(word for word in words if not word.startswith("experiment=")))
    caught = on_a_queue(folder / "control", few, {name: expected[name] for name in one}, outcome, seed, control=True)[1]
    control = f"{'' if caught else 'NOT CAUGHT: '}forgetting the noise: {caught} of {len(one)} differ"
    yield f"runs on a queue that takes, kills and loses ({befell} times)", len(expected), wrong, control
    befell, wrong = on_this_machine(folder / "local", words, expected, outcome, seed)
    yield f"runs in processes that are preempted ({befell} times)", len(expected), wrong, ""
    if find_spec("ray"):
        befell, wrong = on_ray(folder / "ray", words, expected, outcome, seed)
        yield "runs on two nodes of Ray, one of them killed", len(expected), wrong, ""
