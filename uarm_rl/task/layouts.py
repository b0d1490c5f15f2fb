"""What stands where when an attempt begins: the object alone, or obstacles between it and the arm's home too.

Each layout has a way by construction: one is drawn again and again until :func:`way` finds a way of the whole arm, its
capsules and not only the cup, past all obstacles. What it searches is small (lift, turn, stretch, come down), so that a
layout which a better planner could solve may be thrown away; none without a way is kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from uarm_rl import checks, columns, csvfile
from uarm_rl.task import kinematics, positions
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.obstacles import Box, boxes, clearances_m, way_clearances_m

#: How many obstacles a layout may have: so many has a row of a file.
SLOTS: Final = 3
#: The committed files: name -> (rows, seed of the draw). The test layouts serve the final evaluation alone.
FILES: Final = {"test_layouts.csv": (100, 20261201), "validation_layouts.csv": (50, 20261202)}

#: A new object is not put down where the cup still is.
_AWAY_M: Final = 0.06
_CLEARANCE_M: Final = 0.01  # of the whole arm, on the way that a layout must have
_GAP_M: Final = 0.05  # from the object's centre: the hand is wide
_SIDES_M: Final = (0.02, 0.06)
_HEIGHTS_M: Final = (0.05, 0.16)
_RADII_M: Final = (0.15, 0.32)  # from the base's axis
_SHARES: Final = (0.25, 0.75)  # of the turn from home to the object
_LEAST_TURN_RAD: Final = 0.4  # so that there is something between
_THROUGH_M: Final = 0.02  # deep in an obstacle is the arm that goes straight
_STRAIGHT: Final = 12  # poses on that way
_STEP_RAD: Final = 0.1
#: Where the arm may lift its cup to before it turns: distance from the axis and height, the easiest first.
_LIFTS_M: Final = tuple((radius, height) for height in (0.22, 0.26, 0.17, 0.12) for radius in (0.2, 0.14, 0.26))
#: And where an arm that has to come past whatever stands there: as near to its base, and as high, as it can.
_FARTHEST_M: Final = ((0.1275, 0.14), (0.12, 0.085), (0.22, 0.18), (0.25, 0.18))


class Layout(NamedTuple):
    """The centre of the object's upper surface (x, y, z, m), what stands in the way, and the joints that the arm begins with.

    ``start_rad``, shape (3,), is ``None`` for home. ``margin_m``: what comes nearer than this to the capsules around the arm is
    touched too; ``None``: only what the engine feels.
    """

    object_m: Vector
    obstacles: tuple[Box, ...] = ()
    start_rad: Vector | None = None
    margin_m: float | None = None

    def options(self) -> dict[str, Any]:
        """What the environment's ``reset`` takes for it."""
        told = [[*box.centre_m, *box.size_m] for box in self.obstacles]
        return {"object_position": self.object_m} | ({"obstacles": told} if told else {})


class Layouts(Protocol):
    """A task: where things stand, and the reward of a touch. ``slots``: how many obstacles are seen, 0 for none."""

    slots: int
    touching: float
    margin_m: float

    def draw(self, generator: np.random.Generator, height_m: float, cup_m: Vector) -> Layout:
        """A layout for training: the object's upper surface at ``height_m``, and not where the cup is (x, y, z, m)."""
        ...


class Reach:
    """The paper's task: an object, and nothing in the way."""

    slots = 0
    touching = 0.0
    margin_m = 0.0

    def draw(self, generator: np.random.Generator, height_m: float, cup_m: Vector) -> Layout:
        while True:
            position = positions.draw(generator, height_m)
            if math.hypot(position[0] - cup_m[0], position[1] - cup_m[1]) >= _AWAY_M:
                return Layout(position)


