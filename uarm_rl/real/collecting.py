"""Gathers what a calibration needs: pictures of the board, and touched marks with their pictures, as files or live.

What the commands call::

    uarm-rl calibrate-camera       collect_board_pictures(camera, board, folder, ask)                    live
                                   calibrate_intrinsics_from_folder(folder, board, name) -> Intrinsics, report
    uarm-rl calibrate-hand-eye     collect_observations(arm, camera, detector, guess, csv_path, ask)     live
                                   read_observations(csv_path, intrinsics, detector) -> list of Observation
                                   hand_eye_fit.calibrate_hand_eye(observations, intrinsics) -> Calibration, report

``guess`` is ``camera_model.nominal(...)`` or an older calibration. ``ask`` shows a text to the user and returns the
answer: ``input``, say. What is collected is on the disk at once, so an interrupted session can be used or continued.

**The session with the arm.** Each mark is something flat that the detector finds and the cup can touch: an AprilTag of
15 to 20 mm, or a coloured dot, on top of a flat block of 10 to 40 mm. For each mark the user

1. puts it somewhere in front of the arm, each time elsewhere, near and far, left and right;
2. drives the cup down onto its middle with moves like ``x 5``, ``y -2.5``, ``z -1`` (millimetres in the base frame),
   until the cup's lip just touches, and answers ``touch``: the cup's position, read back from the encoders, is the
   mark's;
3. leaves it where it is: the arm rises, looks at it from several poses at three heights, and keeps what it sees.

The arm does it with the driver's limits on; what the audit refuses is shown and asked for again.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from uarm_rl import columns, csvfile
from uarm_rl.real.audit import UnsafeCommandError
from uarm_rl.real.vision import projection
from uarm_rl.real.vision.camera import Camera, Picture, picture_files, read_picture, write_picture
from uarm_rl.real.vision.camera_model import Calibration, CalibrationError, Intrinsics, Observation
from uarm_rl.real.vision.detection import Detector, TargetNotFoundError
from uarm_rl.real.vision.lens_fit import Board, calibrate_intrinsics
from uarm_rl.task import kinematics
from uarm_rl.task.arm import JointPositions

Ask = Callable[[str], str]

# Pictures of the board


def collect_board_pictures(camera: Camera, board: Board, folder: Path, ask: Ask, count: int = 15) -> None:
    """Take pictures until ``count`` of them show the whole board, and write them to ``folder`` as PNG.

    Answering ``done`` ends it early. Pictures that are there already count, and none is overwritten.
    """
    folder.mkdir(parents=True, exist_ok=True)
    number = len(list(folder.glob("board*.png")))
    word = f"pictures go to {folder}"
    while number < count:
        answer = ask(
            f"{word}. Picture {number + 1} of {count}: hold the board still, tilted by 20 to 40 degrees to another side each "
            "time, also in the corners of the picture; press Enter, or type done: "
        )
        if answer.strip().lower() in ("done", "quit"):
            return
        picture = camera.read()
        if board.corners(picture) is None:
            word = "the whole board is not visible, try again"
            continue
        number += 1
        path = folder / f"board{_next_number('board', [path.name for path in folder.iterdir()]):02d}.png"
        write_picture(path, picture)
        word = f"{path.name} is good"


def _next_number(stem: str, names: Iterable[str]) -> int:
    """Behind the highest number that a picture has: what was deleted leaves a gap, and nothing is overwritten."""
    numbers = (re.fullmatch(rf"{re.escape(stem)}(\d+)\.png", name) for name in names)
    return max((int(number[1]) for number in numbers if number), default=0) + 1


def calibrate_intrinsics_from_folder(folder: Path, board: Board, camera: str) -> tuple[Intrinsics, str]:
    """The lens from all pictures of a folder, and a report; see ``lens_fit.calibrate_intrinsics``."""
    paths = picture_files(folder)
    return calibrate_intrinsics([read_picture(path) for path in paths], board, camera, [path.name for path in paths])


# Observations as a table


def read_observations(path: Path, intrinsics: Intrinsics, detector: Detector | None = None) -> list[Observation]:
    """The rows of an observations file; marks of rows without a pixel are found in their pictures by ``detector``.

    Raises :class:`CalibrationError`, :class:`CameraError` or :class:`TargetNotFoundError` with the line that is wrong.
    """
    try:
        table = csvfile.read(path, columns.OBSERVATIONS)
    except (OSError, csvfile.CsvError) as error:
        raise CalibrationError(f"the observations cannot be read: {error}") from error
    if not table.lines:
        raise CalibrationError(f"{path} has no rows below its header")
    observations = []
    for line, *row in zip(table.lines, *table.values.values(), strict=True):
        name, u, v, first, second, third, x, y, z = row
        pixel = _pixel(f"{path}, line {line}", path.parent, name, (u, v), intrinsics, detector)
        observations.append(Observation(pixel, (first, second, third), (x, y, z)))
    return observations


def _pixel(
    where: str, folder: Path, name: str, given: tuple[float, float], intrinsics: Intrinsics, detector: Detector | None
) -> tuple[float, float]:
    """The pixel that is given, or else that of the mark in the picture."""
    if not any(map(math.isnan, given)):
        return given
    if not all(map(math.isnan, given)):
        raise CalibrationError(f"{where}: one of u_px and v_px is empty; give both, or a picture alone")
    if not name or detector is None:
        raise CalibrationError(f"{where}: there is neither a pixel (u_px, v_px) nor a picture with a detector for its mark")
    picture = read_picture(folder / name)
    intrinsics.check_size(picture)
    try:
        return detector.detect(picture).centre_px
    except TargetNotFoundError as error:
        raise TargetNotFoundError(f"{where}, {name}: {error}") from error


def append_observations(path: Path, observations: Sequence[Observation], pictures: Sequence[str] = ()) -> None:
    """Add rows to an observations file, making it with its header if it is new; ``pictures`` are names beside it."""
    names = list(pictures) or [""] * len(observations)
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [
        [name, *(f"{value:.3f}" for value in seen.pixel_px), *(f"{value:.6f}" for value in (*seen.joints_rad, *seen.touch_m))]
        for name, seen in zip(names, observations, strict=True)
    ]
    csvfile.append_rows(path, columns.OBSERVATIONS, [dict(zip(columns.OBSERVATIONS, row, strict=True)) for row in rows])


# The session with the arm


class PosableArm(Protocol):
    """An arm that goes where it is told and stays there: ``SwiftArm``."""

    def read_joints(self) -> JointPositions:
        """joint1..joint3 (rad), read back."""
        ...

    def move_joints(self, reference_rad: Sequence[float]) -> None:
        """Go there, however far, and wait."""
        ...

    def rest(self, seconds: float) -> None:
        """Let time pass."""
        ...


MARKS: Final = 9
#: Heights of the cup (m) to look from, and where the mark then is in the picture: offsets from the middle as parts of
#: half the width and half the height.
_LOOK_HEIGHTS_M: Final = (0.10, 0.135, 0.17)
_LOOK_OFFSETS: Final = ((0.0, 0.0), (-0.55, -0.5), (0.55, 0.5))
_RISE_M: Final = 0.03
_SETTLE_S: Final = 0.2  # the arm swings a little after it has stopped
_SKIPPED: Final = (math.inf, math.inf, math.inf)
_REFUSALS: Final = (kinematics.UnreachableError, UnsafeCommandError)  # nothing has moved; all other errors end the session
_MAX_JOG_MM: Final = 50.0
_JOG: Final = re.compile(r"([xyz])\s*=?\s*([-+]?\d+(?:\.\d*)?|[-+]?\.\d+)")
_JOG_HELP: Final = (
    "type a move in mm (x 5, y -2.5, z -1), touch when the cup's lip just touches the middle of the mark, skip, or done"
)


def collect_observations(
    arm: PosableArm,
    camera: Camera,
    detector: Detector,
    guess: Calibration,
    csv_path: Path,
    ask: Ask,
    *,
    marks: int = MARKS,
    heights_m: Sequence[float] = _LOOK_HEIGHTS_M,
) -> int:
    """Touch marks and look at them, as this module describes; rows and pictures are added at and beside ``csv_path``.

    Returns the number of observations added. ``guess`` says from where a mark will be in view; its lens is not used
    for anything else. Pictures of another size than the guess's raise :class:`CalibrationError`; errors of arm and
    camera pass through, with everything up to then on the disk.
    """
    added = 0
    word = f"{marks} marks, one after another"
    for mark in range(1, marks + 1):
        touch = _touch(arm, ask, f"{word}. Mark {mark} of {marks}: put it at a new place and bring the cup onto it")
        if touch is None:
            return added
        if touch == _SKIPPED:
            word = "skipped"
            continue
        _rise(arm, touch)
        seen = _look(arm, camera, detector, guess, touch, heights_m, csv_path)
        added += seen
        word = f"seen in {seen} pictures, {added} altogether"
    return added


def _touch(arm: PosableArm, ask: Ask, intro: str) -> tuple[float, float, float] | None:
    """Where the cup touches the mark (m, as read back); ``_SKIPPED`` or, if the user wants no more marks, ``None``."""
    word = intro
    while True:
        cup = kinematics.cup_position(arm.read_joints())
        answer = ask(f"{word}. The cup is at ({', '.join(f'{1000.0 * value:.1f}' for value in cup)}) mm; {_JOG_HELP}: ")
        answer = answer.strip().lower()
        if answer == "touch":
            x, y, z = (round(value, 6) for value in cup.tolist())
            return x, y, z
        if answer == "skip":
            return _SKIPPED
        if answer in ("done", "quit"):
            return None
        moves = _JOG.findall(answer)
        if not moves or _JOG.sub("", answer).strip(" ,"):
            word = f"{answer!r} is no move"
            continue
        if any(abs(float(value)) > _MAX_JOG_MM for _, value in moves):
            word = f"a move is {_MAX_JOG_MM:g} mm at most"
            continue
        goal = cup.copy()
        for axis, value in moves:
            goal["xyz".index(axis)] += float(value) / 1000.0
        try:
            arm.move_joints(kinematics.inverse(goal).tolist())
            word = "moved"
        except _REFUSALS as error:
            word = f"not moved: {error}"


def _rise(arm: PosableArm, touch_m: Sequence[float]) -> None:
    x, y, z = touch_m
    with suppress(*_REFUSALS):  # then the way to the first pose has to do
        arm.move_joints(kinematics.inverse((x, y, z + _RISE_M)).tolist())


def _look(
    arm: PosableArm,
    camera: Camera,
    detector: Detector,
    guess: Calibration,
    touch: tuple[float, float, float],
    heights_m: Sequence[float],
    csv_path: Path,
) -> int:
    """Look at a mark from every pose that promises to show it; returns how many pictures do."""
    seen = 0
    for joints in _views(guess, touch, heights_m):
        with suppress(TargetNotFoundError, UnsafeCommandError):
            arm.move_joints(joints.tolist())
            arm.rest(_SETTLE_S)
            at = arm.read_joints()
            picture = camera.read()
            guess.lens.check_size(picture)
            _keep(csv_path, Observation(detector.detect(picture).centre_px, at, touch), picture)
            seen += 1
    return seen


def _views(guess: Calibration, touch_m: Sequence[float], heights_m: Sequence[float]) -> Iterator[kinematics.Vector]:
    middle = (np.array(guess.lens.image_size) - 1.0) / 2.0
    for height_m in heights_m:
        for offset in _LOOK_OFFSETS:
            try:
                joints = projection.look_at(touch_m, guess, height_m, middle * (1.0 + np.array(offset)))
            except ValueError:  # cannot be seen from there
                continue
            yield joints


def _keep(csv_path: Path, observation: Observation, picture: Picture) -> None:
    csv_path.parent.mkdir(parents=True, exist_ok=True)
    taken = [path.name for path in csv_path.parent.iterdir()]
    if csv_path.exists():  # a row may name a picture that was deleted
        taken += map(str, csvfile.read(csv_path, columns.OBSERVATIONS).values["picture"])
    name = f"{csv_path.stem}-{_next_number(f'{csv_path.stem}-', taken):03d}.png"
    write_picture(csv_path.with_name(name), picture)
    append_observations(csv_path, [observation], [name])
