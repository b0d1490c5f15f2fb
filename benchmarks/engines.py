"""How far the engines are apart under the same commands, in the air and on the object.

    python benchmarks/engines.py [--out results/mujoco/trajectories.csv]     (make engines runs it)

For each of the 100 test positions PyBullet and MuJoCo get the same joint references, control step by control step, whatever
comes of them. *free*: random steps in the air, a new one before the last has ended. *contact*: the cup comes down on the
object, presses as hard as ``run-real`` may at most, drags the object sideways, and lifts off. Writes
the file of which ``uarm-rl report`` makes the second table of ``results/engines.md``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np

from uarm_rl import configuration
from uarm_rl.columns import TRAJECTORIES
from uarm_rl.csvfile import write_rows
from uarm_rl.evaluation.measures import Row
from uarm_rl.sim.simulated_arm import SimulatedArm
from uarm_rl.task import kinematics, positions
from uarm_rl.task.arm import JointPositions

OUT: Final = Path(__file__).parents[1] / "results" / "mujoco" / "trajectories.csv"
CLEAR_M: Final = 0.06  # the cup stays so high above the table where nothing is to be touched
ABOVE_M, PRESS_M, DRAG_M = 0.03, 0.005, 0.02
REST_STEPS: Final = 20  # a second for each place on the object

#: A reference and for how many control steps it acts.
Command = tuple[JointPositions, int]


def free(position: np.ndarray, generator: np.random.Generator) -> Iterator[Command]:
    """Ten seconds of the largest steps that an action can ask for, every 0.2 s."""
    joints = kinematics.HOME_JOINTS_RAD
    for _ in range(50):
        reference = joints
        while reference is joints or kinematics.cup_position(reference)[2] < CLEAR_M:
            reference = np.array(kinematics.clip_to_limits(*(joints + generator.uniform(-0.15, 0.15, 3))))
        joints = reference
        yield kinematics.clip_to_limits(*joints), 4


def contact(position: np.ndarray, generator: np.random.Generator) -> Iterator[Command]:
    """Down on the object, along the table in a random direction, up again."""
    above, pressed = np.array([0.0, 0.0, ABOVE_M]), np.array([0.0, 0.0, -PRESS_M])
    aside = np.full(3, np.inf)
    while not all(kinematics.reachable(position + aside + height) for height in (above, pressed)):
        angle = generator.uniform(0.0, 2.0 * np.pi)
        aside = DRAG_M * np.array([np.cos(angle), np.sin(angle), 0.0])
    for offset in (above, np.zeros(3), pressed, pressed + aside, above + aside):
        yield kinematics.clip_to_limits(*kinematics.inverse(position + offset)), REST_STEPS


MOTIONS: Final = {"free": free, "contact": contact}


def play(arm: SimulatedArm, position: np.ndarray, commands: Sequence[Command], motion: str) -> np.ndarray:
    """Cup and object after every control step, shape (control steps, 2, 3), m; NaN for an object that has no part in it."""
    arm.home()
    if motion == "contact":
        arm.place_object(position)
    seen = []
    for reference, control_steps in commands:
        arm.command_joints(reference)
        for _ in range(control_steps):
            arm.advance()
            thing = arm.object_position() if motion == "contact" else None
            seen.append((arm.link_ends()[3], thing or [np.nan] * 3))
    return np.array(seen)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=OUT, help="file for the result")
    out: Path = parser.parse_args().out
    settings = configuration.compose("train")
    rows: list[Row] = []
    with ExitStack() as stack:
        arms = []
        for engine in configuration.OPEN_SETS["sim"]:
            sim = configuration.compose("train", (f"sim={engine}",))["sim"]
            servo = configuration.build("servo", settings["servo"])
            arms.append(stack.enter_context(configuration.build("sim", sim, servo=servo, control_hz=settings["control_hz"])))
        for motion, commands_of in MOTIONS.items():
            for number, position in enumerate(positions.load_packaged("test_positions.csv")):
                commands = list(commands_of(position, np.random.default_rng(number)))
                one, other = (play(arm, position, commands, motion) for arm in arms)
                cup_m, object_m = np.linalg.norm(one - other, axis=2).max(axis=0).tolist()
                rows.append({"motion": motion, "position": number, "cup_apart_m": cup_m, "object_apart_m": object_m})
    out.parent.mkdir(parents=True, exist_ok=True)
    write_rows(out, TRAJECTORIES, rows)
    print(out)


if __name__ == "__main__":
    main()