class Obstacles:
    """One to ``slots`` boxes between home and object; ``touching`` is the whole reward of a decision with a touch.

    That ends the attempt. It begins at home, but for a share ``elsewhere`` of those in training, which
    begin in any pose clear of all obstacles: who has to come past them to the object would see it seldom while it learns to.
    In training the arm is padded, and what comes nearer than ``margin_m`` is touched, so that a policy keeps off what it need
    not come near to: in a test, it is not. In a share ``anywhere`` of the layouts nothing need be in the way: obstacles stand
    on either side, and the object may lie ahead.
    """

    def __init__(
        self, slots: int, touching: float, elsewhere: float = 0.0, margin_m: float = 0.0, anywhere: float = 0.0
    ) -> None:
        self._elsewhere = checks.number("task.elsewhere", elsewhere, low=0.0, high=1.0)
        self._anywhere = checks.number("task.anywhere", anywhere, low=0.0, high=1.0)
        self.slots = checks.integer("task.slots", slots, low=1, high=SLOTS)
        self.touching = checks.number("task.touching", touching, low=-1e4, high=0.0)
        self.margin_m = checks.number("task.margin_m", margin_m, low=0.0, high=_CLEARANCE_M)

    def draw(self, generator: np.random.Generator, height_m: float, cup_m: Vector) -> Layout:
        count = int(generator.integers(1, self.slots + 1))  # before the rest: of three, more are thrown away
        anywhere = self._anywhere > 0.0 and generator.random() < self._anywhere
        while True:
            layout = self._sketch(generator, height_m, count, anywhere)
            if layout is not None and way(layout) is not None:
                begins_elsewhere = self._elsewhere > 0.0 and generator.random() < self._elsewhere
                start_rad = _clear_pose(generator, layout) if begins_elsewhere else None
                return layout._replace(start_rad=start_rad, margin_m=self.margin_m)

    def _sketch(self, generator: np.random.Generator, height_m: float, count: int, anywhere: bool) -> Layout | None:
        """A layout that may have no way yet; ``None`` if things stand in each other, or nothing is in the way."""
        object_m = positions.draw(generator, height_m)
        turn = math.atan2(object_m[1], object_m[0])
        if not anywhere and abs(turn) < _LEAST_TURN_RAD:
            return None
        found: list[Box] = []
        for _ in range(count):
            bearing = generator.uniform(-1.0, 1.0) * math.pi / 2.0 if anywhere else turn * generator.uniform(*_SHARES)
            radius_m = generator.uniform(*_RADII_M)
            length_m, width_m = (round(side, 3) for side in generator.uniform(*_SIDES_M, size=2))
            tall_m = round(generator.uniform(*_HEIGHTS_M), 3)
            x, y = (round(radius_m * along(bearing), 3) for along in (math.cos, math.sin))
            found.append(Box((x, y, tall_m / 2.0), (length_m, width_m, tall_m)))
        layout = Layout(object_m, in_order(found))
        return layout if not fault(layout) and (anywhere or _blocks(layout)) else None


def _clear_pose(generator: np.random.Generator, layout: Layout) -> Vector:
    """Any pose in which the cup is above the object and the whole arm 10 mm away from all obstacles."""
    low, high = kinematics.JOINT_LIMITS_RAD.T
    while True:
        pose: Vector = generator.uniform(low, high)
        above = kinematics.within_limits(pose) and kinematics.cup_position(pose)[2] >= layout.object_m[2] + _CLEARANCE_M
        if above and clearances_m(pose[np.newaxis], layout.obstacles).min() >= _CLEARANCE_M:
            return pose


def _blocks(layout: Layout) -> bool:
    """Whether who goes straight to the object, in angles, goes through an obstacle."""
    straight = np.linspace(kinematics.HOME_JOINTS_RAD, kinematics.inverse(layout.object_m), _STRAIGHT)
    return bool(clearances_m(straight, layout.obstacles).min() < -_THROUGH_M)


def in_order(obstacles: Iterable[Box]) -> tuple[Box, ...]:
    """The obstacles as a policy sees them, those first that the arm comes by first when it turns away from home."""
    return tuple(sorted(obstacles, key=lambda box: abs(math.atan2(box.centre_m[1], box.centre_m[0]))))


