"""How much imperfection the trials on an arm bear: camera error, play, latency, an object of another height; emulated.

    python benchmarks/error_budget.py [--policy default] [--arms 5] [--trials 10]

Every point is ``arms`` emulated arms, each with errors of its own drawn from ``conf/realism``, times ``trials`` trials
of ``run-real``'s own loop, in virtual time; all other imperfections stay at ``realism=default``. Writes
``benchmarks/error_budget.csv`` and a picture for each sweep to ``docs/``. It says nothing of a real arm.
"""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy

import argparse
import logging
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Final, NamedTuple

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


class Sweep(NamedTuple):
    """An imperfection: its axis and values, the default among them, and what a value sets."""

    label: str
    values: tuple[float, ...]
    realism: Callable[[float], dict[str, float]] = lambda _: {}
    told_too_high_m: Callable[[float], float] = lambda _: 0.0  # the object is as high as ever, and said to be higher


SWEEPS: Final = {
    "camera": Sweep(
        "Mount error of the camera (1: 0.6 mm and 0.3° per axis)",
        (0.0, 1.0, 2.0, 4.0, 6.0),
        lambda x: {"mount_offset_mm": 0.6 * x, "mount_tilt_deg": 0.3 * x},
    ),
    "backlash": Sweep("Play in each joint (degrees, default 0.2)", (0.0, 0.2, 0.5, 1.0, 2.0), lambda x: {"backlash_deg": x}),
    "latency": Sweep(
        "Latency of every answer (ms, default 4)",
        (0.0, 4.0, 20.0, 50.0, 100.0),
        lambda x: {"serial_latency_s": x / 1000.0},
    ),
    "height": Sweep(
        "Height of the object told too great by (mm)",
        (-5.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 5.0),
        told_too_high_m=lambda x: x / 1000.0,
    ),
}


def trials_of(name: str, count: int, point: tuple[str, float, int]) -> list[dict[str, object]]:
    """The rows of ``count`` trials on one emulated arm; an arm or camera that gives up has failed the rest."""
    sweep, value, seed = point
    settings = configuration.compose("emulate", (f"seed={seed}",))
    realism = settings["realism"] | SWEEPS[sweep].realism(value)
    kept = {key: setting for key, setting in settings.items() if key not in ("results_dir", "speed")}
    policy = arm_settings.load_policy(name)
    rows: list[dict[str, object]] = []
    with Workplace(**kept | {"realism": realism}) as place:
        try:
            told = workers(place, policy, SWEEPS[sweep].told_too_high_m(value))
            for trial in run_trials(*told, scattered(np.random.default_rng(seed)), trials=count):
                rows.append({name: trial.row[name] for name in ("success", "reason", "pull_ups")})
        except ArmError as error:
            rows += [{"success": False, "reason": str(error), "pull_ups": 0}] * (count - len(rows))
        hurt = {"lost_deg": max(map(abs, place.world.lost_deg)), "hard_presses": place.world.hard_presses}
    rows[0] |= hurt  # of all of the arm's trials
    return [{"sweep": sweep, "value": value, "arm": seed, **row} for row in rows]


def workers(place: Workplace, policy: ActorPolicy, told_too_high_m: float) -> tuple[SwiftArm, ActorPolicy, CameraSearch, Task]:
    """The arm, policy, search and task of ``run-real``, as configured by default, on ports in memory."""
    settings, card = configuration.compose("run-real", ()), policy.card
    length, width, height = settings["object_size_m"]
    size_m = arm_settings.object_size([length, width, height + told_too_high_m])
    eye, hand = MemoryPort(place.camera), MemoryPort(place.firmware)
    search = CameraSearch(
        OpenMVCamera(eye, clock=eye.clock),
        configuration.build("detector", settings["detector"]),
        nominal(),
        object_size_m=size_m,
        whole_object=True,
    )
    link, limits = Link(hand, "the emulator", clock=hand.clock), arm_settings.limits(settings["limits"])
    arm = SwiftArm(link, limits=limits, feed=arm_settings.feed(card, None), control_hz=card.control_hz)
    return arm, policy, search, arm_settings.task_of(card, settings | {"object_size_m": size_m})


def draw(figure: Figure, points: pd.DataFrame, label: str) -> None:
    """Success with Wilson's interval against one imperfection."""
    axes = figure.subplots()
    rate = 100 * points["success_rate"]
    spread = [rate - 100 * points["ci_low"], 100 * points["ci_high"] - rate]
    axes.errorbar(points["value"], rate, spread, color="#009E73", marker="o", markersize=3, capsize=2)
    axes.set(xlabel=label, ylabel="Held after the lift (%), emulated", ylim=(-3, 103))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default=arm_settings.DEFAULT_POLICY, help="a policy for the arm")
    parser.add_argument("--arms", type=int, default=5, help="emulated arms for each point")
    parser.add_argument("--trials", type=int, default=10, help="trials on each arm")
    arguments = parser.parse_args()
    logging.disable(logging.ERROR)
    points = [(sweep, value, seed) for sweep in SWEEPS for value in SWEEPS[sweep].values for seed in range(arguments.arms)]
    work = partial(trials_of, arguments.policy, arguments.trials)
    with ProcessPoolExecutor(cores(), get_context("spawn")) as pool:
        rows = [row for rows in shown(pool.map(work, points), len(points), "arm", "arms") for row in rows]
    table = (
        pd.DataFrame(rows)
        .groupby(["sweep", "value"], sort=False)
        .agg(
            trials=("success", "size"),
            held=("success", "sum"),
            pull_ups=("pull_ups", "sum"),
            most_lost_deg=("lost_deg", "max"),
            hard_presses=("hard_presses", "sum"),
        )
    )
    table = table.reset_index()
    table["success_rate"] = table["held"] / table["trials"]
    intervals = [statistics.wilson_interval(int(row.held), int(row.trials)) for row in table.itertuples()]
    table["ci_low"], table["ci_high"] = zip(*intervals, strict=True)
    files.replace(HERE / "error_budget.csv", tables.csv(table))
    print(table.to_string(index=False))
    for sweep, (label, *_) in SWEEPS.items():
        one = table[table["sweep"] == sweep]
        picture = figures.picture(partial(draw, points=one, label=label), label, 2.4).png
        files.replace(HERE.parent / "docs" / f"error_budget_{sweep}.png", picture)


if __name__ == "__main__":
    main()
