"""Trials of a policy on the real arm.

Examples:
  uarm-rl run-real --dry-run --trials 1               show and audit every command, without an arm
  uarm-rl run-real --target 0.2 0 0.03 --policy ik    without a camera: the object lies where you say
  uarm-rl run-real --port /dev/ttyACM0 --trials 50    the default policy, the object found with the camera
"""

from __future__ import annotations

import logging
import re
import shlex
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from uarm_rl import checks, signals
from uarm_rl.checks import UsageError
from uarm_rl.commands.arm_settings import (
    DEFAULT_POLICY,
    check_policy,
    check_press,
    feed,
    limits,
    load_policy,
    object_size,
    open_camera,
    speed,
    target,
    task_of,
)
from uarm_rl.configuration import Settings, build, compose
from uarm_rl.emulator.firmware import PARKED_DEG, Firmware
from uarm_rl.emulator.memory_port import MemoryPort
from uarm_rl.emulator.motion import KinematicJoints
from uarm_rl.files import CONFIG
from uarm_rl.real import gcode, session
from uarm_rl.real.link import Link
from uarm_rl.real.live import LiveFile, Watched
from uarm_rl.real.ports import ARM, is_emulated, named_port
from uarm_rl.real.swift_arm import SwiftArm
from uarm_rl.real.trials import GivenTarget, ObjectNotFoundError, RandomTargets, Row, Search, run_trials, scattered
from uarm_rl.report.statistics import wilson_interval
from uarm_rl.task import kinematics
from uarm_rl.task.policy import InverseKinematicsPolicy, Policy, PolicyCard
from uarm_rl.trained import merged, policy_card, read_yaml

log = logging.getLogger(__name__)

#: What a series may be continued with and be the same series.
_INCIDENTAL: Final = ("port", "speed", "trials", "resume", "overwrite", "out", "results_dir", "watch")
_MOVE: Final = re.compile(r"G2206 B(\S+) L(\S+) R(\S+) F(\S+)")


def run(settings: Settings) -> None:
    """Trials of a policy on the real arm.

    The port is looked for first, then the camera opened and looked through, then the arm: what is wrong shows before anything
    moves. Whatever happens, the arm is put to rest first, then the camera closed, then the results so far summed up.
    """
    dry_run = checks.boolean("dry_run", settings["dry_run"])
    watch = checks.boolean("watch", settings["watch"])
    trials = checks.integer("trials", settings["trials"], low=1)
    size_m = object_size(settings["object_size_m"])
    within = limits(settings["limits"], settings["obstacle"])
    policy, card, home = _policy_for_the_arm(settings)
    for warning in check_policy(card, within.max_step_rad):
        print(f"warning: {warning}", file=sys.stderr)
    task = task_of(card, settings)
    check_press(size_m[2], task.max_press_m, within)
    told = None if settings["target"] is None else target(settings["target"], task.max_press_m, within)
    arm_settings = {"limits": within, "feed": feed(card, settings["feed"]), "control_hz": card.control_hz}
    emulator_speed = speed(settings["speed"])
    folder = home / "real" if settings["out"] is None else checks.path("out", settings["out"])
    rows = [] if dry_run else _begun(folder, settings)
    if len(rows) >= trials:
        print(f"{_summary(rows)}; {folder}")
        return
    seed = checks.integer("seed", settings["seed"], low=0)
    generator = np.random.default_rng([seed, len(rows)] if rows else seed)  # a series goes on at other places
    port = None if dry_run else named_port(ARM, settings["port"])
    done = len(rows)
    try:
        with ExitStack() as stack:
            stack.enter_context(signals.interrupt_once())
            live = _live(stack, folder, port, settings, size_m) if watch and not dry_run else None
            search: Search
            if told is not None:
                search = GivenTarget(told)
            elif dry_run and settings["camera"]["name"] != "file":
                search = RandomTargets(generator, size_m[2])
            else:
                search = _camera_search(settings, stack, size_m, live)
            arm = rehearse(print, **arm_settings) if dry_run else session.connect(port, speed=emulator_speed, **arm_settings)
            stack.enter_context(arm)
            if live is not None:
                arm.on_state = live.moved
            put_down = None if told is not None else scattered(generator, within.carrying(size_m))
            results = run_trials(arm, policy, search, task, put_down, trials=trials, first=done + 1)
            if dry_run:  # whose commands stand between the rows
                for trial in results:
                    print(f"{_HEADER}\n{_line(trial.row)}", flush=True)
            else:
                emulated = is_emulated(arm.port)
                config = settings | {"connected": {"port": arm.port, "emulated": emulated}}
                text = yaml.safe_dump(config, sort_keys=False)
                print(_HEADER, flush=True)
                for row in session.record(results, folder, text, emulated=emulated, keep_rows=done):
                    print(_line(row), flush=True)
                    rows.append(row)
                    if live is not None:
                        live.tried(_line(row))
    finally:
        if len(rows) > done:
            print(f"{_summary(rows)}; {folder}", flush=True)
    if dry_run:
        print("dry run: nothing was sent; it pretends that the arm goes where it is told and that the cup always seals")
    elif not any("target_x_m" in row for row in rows[done:]):
        raise ObjectNotFoundError(rows[-1]["reason"])


