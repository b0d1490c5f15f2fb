"""Sessions at the real arm: connecting, trials with their table and files, jogging. ``cli`` turns configuration into calls."""

from __future__ import annotations

import logging
import math
import os
import re
import signal
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import yaml

from uarm_rl import checks, columns, files
from uarm_rl.checks import UsageError
from uarm_rl.csvfile import Logbook
from uarm_rl.real import doctor
from uarm_rl.real.audit import Limits
from uarm_rl.real.doctor import Finding
from uarm_rl.real.dryrun import DryPort
from uarm_rl.real.link import Link, open_link
from uarm_rl.real.ports import ARM, PortError, find_port
from uarm_rl.real.swift_arm import SwiftArm
from uarm_rl.real.trials import ObjectNotFoundError, Row, Search, Task, Trial, out_of_reach, run_trials
from uarm_rl.report.statistics import wilson_interval
from uarm_rl.task import positions
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.policy import ActorPolicy, Policy, PolicyCard, PolicyFileError

if TYPE_CHECKING:
    from uarm_rl.real.vision.camera import Camera
    from uarm_rl.real.vision.detection import Detector

log = logging.getLogger(__name__)

Say = Callable[[str], None]

TRIALS: Final = "trials.csv"

_SIGNALS: Final = [signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
_PTY_MAJORS: Final = range(136, 144)  # Linux's numbers for the slaves of pseudo-terminals
_SEEN_FROM_M: Final = 0.16  # from the base's axis to what a camera ahead of the cup sees
_FEED: Final = 20.0
_JOG_DEG: Final = 10.0
_STRAY_DEG: Final = 0.5

#: What a joint does when its angle grows (degrees up), and when it falls.
_SIGNS: Final = {
    1: ("the arm turned to its left (counter-clockwise, seen from above)", "the arm turned to its right"),
    2: ("the lower arm leaned forward and the cup sank", "the lower arm leaned back and the cup rose"),
    3: ("the forearm and the cup sank", "the forearm and the cup rose"),
}


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Ctrl-C, SIGTERM and a closed terminal raise ``KeyboardInterrupt`` once; while the arm is put to rest more are ignored."""

    def stop(number: int, frame: FrameType | None) -> None:
        for one in _SIGNALS:
            signal.signal(one, lambda *again: None)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, stop) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def ask(text: str) -> str:
    """The user's answer to a question in the terminal. Raises :class:`UsageError` if nobody can answer."""
    try:
        return input(text)
    except EOFError:
        raise UsageError("the questions need somebody at a terminal to answer them; standard input has ended") from None


def is_emulated(port: str) -> bool:
    """Whether a port is a pseudo-terminal: then no real arm is behind it."""
    try:
        status = os.stat(port)
        return stat.S_ISCHR(status.st_mode) and os.major(status.st_rdev) in _PTY_MAJORS
    except (OSError, AttributeError):  # it will not open either; or this is Windows, which has no pseudo-terminals
        return False


def emulated_camera(port: str) -> str | None:
    """The camera's port beside an emulated arm's ``port``: the other pseudo-terminal of the process that is behind it.

    ``None`` if that cannot be told, as when the process has several.
    """
    index = os.path.basename(os.path.realpath(port))
    for process in Path("/proc").glob("[0-9]*"):
        try:
            texts = [(process / "fdinfo" / fd.name).read_text() for fd in (process / "fd").iterdir() if _is_master(fd)]
        except OSError:
            continue  # it has ended, or is not ours
        indices = {found[1] for text in texts if (found := re.search(r"^tty-index:\s*(\d+)$", text, re.MULTILINE))}
        if index in indices:
            others = sorted(indices - {index})
            return f"/dev/pts/{others[0]}" if len(others) == 1 else None
    return None


def _is_master(descriptor: Path) -> bool:
    return os.readlink(descriptor) in ("/dev/ptmx", "/dev/pts/ptmx")


def connect(port: str | None, *, speed: float = 1.0, **keywords: Any) -> SwiftArm:
    """The arm at ``port``, or the one that is plugged in; the keywords are those of ``SwiftArm``."""
    name = find_port(ARM) if port is None else port
    if speed != 1.0 and not is_emulated(name):
        raise UsageError(f"speed={speed:g} is for an emulator, and {name} is no pseudo-terminal; leave speed at 1")
    return SwiftArm(open_link(name), speed=speed, **keywords)


def rehearse(say: Say, **keywords: Any) -> SwiftArm:
    """An arm that is not there: every command is audited and shown. The keywords are those of ``SwiftArm``."""
    port = DryPort(say)
    return SwiftArm(Link(port, "the dry run", clock=port.clock), **keywords)


# Values


def limits(settings: Mapping[str, Any]) -> Limits:
    """The audit's limits from a configuration; :class:`ValueError` with a sentence for values that cannot be used."""
    pairs = {}
    for name in ("x_m", "y_m", "z_m"):
        low_high = settings[name]
        if not isinstance(low_high, Sequence) or len(low_high) != 2:
            raise ValueError(f"limits.{name} must be two numbers in metres, [low, high], got {low_high!r}")
        pairs[name] = tuple(low_high)
    return Limits(**(dict(settings) | pairs))


def object_size(value: Any) -> tuple[float, float, float]:
    """Length, width and height (m) of the object; :class:`ValueError` with a sentence for anything else."""
    length, width, height = _three("object_size_m", value)
    for side in (length, width, height):
        checks.number("object_size_m", side, low=0.005, high=0.15)
    return length, width, height


def target(value: Any, max_press_m: float, within: Limits) -> Vector:
    """A place that the user gives, shape (3,); :class:`UsageError` with a sentence if the arm cannot work there."""
    place = np.array(_three("target", value))
    if reason := out_of_reach(place):
        raise UsageError(f"target={value}: {reason}; a target is three numbers in metres, e.g. --target 0.2 0 0.03")
    check_press(float(place[2]), max_press_m, within)
    return place


def check_press(height_m: float, max_press_m: float, within: Limits) -> None:
    """Raises :class:`UsageError` if pressing onto an object of that height would go below the table clearance."""
    if height_m - max_press_m < within.table_clearance_m:
        raise UsageError(
            f"an upper surface {1000.0 * height_m:g} mm above the table is too low to press it by {1000.0 * max_press_m:g} mm: "
            f"the cup stays {1000.0 * within.table_clearance_m:g} mm above it; lower max_press_m, or take a higher object"
        )


def feed(card: PolicyCard, wanted: float | None) -> float:
    """The firmware's F: as wanted, or as the policy was trained with."""
    return checks.number("feed", card.servo.get("feed", _FEED) if wanted is None else wanted, low=0.1, high=250.0)


def _three(name: str, value: Any) -> tuple[float, float, float]:
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 3:
        raise ValueError(f"{name} must be three numbers in metres, got {value!r}")
    first, second, third = (checks.number(name, number) for number in value)
    return first, second, third


# Policies


def load_policy(path: Path) -> ActorPolicy:
    """The policy of a run folder, or in a file.

    Raises :class:`UsageError` if there is none, and ``PolicyFileError`` for a file that cannot be used.
    """
    file = path / files.POLICY if path.is_dir() else path
    if not file.is_file():
        raise UsageError(
            f"there is no policy {file}; name the folder of a trained run with --policy (uarm-rl train experiment=real_arm "
            "makes one for the arm), or try the arm with --policy ik, the inverse-kinematics controller"
        )
    return ActorPolicy.load(file)


def check_policy(card: PolicyCard, max_step_rad: float) -> list[str]:
    """Warnings about a policy; raises ``PolicyFileError`` for one whose actions the arm may not carry out."""
    try:
        checks.number("max_delta_rad", card.max_delta_rad, low=0.0, high=max_step_rad, open_low=True)
    except ValueError as error:
        raise PolicyFileError(
            f"the policy's action scale does not fit the arm: {error} (limits.max_step_rad); take a policy of another scale"
        ) from None
    warnings = []
    servo = card.servo["name"]
    if servo != "stepper":
        warnings.append(
            f"the policy was trained with servo={servo}; this arm moves as servo=stepper does, so expect less of it than of a "
            "policy trained with experiment=real_arm"
        )
    if card.hold["name"] != "until_steady":
        warnings.append("the policy was not trained to wait until the arm is steady; on this arm every decision does")
    return warnings


# Trials


def camera_search(
    camera: Camera, detector: Detector, calibration: Path, *, emulated: bool, object_size_m: Sequence[float], whole_object: bool
) -> Search:
    """The search with a camera whose calibration is in a file; it must fit the pictures that the camera takes.

    An emulated camera without a file is taken to be mounted as drawn.
    """
    from uarm_rl.real.search import CameraSearch
    from uarm_rl.real.vision.camera_model import Calibration, nominal

    loaded = None if emulated and not calibration.exists() else Calibration.load(calibration)
    picture = camera.read()
    if loaded is None:
        log.warning("there is no %s; the emulated camera is taken to be mounted as drawn", calibration)
        loaded = nominal((picture.shape[1], picture.shape[0]))
    loaded.lens.check_size(picture)
    return CameraSearch(camera, detector, loaded, object_size_m=object_size_m, whole_object=whole_object)


def scattered(generator: np.random.Generator) -> Callable[[Vector], Vector]:
    """Puts each object down at a random place of the operating range that the camera sees, at the height it came from."""

    def put_down(target_m: Vector) -> Vector:
        while True:
            place = positions.draw(generator, float(target_m[2]))
            if math.hypot(place[0], place[1]) >= _SEEN_FROM_M:
                return place

    return put_down


def check_free(folder: Path, *, overwrite: bool) -> None:
    """Raises :class:`UsageError` if ``folder`` holds results that nobody allowed to replace."""
    if (folder / TRIALS).exists() and not overwrite:
        raise UsageError(f"{folder} holds trials already; overwrite=true replaces them, out=FOLDER writes elsewhere")


def run_trials_and_record(
    policy: Policy,
    task: Task,
    open_search: Callable[[ExitStack], Search],
    open_arm: Callable[[], SwiftArm],
    put_down: Callable[[Vector], Vector] | None,
    *,
    trials: int,
    folder: Path | None,
    overwrite: bool,
    config: str,
    say: Say,
) -> None:
    """Trials with a table in the terminal and their results in ``folder`` (``None``: a dry run, which keeps nothing).

    The camera is opened, and looked through, before the arm: what is wrong with it shows before anything moves.
    Whatever happens, the arm is put to rest first, then the camera closed, then the results so far summed up.
    """
    if folder is not None:
        check_free(folder, overwrite=overwrite)
    rows: list[Row] = []
    try:
        with ExitStack() as stack:
            stack.enter_context(stopped_by_signals())
            search = open_search(stack)
            arm = stack.enter_context(open_arm())
            results = run_trials(arm, policy, search, task, put_down, trials=trials)
            say(HEADER)
            if folder is None:
                for trial in results:
                    say(line(trial.row))
            else:
                config += yaml.safe_dump({"connected": {"port": arm.port, "emulated": is_emulated(arm.port)}})
                for row in record(results, folder, config, emulated=is_emulated(arm.port), say=say):
                    rows.append(row)
    finally:
        if rows:
            say(f"{summary(rows)}; {folder}")
    if folder is None:
        say("dry run: nothing was sent; it pretends that the arm goes where it is told and that the cup always seals")
    if rows and not any("target_x_m" in row for row in rows):
        raise ObjectNotFoundError(rows[-1]["reason"])


def record(trials: Iterable[Trial], folder: Path, config: str, *, emulated: bool, say: Say) -> Iterator[Row]:
    """Write each trial's row and picture as it comes, tell it, and yield the row. ``config`` is kept beside them."""
    pictures = folder / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    for old in pictures.glob("trial-*.png"):  # of results that are being replaced
        old.unlink()
    files.replace(folder / "config.yaml", config.encode())
    logbook = Logbook(folder / TRIALS, columns.TRIALS)
    try:
        for trial in trials:
            row = trial.row | {"emulated": emulated}
            logbook.add(row)
            if trial.picture is not None:
                from uarm_rl.real.collecting import write_picture

                write_picture(pictures / f"trial-{row['trial']:03d}.png", trial.picture)
            say(line(row))
            yield row
    finally:
        logbook.close()


HEADER: Final = " trial  target (mm)            result    time   distance  remark"


def line(row: Row) -> str:
    """A trial as a line under ``HEADER``."""
    target = "-"
    if "target_x_m" in row:
        target = "({:.1f}, {:.1f}, {:.1f})".format(*(1000.0 * row[f"target_{axis}_m"] for axis in "xyz"))
    time = f"{row['time_s']:5.1f} s" if "time_s" in row else "-"
    distance = f"{1000.0 * row['final_distance_m']:.1f} mm" if "final_distance_m" in row else "-"
    result = "held" if row["success"] else "failed"
    return f"{row['trial']:6}  {target:21}  {result:6}  {time:>7}  {distance:>9}  {row['reason']}".rstrip()


def summary(rows: list[Row]) -> str:
    """How many objects were held after the lift, with Wilson's interval, and what that number is."""
    held = sum(bool(row["success"]) for row in rows)
    low, high = wilson_interval(held, len(rows))
    text = f"{held} of {len(rows)} held after the lift: {held / len(rows):.0%} (95 % interval {low:.0%} to {high:.0%}, Wilson)"
    return f"{text}; the arm was emulated, this is no result of a real one" if rows[0]["emulated"] else text


# The doctor


def examine(
    port: str | None, open_camera: Callable[[], Camera] | None, calibration: Path, policy_path: Path, max_step_rad: float
) -> Iterator[Finding]:
    """Look at ports, arm, camera, calibration and policy; findings come as they are made."""
    yield from doctor.ports()
    try:
        name = find_port(ARM) if port is None else port
    except PortError as error:
        yield Finding("problem", "arm", str(error))
        name = None
    if name is not None:
        yield Finding("ok", "arm", f"opening {name}, which restarts the controller: the arm may sag for a moment")
        yield from doctor.arm(name)
    if open_camera is None:
        yield Finding("ok", "camera", "none wanted: run-real needs --target X Y Z")
    else:
        findings, picture = doctor.camera(open_camera)
        yield from findings
        if name is not None and is_emulated(name) and not calibration.exists():
            yield Finding("warning", "calibration", f"there is no {calibration}; an emulated camera is taken to be as drawn")
        else:
            yield doctor.calibration(calibration, picture)
    try:
        card = load_policy(policy_path).card
        warnings = check_policy(card, max_step_rad)
    except (PolicyFileError, UsageError) as error:
        yield Finding("problem", "policy", str(error))
    else:
        yield Finding("ok", "policy", f"{policy_path}, {card.episodes} episodes of training")
        yield from (Finding("warning", "policy", warning) for warning in warnings)


# Jogging


def jog(port: str | None, joint: int, degrees: float, **keywords: Any) -> list[str]:
    """Move one joint by some degrees and tell what happened, in lines; the keywords are those of ``connect``."""
    checks.integer("joint", joint, low=1, high=3)
    checks.number("degrees", degrees, low=-_JOG_DEG, high=_JOG_DEG)
    with stopped_by_signals(), connect(port, parks=False, **keywords) as arm:  # parking would be a larger move
        before = arm.read_joints()
        wanted = list(before)
        wanted[joint - 1] += math.radians(degrees)
        arm.move_joints(wanted)
        after = arm.read_joints()
    moved = [math.degrees(b - a) for a, b in zip(before, after, strict=True)]
    up, down = _SIGNS[joint]
    lines = [
        f"joint{joint}: {math.degrees(before[joint - 1]):.2f} degrees before, {math.degrees(after[joint - 1]):.2f} after: "
        f"moved by {moved[joint - 1]:+.2f} of {degrees:+.2f}",
        f"right if {up if degrees > 0 else down}; if not, do not run the arm: its motors or encoders are mixed up",
    ]
    moved[joint - 1] -= degrees
    if max(map(abs, moved)) > _STRAY_DEG:
        lines.append("warning: the joints are not where they were sent; is something in the way, or are steps lost?")
    return lines
