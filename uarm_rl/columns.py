"""The columns of every CSV file that the program reads or writes, declared once: name, kind, unit, meaning.

Writers take their headers from here, readers what a cell may hold, and the documentation has its tables from here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple


class Kind(NamedTuple):
    """What the cells of a column may hold; ``None``: any text."""

    allows: Callable[[float], bool] | None
    words: str


FINITE: Final = Kind(math.isfinite, "a finite number")
WHOLE: Final = Kind(lambda value: value.is_integer() and abs(value) < 2**53, "a whole number")
OUTCOME: Final = Kind(lambda value: value in (0.0, 1.0), "0 or 1")
RATE: Final = Kind(lambda value: 0.0 <= value <= 1.0, "a number from 0 to 1")
TEXT: Final = Kind(None, "a text")


class Column(NamedTuple):
    """One column. ``empty``: cells may be empty. ``optional``: a file may lack it. ``since``: older files lack it."""

    name: str
    kind: Kind
    unit: str
    meaning: str
    empty: bool = False
    optional: bool = False
    since: str = ""  # a day


#: The columns of a file by their names, in the order of the file.
Columns = Mapping[str, Column]


def pick(columns: Columns, *names: str) -> Columns:
    """Some of a file's columns."""
    return {name: columns[name] for name in names}


def markdown(columns: Columns, file: str) -> str:
    """The table of a file's columns as the documentation has it."""
    rows = (f"| `{name}`{f' ({column.unit})' if column.unit else ''} | {column.meaning} |" for name, column in columns.items())
    return "\n".join([f"| `{file}` | |", "|---|---|", *rows]) + "\n"


def _columns(*columns: Column) -> Columns:
    return {column.name: column for column in columns}


#: A row an episode of a training.
PROGRESS: Final = _columns(
    Column("episode", WHOLE, "", "from 1"),
    Column("experiences", WHOLE, "", "decisions stored so far"),
    Column("control_steps", WHOLE, "", "so far, 0.05 s each unless `control_hz` says otherwise"),
    Column("updates", WHOLE, "", "gradient steps so far"),
    Column("admission_rate", RATE, "", "share of this episode's decisions that were stored"),
    Column("episode_return", FINITE, "", "sum of rewards of this episode, exploration noise included"),
    Column("critic_loss", FINITE, "", "of the episode's last gradient step", empty=True),
    Column("actor_loss", FINITE, "", "of the episode's last gradient step", empty=True),
    Column("validation_success_rate", RATE, "", "on 50 positions that are not the test positions", empty=True),
    Column("wall_s", FINITE, "s", "time of training so far"),
    Column("decisions", WHOLE, "", "commands so far"),
    Column("successes", WHOLE, "", "how often in this episode the cup arrived"),
    Column("object_losses", WHOLE, "", "how often the object went out of reach"),
    Column("explosions", WHOLE, "", "how often the physics failed"),
    Column("object_moved_m", FINITE, "m", "how far the object was moved in this episode, exploration included"),
    Column("q_min", FINITE, "", "least Q(s, mu(s)) over the batch of the last gradient step", empty=True),
    Column("q_max", FINITE, "", "greatest Q(s, mu(s)) over that batch", empty=True),
    Column("saturation", RATE, "", "share of the actor's outputs beyond 0.99 over that batch", empty=True),
    Column(
        "warning",
        TEXT,
        "",
        "the critic beyond what rewards can add up to, or more than 90 % of the actor saturated; also shown at the bar",
        empty=True,
    ),
)

_LEANS: Final = "2026-11-27"