def _begun(folder: Path, settings: Settings) -> list[Row]:
    """The trials of a series that is to be continued. Raises :class:`UsageError` if that is not what was asked for."""
    resume, overwrite = (checks.boolean(name, settings[name]) for name in ("resume", "overwrite"))
    if resume and overwrite:
        raise UsageError("resume=true continues a series and overwrite=true deletes it; give one of them")
    if overwrite or not (folder / session.TRIALS).exists():
        return []
    if not resume:
        raise UsageError(
            f"{folder} holds trials already; resume=true goes on with them, overwrite=true replaces them, "
            "out=FOLDER writes elsewhere"
        )
    before = merged(compose("run-real"), read_yaml(folder / CONFIG))  # it may be older than a setting
    same = {key: value for key, value in settings.items() if key not in _INCIDENTAL}
    if changed := checks.differences({key: before.get(key) for key in same}, same):
        raise UsageError(
            f"the trials in {folder} were made with {', '.join(changed)}; go on as they were begun, or name another out=FOLDER"
        )
    return session.recorded(folder)


def _policy_for_the_arm(settings: Settings) -> tuple[Policy, PolicyCard, Path]:
    """The policy, its card, and the folder whose ``real/`` takes its results."""
    if settings["policy"] == "ik":
        card = policy_card(compose("train", ("experiment=real_arm", "sim=pybullet")))
        return InverseKinematicsPolicy(card.max_delta_rad), card, Path(settings["results_dir"]) / "ik" / "seed0"
    policy = load_policy(settings["policy"])
    if settings["policy"] == DEFAULT_POLICY:
        return policy, policy.card, Path(settings["results_dir"]) / DEFAULT_POLICY
    path = Path(settings["policy"])
    return policy, policy.card, path if path.is_dir() else path.parent


def _live(stack: ExitStack, folder: Path, port: str | None, settings: Settings, size_m: tuple[float, float, float]) -> LiveFile:
    """The files for ``uarm-rl watch``, until everything else has been closed."""
    encode: Callable[[Any], bytes] | None = None
    if settings["target"] is None:  # and therefore a camera
        from uarm_rl.real.vision.camera import png

        encode = png
    print(f"watch it in another terminal: uarm-rl watch arm={shlex.quote(str(folder))}", flush=True)
    emulated = port is not None and is_emulated(port)
    return stack.enter_context(LiveFile(folder, emulated=emulated, object_size_m=size_m, encode=encode))


