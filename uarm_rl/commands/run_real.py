"""Trials of a policy on the real arm.

Examples:
  uarm-rl run-real --dry-run --trials 1               show and audit every command, without an arm
  uarm-rl run-real --target 0.2 0 0.03 --policy ik    without a camera: the object lies where you say
  uarm-rl run-real --port /dev/ttyACM0 --trials 50    the default policy, the object found with the camera
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import yaml

from uarm_rl import checks
from uarm_rl.checks import UsageError
from uarm_rl.commands.arm_settings import open_camera
from uarm_rl.configuration import Settings, build, compose, policy_card
from uarm_rl.real import session
from uarm_rl.real.trials import GivenTarget, RandomTargets, Search, Task
from uarm_rl.task.policy import InverseKinematicsPolicy, Policy, PolicyCard


def run(settings: Settings) -> None:
    """Trials of a policy on the real arm."""

    dry_run = checks.boolean("dry_run", settings["dry_run"])
    size_m = session.object_size(settings["object_size_m"])
    limits = session.limits(settings["limits"])
    policy, card, folder = _policy_for_the_arm(settings)
    for warning in session.check_policy(card, limits.max_step_rad):
        print(f"warning: {warning}", file=sys.stderr)
    task = Task(
        hold=build("hold", card.hold),
        **{key: getattr(card, key) for key in ("control_hz", "max_delta_rad", "tolerance_m", "dwell_s")},
        **{key: settings[key] for key in ("time_limit_s", "press_m", "max_press_m")},
    )
    session.check_press(size_m[2], task.max_press_m, limits)
    target = None if settings["target"] is None else session.target(settings["target"], task.max_press_m, limits)
    generator = np.random.default_rng(checks.integer("seed", settings["seed"], low=0))
    arm_settings = {"limits": limits, "feed": session.feed(card, settings["feed"]), "control_hz": card.control_hz}

    def open_search(stack: ExitStack) -> Search:
        if target is not None:
            return GivenTarget(target)
        if dry_run and settings["camera"]["name"] != "file":
            return RandomTargets(generator, size_m[2])
        return _camera_search(settings, stack, size_m)

    session.run_trials_and_record(
        policy,
        task,
        open_search,
        partial(session.rehearse, print, **arm_settings)
        if dry_run
        else partial(session.connect, settings["port"], speed=settings["speed"], **arm_settings),
        None if target is not None else session.scattered(generator),
        trials=checks.integer("trials", settings["trials"], low=1),
        folder=None if dry_run else Path(settings["out"] or folder / "real"),
        overwrite=checks.boolean("overwrite", settings["overwrite"]),
        config=yaml.safe_dump(settings, sort_keys=False),
        say=partial(print, flush=True),
    )


def _policy_for_the_arm(settings: Settings) -> tuple[Policy, PolicyCard, Path]:
    """The policy, its card, and the folder whose ``real/`` takes its results."""
    if settings["policy"] == "ik":
        card = policy_card(compose("train", ("experiment=real_arm",)))
        return InverseKinematicsPolicy(card.max_delta_rad), card, Path(settings["results_dir"]) / "ik" / "seed0"
    path = Path(str(settings["policy"]))
    policy = session.load_policy(path)
    return policy, policy.card, path if path.is_dir() else path.parent


def _camera_search(settings: Settings, stack: ExitStack, size_m: tuple[float, float, float]) -> Search:
    """The search with the configured camera, which ``stack`` closes."""
    if settings["camera"]["name"] == "none":
        raise UsageError("without a camera the object has to be told: give --target X Y Z (metres), or choose a camera")
    emulated = settings["port"] is not None and session.is_emulated(settings["port"])
    detector = build("detector", settings["detector"])
    return session.camera_search(
        stack.enter_context(open_camera(settings)),
        detector,
        Path(settings["calibration"]),
        emulated=emulated,
        object_size_m=size_m,
        whole_object=settings["detector"]["name"] == "colour",
    )