#: What the test of a policy shows: a row a position.
MEASURED: Final = _columns(
    Column("position", WHOLE, "", "number of the position, from 0"),
    Column("success", OUTCOME, "", "arrived and stayed"),
    Column("return", FINITE, "", "under the method's own reward, per decision"),
    Column("common_return", FINITE, "", "under one reward for all methods (`penalty`), per control step"),
    Column("time_s", FINITE, "s", "arm time until success, or until the time limit"),
    Column("final_distance_m", FINITE, "m", "cup to target at the end"),
    Column("min_distance_m", FINITE, "m", "cup to target, the least"),
    Column("object_displacement_m", FINITE, "m", "how far the object was pushed"),
    Column("reversals_per_s", FINITE, "1/s", "control steps whose movement points against the one before"),
    Column("rms_jerk", FINITE, "m/s³", "root mean square of the tip's third derivative"),
    Column("tip_travel_last_s_m", FINITE, "m", "length of the tip's path in the last second"),
    Column("decisions", WHOLE, "", "commands sent"),
)
#: Under which conditions, the same in all rows of a file.
CONDITIONS: Final = _columns(
    Column("tolerance_m", FINITE, "m", "how near the cup had to come", since="2026-11-22"),
    Column("hold", TEXT, "", "the hold tested with: `fixed(13)` is 13 control steps", since="2026-11-22"),
    Column("control_hz", FINITE, "1/s", "control steps a second", since="2026-11-22"),
    Column(
        "servo_rise_s",
        FINITE,
        "s",
        "the servo's rise time, 10 to 90 % of 0.15 rad",
        empty=True,
        since="2026-11-22",
    ),
    Column("sigma", FINITE, "1/m", "of the method's own reward: the punishment for moving the object", since="2026-11-22"),
    Column("engine", TEXT, "", "`pybullet` or `mujoco`; in older files it is PyBullet", since="2026-11-27"),
)
#: How the arm leans on the object.
LEANING: Final = _columns(
    Column("press_m", FINITE, "m", "the deepest that the cup was below the object's upper surface while over it", since=_LEANS),
    Column("reference_press_m", FINITE, "m", "the same of the cup as it was commanded", since=_LEANS),
    Column("contact_n", FINITE, "N", "normal force between cup and object, the most", since=_LEANS),
    Column("object", TEXT, "", "`solid`, or `ghost`: the target is told and nothing is there", since=_LEANS),
    Column("cup", TEXT, "", "`rigid` or `bellows`", since=_LEANS),
)
#: How near the cup came to stay: where success does not end the test.
SETTLED: Final = _columns(
    Column(
        "settled_distance_m",
        FINITE,
        "m",
        "the least, over all windows of `dwell_s`, of the largest distance from cup to target in one; success at a tolerance "
        "is a comparison with it; empty if the object was lost before",
        empty=True,
        since="2026-11-28",
    ),
)
#: How the arm touches obstacles: where the task has some.
TOUCHING: Final = _columns(
    Column("touched", OUTCOME, "", "the arm touched an obstacle", since="2026-12-01"),
    Column("obstacle_contact_n", FINITE, "N", "normal force between arm and obstacles, the most", since="2026-12-01"),
)
EVALUATION: Final[Columns] = {**MEASURED, **CONDITIONS, **LEANING, **SETTLED, **TOUCHING}

#: The arm and the object at one instant.
STATE: Final = _columns(
    *(Column(f"joint{number}_rad", FINITE, "rad", f"angle of joint {number}") for number in (1, 2, 3)),
    *(Column(f"cup_{axis}_m", FINITE, "m", f"{axis} of the cup's tip, base frame") for axis in "xyz"),
    *(Column(f"object_{axis}_m", FINITE, "m", f"{axis} of the centre of the object's upper surface") for axis in "xyz"),
)
#: A row a control step of a recorded test, the start included.
TRACES: Final[Columns] = {
    **_columns(
        Column("position", WHOLE, "", "number of the position"),
        Column("step", WHOLE, "", "control step, 0 at the start"),
        Column("time_s", FINITE, "s", "arm time since the start"),
    ),
    **STATE,
}