def _camera_search(
    settings: Settings, stack: ExitStack, size_m: tuple[float, float, float], live: LiveFile | None = None
) -> Search:
    """The search with the configured camera, which ``stack`` closes; its calibration must fit the pictures that it takes.

    An emulated camera without a file is taken to be mounted as drawn.
    """
    if settings["camera"]["name"] == "none":
        raise UsageError("without a camera the object has to be told: give --target X Y Z (metres), or choose a camera")
    from uarm_rl.real.search import CameraSearch
    from uarm_rl.real.vision.camera_model import Calibration, nominal

    detector, path = build("detector", settings["detector"]), checks.path("calibration", settings["calibration"])
    camera = stack.enter_context(open_camera(settings))
    if live is not None:
        camera = Watched(camera, live.looked)
    emulated = settings["port"] is not None and is_emulated(settings["port"])
    calibration = None if emulated and not path.exists() else Calibration.load(path)
    picture = camera.read()
    if calibration is None:
        log.warning("there is no %s; the emulated camera is taken to be mounted as drawn", path)
        calibration = nominal((picture.shape[1], picture.shape[0]))
    calibration.lens.check_size(picture)
    whole_object = settings["detector"]["name"] == "colour"
    return CameraSearch(camera, detector, calibration, object_size_m=size_m, whole_object=whole_object)


# The table


_HEADER: Final = " trial  target (mm)            result    time   distance  remark"


def _line(row: Row) -> str:
    """A trial as a line under ``_HEADER``."""
    place = "-"
    if "target_x_m" in row:
        place = "({:.1f}, {:.1f}, {:.1f})".format(*(1000.0 * row[f"target_{axis}_m"] for axis in "xyz"))
    time = f"{row['time_s']:5.1f} s" if "time_s" in row else "-"
    distance = f"{1000.0 * row['final_distance_m']:.1f} mm" if "final_distance_m" in row else "-"
    result = "held" if row["success"] else "failed"
    return f"{row['trial']:6}  {place:21}  {result:6}  {time:>7}  {distance:>9}  {row['reason']}".rstrip()


def _summary(rows: list[Row]) -> str:
    """How many objects were held after the lift, with Wilson's interval, and what that number is."""
    held = sum(bool(row["success"]) for row in rows)
    low, high = wilson_interval(held, len(rows))
    text = f"{held} of {len(rows)} held after the lift: {held / len(rows):.0%} (95 % interval {low:.0%} to {high:.0%}, Wilson)"
    return f"{text}; the arm was emulated, this is no result of a real one" if rows[0]["emulated"] else text


# The dry run


def rehearse(say: Callable[[str], None], **keywords: Any) -> SwiftArm:
    """An emulated arm, in memory, whose cup always seals: every command is audited, and told to ``say``.

    The keywords are those of ``SwiftArm``.
    """
    port = _Shown(say)
    return SwiftArm(Link(port, "the dry run", clock=port.clock), **keywords)


class _Shown(MemoryPort):
    """A port that says in plain words what is written to it."""

    def __init__(self, say: Callable[[str], None]) -> None:
        super().__init__(Firmware(joints=KinematicJoints(PARKED_DEG, sealed=True)))
        self._say = say

    def write(self, data: bytes) -> int:
        for line in data.decode("latin-1").splitlines():
            command = line.partition(" ")[2]
            if command:
                with suppress(BrokenPipeError):  # of the terminal, which is no fault of this port
                    self._say(f"would send: {command:44} {_meaning(command)}")
        return super().write(data)


def _meaning(command: str) -> str:
    if move := _MOVE.fullmatch(command):
        base, left, right, _ = map(float, move.groups())
        x, y, z = 1000.0 * kinematics.cup_position(kinematics.from_motor_deg(base, left, right))
        return f"cup to ({x:.1f}, {y:.1f}, {z:.1f}) mm"
    if command.startswith("M2231"):
        return "pump on" if command.endswith("1") else "pump off"
    return gcode.COMMANDS[command.split(" ")[0]].purpose