def fault(layout: Layout) -> str:
    """What makes a layout impossible, as the end of a sentence; empty if it is possible, though it may have no way."""
    for number, box in enumerate(layout.obstacles):
        if _apart_m(box, layout.object_m[:2]) < _GAP_M:
            return f"{box} stands on the object, or nearer to its centre than {1000.0 * _GAP_M:g} mm"
        for other in layout.obstacles[:number]:
            gaps = np.abs(np.subtract(box.centre_m, other.centre_m)) - np.add(box.size_m, other.size_m) / 2.0
            if gaps.max() < 0.0:
                return f"{box} and {other} stand in each other"
    if layout.obstacles and clearances_m(kinematics.HOME_JOINTS_RAD[np.newaxis], layout.obstacles).min() < _CLEARANCE_M:
        return f"an obstacle is nearer than {1000.0 * _CLEARANCE_M:g} mm to the arm at home"
    return ""


def _apart_m(box: Box, place_m: Vector) -> float:
    """From a place on the table to a box, as seen from above."""
    aside = np.maximum(0.0, np.abs(np.subtract(box.centre_m[:2], place_m)) - np.array(box.size_m[:2]) / 2.0)
    return float(np.hypot(*aside))


def way(layout: Layout) -> list[Vector] | None:
    """Joint positions, each of shape (3,), between which straight ways in angles lead from home onto the object.

    On all of them the whole arm keeps 10 mm away from every obstacle. ``None`` if none of those that are tried does.
    """
    return next(filter(lambda legs: _is_free(legs, layout.obstacles), _ways(layout.object_m)), None)


def _ways(object_m: Vector) -> Iterator[list[Vector]]:
    """Lift the cup, turn to the object, stretch until the cup is over it, come down; without the lift where it can be."""
    x, y, z = object_m.tolist()
    on, above = kinematics.inverse(object_m), kinematics.inverse((x, y, z + positions.APPROACH_HEIGHT_M))
    for up in _lifts(_LIFTS_M):
        yield [kinematics.HOME_JOINTS_RAD, up, *_outwards(above, up), on]


def ways_between(start_rad: Sequence[float] | Vector, end_rad: Sequence[float] | Vector) -> Iterator[list[Vector]]:
    """Ways that may lead past obstacles where the straight one does not: the ends of the straight ways that they consist of.

    Draw the cup in and up, turn, stretch. Nothing is said of whether anything is in the way of one.
    """
    for up in _lifts(_LIFTS_M + _FARTHEST_M):
        yield [*_outwards(np.array(start_rad), up)[-2::-1], *_outwards(np.array(end_rad), up)]


def _lifts(places_m: Iterable[tuple[float, float]]) -> Iterator[Vector]:
    """Joint positions with the cup straight ahead, at those of the distances and heights that it reaches."""
    for radius_m, height_m in places_m:
        if kinematics.reachable((radius_m, 0.0, height_m)):
            yield kinematics.inverse((radius_m, 0.0, height_m))


def _outwards(pose_rad: Vector, up_rad: Vector) -> list[Vector]:
    """From a lifted cup, turned to a pose, stretched out at that height, to the pose."""
    (x, y, _), height_m = kinematics.cup_position(pose_rad).tolist(), float(kinematics.cup_position(up_rad)[2])
    turn = math.atan2(y, x)
    over = (x, y, height_m)
    return [np.array([turn, *up_rad[1:]]), *([kinematics.inverse(over)] if kinematics.reachable(over) else []), pose_rad]


def _is_free(legs: Sequence[Vector], obstacles: Sequence[Box]) -> bool:
    if not obstacles:
        return True
    corners = np.array(legs)
    seen = np.concatenate([corners, (corners[1:] + corners[:-1]) / 2.0])
    if clearances_m(seen, obstacles).min() < _CLEARANCE_M:  # which tells of most that are not free
        return False
    return all(
        way_clearances_m(one.tolist(), other.tolist(), obstacles, _STEP_RAD).min() >= _CLEARANCE_M
        for one, other in pairwise(legs)
    )


