"""Where the object may lie: the operating range, random draws from it, and the committed position files.

A position is the centre of the object's upper surface (m) for an object that rests on the table.
"""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np

from uarm_rl import columns, csvfile
from uarm_rl.task import kinematics
from uarm_rl.task.kinematics import Vector

#: Nearer than this an object would lie under the elbow, against the base (its corner is 93 mm from the axis), or
#: below the smallest cup radius that firmware 3.2 allows near the table (118.5 mm, ``get_radius_from_height``).
MIN_RADIUS_M: Final = 0.13
#: The cup must be able to come from above, and every joint must keep clear of its limits on the way.
APPROACH_HEIGHT_M: Final = 0.06
MARGIN_RAD: Final = math.radians(2.0)

#: The committed files: name -> (rows, seed of the draw). The test positions serve the final evaluation alone.
FILES: Final = {
    "test_positions.csv": (100, 20190701),
    "validation_positions.csv": (50, 20190702),
    "heldout_positions.csv": (1000, 20190703),
}
OBJECT_HEIGHT_M: Final = 0.03  # of the object that the committed files are for


def in_operating_range(position_m: Vector) -> bool:
    """Whether the cup can come down onto ``position_m`` (shape (3,)) from above with a margin to every joint limit."""
    above = position_m + np.array([0.0, 0.0, APPROACH_HEIGHT_M])
    return (
        math.hypot(position_m[0], position_m[1]) >= MIN_RADIUS_M
        and kinematics.reachable(position_m, MARGIN_RAD)
        and kinematics.reachable(above, MARGIN_RAD)
    )


def draw(generator: np.random.Generator, height_m: float) -> Vector:
    """A position, shape (3,), uniform over the operating range on the plane ``z = height_m``."""
    while True:
        x, y = generator.uniform((0.0, -0.37), (0.37, 0.37))
        position = np.array([x, y, height_m])
        if in_operating_range(position):
            return position


def within_reach(name: str, value: object) -> Vector:
    """``value`` as an array of shape (3,) if it is a position (m) that the cup can reach; :class:`ValueError` otherwise."""
    position = np.asarray(value, np.float64)
    if position.shape != (3,) or not kinematics.reachable(position):
        raise ValueError(f"{name} must be three numbers (m) that the cup can reach, got {value!r}")
    return position


def draw_file(name: str) -> Vector:
    """The rows of a committed position file, drawn again from its seed and rounded to the file's micrometres."""
    rows, seed = FILES[name]
    generator = np.random.default_rng(seed)
    return np.round([draw(generator, OBJECT_HEIGHT_M) for _ in range(rows)], 6)


def load_packaged(name: str, height_m: float = OBJECT_HEIGHT_M) -> Vector:
    """One of the committed position files, shape (n, 3); an object of another height stands in the same places."""
    with resources.as_file(resources.files("uarm_rl.task") / name) as path:
        return load(path, height_m)


def check_named(name: str) -> None:
    """Raises :class:`ValueError` with a sentence if there are no positions of that name, packaged or in a file."""
    if f"{name}_positions.csv" not in FILES and not Path(name).exists():
        names = ", ".join(file.removesuffix("_positions.csv") for file in FILES)
        raise ValueError(f"there is no file {name}; positions takes {names} or a CSV file with x_m, y_m and z_m")


def load_named(name: str, height_m: float = OBJECT_HEIGHT_M) -> Vector:
    """The packaged ``test``, ``validation`` or ``heldout`` positions, or those of the file ``name``; shape (n, 3).

    ``height_m`` is the object's, for the packaged ones. Raises :class:`ValueError` if there is neither.
    """
    check_named(name)
    packaged = f"{name}_positions.csv"
    return load_packaged(packaged, height_m) if packaged in FILES else load(Path(name))


def load(path: Path, height_m: float | None = None) -> Vector:
    """Positions of a CSV file with the columns x_m, y_m, z_m, the last ``height_m`` instead where it is given; shape (n, 3).

    Raises :class:`ValueError` with a sentence that names file and line when a column is missing, a value is not a
    finite number, or the cup cannot reach a position.
    """
    table = csvfile.read(path, columns.POSITIONS)
    if not table.lines:
        raise ValueError(f"{path} holds no positions; it needs at least one row below the header")
    positions = np.column_stack([table.values[name] for name in columns.POSITIONS])
    if height_m is not None:
        positions[:, 2] = height_m
    for line, position in zip(table.lines, positions, strict=True):
        _check_reachable(path, line, position)
    return positions


def _check_reachable(path: Path, line: int, position: Vector) -> None:
    if not kinematics.reachable(position):
        x, y, z = position
        raise ValueError(
            f"{path}, line {line}: the cup cannot reach ({x:g}, {y:g}, {z:g}) m within the joint limits; "
            "positions are metres in the base frame, the upper surface of the object"
        )


def save(path: Path, positions_m: Vector) -> None:
    """Write positions, shape (n, 3), as CSV with micrometres."""
    rows = ({name: f"{value:.6f}" for name, value in zip(columns.POSITIONS, row, strict=True)} for row in positions_m.tolist())
    csvfile.write_rows(path, columns.POSITIONS, rows)
