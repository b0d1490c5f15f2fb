"""How much imperfection the trials on an arm bear: success against camera error, backlash and latency, emulated.

    python benchmarks/error_budget.py [--policy results/real_arm/seed0] [--arms 5] [--trials 10]

Every point is ``arms`` emulated arms, each with errors of its own drawn from ``conf/realism``, times ``trials`` trials
of ``run-real``'s own loop, in virtual time; all other imperfections stay at ``realism=default``. Writes
``benchmarks/error_budget.csv`` and a picture for each sweep to ``docs/``. It says nothing of a real arm.
"""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy

import argparse
import logging
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from uarm_rl import configuration, files
from uarm_rl.commands import arm_settings
from uarm_rl.emulator.emulate import Workplace
from uarm_rl.emulator.memory_port import MemoryPort
from uarm_rl.progress import shown
from uarm_rl.real.link import Link
from uarm_rl.real.search import CameraSearch
from uarm_rl.real.swift_arm import SwiftArm
from uarm_rl.real.trials import Task, run_trials, scattered
from uarm_rl.real.vision.camera import OpenMVCamera
from uarm_rl.real.vision.camera_model import nominal
from uarm_rl.report import figures, statistics, tables
from uarm_rl.task.arm import ArmError
from uarm_rl.task.policy import ActorPolicy
from uarm_rl.workers import cores

HERE: Final = Path(__file__).parent

#: Sweep -> its axis, the values, and what of ``realism`` a value sets. The default is among the values.
SWEEPS: Final = {
    "camera": (
        "Mount error of the camera (1: 0.6 mm and 0.3° per axis)",
        (0.0, 1.0, 2.0, 4.0, 6.0),
        lambda x: {"mount_offset_mm": 0.6 * x, "mount_tilt_deg": 0.3 * x},
    ),
    "backlash": ("Play in each joint (degrees, default 0.2)", (0.0, 0.2, 0.5, 1.0, 2.0), lambda x: {"backlash_deg": x}),
    "latency": (
        "Latency of every answer (ms, default 4)",
        (0.0, 4.0, 20.0, 50.0, 100.0),
        lambda x: {"serial_latency_s": x / 1000.0},
    ),
}


def trials_of(path: Path, count: int, point: tuple[str, float, int]) -> list[dict[str, object]]:
    """The rows of ``count`` trials on one emulated arm; an arm or camera that gives up has failed the rest."""
    sweep, value, seed = point
    settings = configuration.compose("emulate", (f"seed={seed}",))
    realism = settings["realism"] | SWEEPS[sweep][2](value)
    kept = {key: setting for key, setting in settings.items() if key not in ("results_dir", "speed")}
    policy = arm_settings.load_policy(path)
    rows: list[dict[str, object]] = []
    with Workplace(**kept | {"realism": realism}) as place:
        try:
            for trial in run_trials(*workers(place, policy), scattered(np.random.default_rng(seed)), trials=count):
                rows.append({"success": trial.row["success"], "reason": trial.row["reason"]})
        except ArmError as error:
            rows += [{"success": False, "reason": str(error)}] * (count - len(rows))
    return [{"sweep": sweep, "value": value, "arm": seed, **row} for row in rows]


def workers(place: Workplace, policy: ActorPolicy) -> tuple[SwiftArm, ActorPolicy, CameraSearch, Task]:
    """The arm, policy, search and task of ``run-real``, as configured by default, on ports in memory."""
    settings, card = configuration.compose("run-real", ()), policy.card
    eye, hand = MemoryPort(place.camera), MemoryPort(place.firmware)
    search = CameraSearch(
        OpenMVCamera(eye, clock=eye.clock),
        configuration.build("detector", settings["detector"]),
        nominal(),
        object_size_m=arm_settings.object_size(settings["object_size_m"]),
        whole_object=True,
    )
    link, limits = Link(hand, "the emulator", clock=hand.clock), arm_settings.limits(settings["limits"])
    arm = SwiftArm(link, limits=limits, feed=arm_settings.feed(card, None), control_hz=card.control_hz)
    return arm, policy, search, arm_settings.task_of(card, settings)


def draw(figure: Figure, points: pd.DataFrame, label: str) -> None:
    """Success with Wilson's interval against one imperfection."""
    axes = figure.subplots()
    rate = 100 * points["success_rate"]
    spread = [rate - 100 * points["ci_low"], 100 * points["ci_high"] - rate]
    axes.errorbar(points["value"], rate, spread, color="#009E73", marker="o", markersize=3, capsize=2)
    axes.set(xlabel=label, ylabel="Held after the lift (%), emulated", ylim=(-3, 103))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, default=Path("results/real_arm/seed0"), help="a policy for the arm")
    parser.add_argument("--arms", type=int, default=5, help="emulated arms for each point")
    parser.add_argument("--trials", type=int, default=10, help="trials on each arm")
    arguments = parser.parse_args()
    logging.disable(logging.ERROR)
    points = [
        (sweep, value, seed) for sweep, (_, values, _) in SWEEPS.items() for value in values for seed in range(arguments.arms)
    ]
    work = partial(trials_of, arguments.policy, arguments.trials)
    with ProcessPoolExecutor(cores(), get_context("spawn")) as pool:
        rows = [row for rows in shown(pool.map(work, points), len(points), "arm", "arms") for row in rows]
    table = pd.DataFrame(rows).groupby(["sweep", "value"], sort=False)["success"].agg(trials="size", held="sum").reset_index()
    table["success_rate"] = table["held"] / table["trials"]
    intervals = [statistics.wilson_interval(int(row.held), int(row.trials)) for row in table.itertuples()]
    table["ci_low"], table["ci_high"] = zip(*intervals, strict=True)
    files.replace(HERE / "error_budget.csv", tables.csv(table))
    print(table.to_string(index=False))
    for sweep, (label, _, _) in SWEEPS.items():
        one = table[table["sweep"] == sweep]
        picture = figures.picture(partial(draw, points=one, label=label), 2.4)
        files.replace(HERE.parent / "docs" / f"error_budget_{sweep}.png", picture)


if __name__ == "__main__":
    main()