# Files


def draw_file(name: str, height_m: float = positions.OBJECT_HEIGHT_M) -> list[Layout]:
    """The rows of a committed file, drawn again from its seed and rounded to the file's micrometres."""
    rows, seed = FILES[name]
    generator, task = np.random.default_rng(seed), Obstacles(SLOTS, 0.0)
    drawn = (task.draw(generator, height_m, np.zeros(3)) for _ in range(rows))
    return [layout._replace(object_m=np.round(layout.object_m, 6)) for layout in drawn]


def load_named(name: str, slots: int, height_m: float = positions.OBJECT_HEIGHT_M) -> list[Layout]:
    """What a task is tested on: the packaged ``test`` or ``validation`` layouts, or those of the file ``name``.

    A task without ``slots`` has positions instead (:func:`uarm_rl.task.positions.load_named`), the packaged ones for an
    object of ``height_m``. Raises :class:`ValueError` with a sentence for a file that is not there or cannot be used.
    """
    if not slots:
        return [Layout(position) for position in positions.load_named(name, height_m)]
    packaged = f"{name}_layouts.csv"
    if packaged in FILES:
        with resources.as_file(resources.files("uarm_rl.task") / packaged) as path:
            return load(path, slots)
    if not Path(name).exists():
        names = " or ".join(file.removesuffix("_layouts.csv") for file in FILES)
        raise ValueError(f"there is no file {name}; with task=obstacles, positions takes {names} or a CSV file of layouts")
    return load(Path(name), slots)


def load(path: Path, slots: int = SLOTS) -> list[Layout]:
    """Layouts of a CSV file with the columns ``columns.LAYOUTS``.

    Raises :class:`ValueError` with a sentence that names file and line for a value that is missing, a layout that is
    impossible or has more than ``slots`` obstacles, and one for which :func:`way` finds no way.
    """
    table = csvfile.read(path, columns.LAYOUTS)
    if not table.lines:
        raise ValueError(f"{path} holds no layouts; it needs at least one row below the header")
    rows = zip(*(table.values[name] for name in columns.LAYOUTS), strict=True)
    return [_layout(f"{path}, line {line}", row, slots) for line, row in zip(table.lines, rows, strict=True)]


def _layout(where: str, row: Sequence[float], slots: int) -> Layout:
    object_m, size = np.array(row[:3]), len(columns.BOX)
    if not kinematics.reachable(object_m) or not kinematics.reachable(object_m + (0.0, 0.0, positions.APPROACH_HEIGHT_M)):
        raise ValueError(f"{where}: the cup cannot come down onto ({', '.join(f'{value:g}' for value in row[:3])}) m")
    found: list[Box] = []
    for first in range(3, len(row), size):
        numbers = [*row[first : first + size]]
        if all(map(math.isnan, numbers)):
            continue
        if any(map(math.isnan, numbers)):
            raise ValueError(f"{where}: an obstacle needs {', '.join(columns.BOX)}, or none of them")
        found += boxes(f"{where}: the obstacle", numbers)
    if len(found) > slots:
        raise ValueError(
            f"{where}: {len(found)} obstacles, and this policy sees {slots}; train one with task.slots={len(found)}"
        )
    layout = Layout(object_m, tuple(found))
    if reason := fault(layout) or ("" if way(layout) else "no way past the obstacles was found"):
        raise ValueError(f"{where}: {reason}")
    return layout


def save(path: Path, layouts: Sequence[Layout]) -> None:
    """Write layouts as CSV with micrometres."""
    csvfile.write_rows(path, columns.LAYOUTS, map(_row, layouts))


def _row(layout: Layout) -> dict[str, str]:
    values = [*layout.object_m.tolist(), *(value for box in layout.obstacles for part in box for value in part)]
    cells = [f"{value:.6f}" for value in values]
    return dict(zip(columns.LAYOUTS, cells + [""] * (len(columns.LAYOUTS) - len(cells)), strict=True))