#: A row a motion of which both engines got the same commands.
TRAJECTORIES: Final = _columns(
    Column("motion", TEXT, "", "`free` in the air, or `contact` with the object"),
    Column("position", WHOLE, "", "number of the position"),
    Column("cup_apart_m", FINITE, "m", "from the cup in one engine to the cup in the other, the most in all control steps"),
    Column("object_apart_m", FINITE, "m", "likewise from object to object; empty if it has no part in it, or fell", empty=True),
)

#: A row a trial on the arm, real or emulated.
TRIALS: Final = _columns(
    Column("trial", WHOLE, "", "from 1"),
    *(
        Column(f"target_{axis}_m", FINITE, "m", f"{axis} of the centre of the object's upper surface, as found", empty=True)
        for axis in "xyz"
    ),
    Column("success", OUTCOME, "", "the pump still reports a sealed cup after the lift"),
    Column("reached", OUTCOME, "", "the policy's own flag"),
    Column("time_s", FINITE, "s", "of the arm's time, from home until the flag or the time limit", empty=True),
    Column("final_distance_m", FINITE, "m", "cup to target at the end of the approach, by forward kinematics", empty=True),
    Column("decisions", WHOLE, "", "commands of the approach", empty=True),
    Column("clamps", WHOLE, "", "references that the audit pulled inside a limit, by a hair", empty=True),
    Column(
        "pull_ups",
        WHOLE,
        "",
        "references that were raised to spare the object, or moved aside for an obstacle",
        empty=True,
        since="2026-11-27",
    ),
    Column("looks", WHOLE, "", "pictures taken", empty=True),
    Column("camera_misfit_px", FINITE, "px", "the object's outline against a box there", empty=True),
    Column("camera_disagreement_m", FINITE, "m", "first look against last", empty=True),
    Column("firmware", TEXT, "", "version that the arm tells", empty=True),
    Column("emulated", OUTCOME, "", "1: no real arm was there"),
    Column("reason", TEXT, "", "why it failed, in a sentence", empty=True),
)

#: A row a position of the object.
POSITIONS: Final = _columns(
    *(Column(f"{axis}_m", FINITE, "m", f"{axis} of the centre of the object's upper surface, base frame") for axis in "xyz")
)

#: An obstacle: the centre of a box, and its sides, along the axes of the base frame.
BOX: Final = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m")
#: A row a layout: the object, and up to three obstacles; those that are not there are empty.
LAYOUTS: Final[Columns] = {
    **POSITIONS,
    **_columns(
        *(
            Column(f"obstacle{number}_{name}", FINITE, "m", f"of obstacle {number}", empty=True, optional=True)
            for number in (1, 2, 3)
            for name in BOX
        )
    ),
}

#: A row a look at a mark that the cup has touched.
OBSERVATIONS: Final = _columns(
    Column("picture", TEXT, "", "a picture beside the file, for rows without a pixel", empty=True, optional=True),
    Column("u_px", FINITE, "px", "where the mark is seen, to the right", empty=True, optional=True),
    Column("v_px", FINITE, "px", "where the mark is seen, downwards", empty=True, optional=True),
    *(Column(f"joint{number}_rad", FINITE, "rad", f"joint {number} at that moment") for number in (1, 2, 3)),
    *(Column(f"{axis}_m", FINITE, "m", f"{axis} of where the cup's tip touched the mark, base frame") for axis in "xyz"),
)

#: The paper's success rate of each method.
PAPER: Final = _columns(
    Column("method", TEXT, "", "A, B, C or D"),
    Column("success_rate", RATE, "", "as the paper gives it"),
)

#: A row a run that was submitted to a cluster.
SUBMITTED: Final = _columns(
    Column("folder", TEXT, "", "of the run, below the results folder"),
    Column("job", TEXT, "", "what the queue calls it, or machine and process; empty if it was not taken", empty=True),
    Column("words", TEXT, "", "what was typed behind `uarm-rl submit`"),
)
