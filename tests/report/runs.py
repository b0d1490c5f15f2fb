"""Runs as the report reads them: small evaluations and logs in folders of their own."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from uarm_rl.configuration import compose

CONDITIONS = {"tolerance_m": "0.005", "hold": "fixed(1)", "control_hz": "20", "servo_rise_s": "0.327", "sigma": "-5"}
NAMES = {"A": "adaptive-plain", "B": "uniform-plain", "C": "adaptive-penalty", "D": "uniform-penalty"}


def write(path: Path, rows: list[dict[str, object]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def add_evaluation(
    results: Path, name: str, seed: int, successes: str, file: str = "evaluation.csv", moved_m: float = 0.001, **conditions: str
) -> None:
    """An evaluation with one position for each digit of ``successes``; ``old=""`` leaves the conditions out."""
    known = {} if "old" in conditions else CONDITIONS | conditions
    measured = {"time_s": 2, "object_displacement_m": moved_m, "reversals_per_s": 0.25, "rms_jerk": 12.5}
    rows = [
        {"position": position, "success": success, "return": -1 - seed, "common_return": -2.5, **measured}
        | {"tip_travel_last_s_m": 0.0125, **known}
        for position, success in enumerate(successes)
    ]
    write(results / NAMES.get(name, name) / f"seed{seed}" / file, rows)


def add_progress(results: Path, name: str, seed: int, *rates: str, steps_per_decision: float = 1, missing: int = 0) -> None:
    """A log with one episode of 200 experiences, but for ``missing``, for each validation success rate, empty for none."""
    rows = [
        {"episode": episode, "experiences": 200 * episode - missing, "control_steps": 400 * steps_per_decision * episode}
        | {"updates": 200 * episode - 100, "decisions": 400 * episode, "episode_return": -episode}
        | {"validation_success_rate": rate, "successes": 1, "object_losses": 0, "object_moved_m": 0.003}
        for episode, rate in enumerate(rates, start=1)
    ]
    write(results / NAMES.get(name, name) / f"seed{seed}" / "progress.csv", rows)


def lines(results: Path, name: str) -> list[str]:
    return (results / name).read_text().splitlines()


def remarks(text: str, start: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith(start)]


def add_study_run(results: Path, *words: str, successes: str = "11", **conditions: Any) -> None:
    """A run of a study below ``results/ablations``, in the folder that training gives it: two episodes, or three if long."""
    settings = compose("train", words)
    name, seed = settings["name"], settings["seed"]
    write_config(results / "ablations" / name / f"seed{seed}", settings)
    add_evaluation(results / "ablations", name, seed, successes, **conditions)
    steps = 11 if "uniform" not in name else 1
    rates = ("0.5", "0.75", "0.8")[: 3 if name.startswith("long") else 2]
    add_progress(results / "ablations", name, seed, *rates, steps_per_decision=steps)


def write_config(run: Path, settings: Mapping[str, Any]) -> None:
    run.mkdir(parents=True, exist_ok=True)
    (run / "config.yaml").write_text(yaml.safe_dump(dict(settings)))


def add_ablations(results: Path) -> None:
    steady, ten = {"hold": "until_steady(2..40)"}, "servo.natural_frequency_rad_s=10"
    add_study_run(results, "experiment=halves", "buffer=uniform", successes="0001")
    add_study_run(results, "experiment=halves", "buffer=unstuck_only", successes="0011")
    add_study_run(results, "experiment=halves", "buffer=steady_only", successes="0111", **steady)
    add_study_run(results, "experiment=halves", successes="1111", **steady)
    add_study_run(results, "experiment=fixed_hold", "buffer=fixed_hold", successes="1101", hold="fixed(11)")
    for experiment, buffer, successes in (
        ("servo", "uniform", "0111"),
        ("servo", "adaptive", "1111"),
        ("long_servo", "uniform", "1111"),
    ):
        add_study_run(results, f"experiment={experiment}", f"buffer={buffer}", ten, successes=successes, servo_rise_s="0.163")
    for buffer in ("uniform", "adaptive"):
        words = ("experiment=instant", "servo=instant", f"buffer={buffer}")
        add_study_run(results, *words, successes="1111", servo_rise_s="0.039")
    add_study_run(results, "experiment=A", successes="1111", sigma="0")
    add_study_run(results, "experiment=sigma", "reward.sigma=-20", successes="1110", sigma="-20", moved_m=0.0005)
    add_study_run(results, "experiment=dwell", "buffer=uniform", "dwell_s=0.25", successes="0011")
    add_study_run(results, "experiment=dwell", "dwell_s=0.25", successes="1111")
    add_study_run(results, "experiment=gamma", "buffer=uniform", "agent.gamma=0.99", successes="1011")


def add_settled(results: Path, name: str, seed: int, *distances_mm: float | None, validation: bool = False) -> None:
    """A test that success did not end, with a position for each settled distance; ``None``: the object was lost before."""
    path = results / NAMES.get(name, name) / f"seed{seed}" / ("settled-validation.csv" if validation else "settled.csv")
    add_evaluation(results, name, seed, "0" * len(distances_mm), path.name)
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    settled = ["" if distance is None else f"{distance / 1000:g}" for distance in distances_mm]
    write(path, [{**row, "settled_distance_m": distance} for row, distance in zip(rows, settled, strict=True)])
