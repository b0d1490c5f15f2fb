"""What the commands at the real arm share: values, policy and camera that a configuration names."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from typing import Any, Final

import numpy as np

from uarm_rl import checks, files
from uarm_rl.checks import UsageError
from uarm_rl.configuration import Settings, build
from uarm_rl.real.audit import Limits
from uarm_rl.real.ports import camera_beside
from uarm_rl.real.trials import Task, out_of_reach
from uarm_rl.task import observation
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.layouts import Obstacles, Reach
from uarm_rl.task.obstacles import boxes, leaves_room
from uarm_rl.task.policy import ActorPolicy, PolicyCard, PolicyFileError

_FEED: Final = 20.0

#: The name of the policy that travels with the package.
DEFAULT_POLICY: Final = "default"


def ask(text: str) -> str:
    """The user's answer to a question in the terminal. Raises :class:`UsageError` if nobody can answer."""
    try:
        return input(text)
    except EOFError:
        raise UsageError("the questions need somebody at a terminal to answer them; standard input has ended") from None


def open_camera(settings: Settings) -> Any:
    """The configured camera; the one beside an emulated arm if no other is named."""
    camera = settings["camera"]
    if camera["name"] == "openmv" and camera["port"] is None and settings["port"]:
        camera = camera | {"port": camera_beside(settings["port"])}
    return build("camera", camera)


def motion(settings: Settings) -> dict[str, Any]:
    """Limits, feed and speed of an arm that a command moves; :class:`ValueError` with a sentence before a port is opened."""
    feed = checks.number("feed", settings["feed"], low=0.1, high=250.0)
    return {"limits": limits(settings["limits"], settings["obstacle"]), "feed": feed, "speed": speed(settings["speed"])}


def speed(value: Any) -> float | None:
    """The speed of an emulator, if it is given; :class:`ValueError` with a sentence for values that cannot be used."""
    return None if value is None else checks.number("speed", value, low=0.1, high=50.0)


def limits(settings: Mapping[str, Any], obstacle: Any = None) -> Limits:
    """The audit's limits, obstacles among them; :class:`ValueError` with a sentence for values that cannot be used."""
    pairs: dict[str, Any] = {"obstacles": boxes("obstacle", obstacle)}
    for name in ("x_m", "y_m", "z_m"):
        pairs[name] = tuple(
            checks.numbers(f"limits.{name}", settings[name], (-0.1, 0.3), "two numbers in metres, low and high")
        )
    return Limits(**(dict(settings) | pairs))


def object_size(value: Any) -> tuple[float, float, float]:
    """Length, width and height (m) of the object; :class:`ValueError` with a sentence for anything else."""
    size_m = checks.position("object_size_m", value)
    for side in size_m:
        checks.number("object_size_m", side, low=0.005, high=0.15)
    return size_m


def target(value: Any, max_press_m: float, within: Limits) -> Vector:
    """A place that the user gives, shape (3,); :class:`UsageError` with a sentence if the arm cannot work there."""
    place = np.array(checks.position("target", value))
    if reason := out_of_reach(place):
        raise UsageError(f"target={value}: {reason}; a target is three numbers in metres, e.g. --target 0.2 0 0.03")
    check_press(float(place[2]), max_press_m, within)
    if not leaves_room(place, within.obstacles, within.obstacle_clearance_m):
        raise UsageError(f"target={value} is too near an obstacle for the arm to come down onto it; move one of them")
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


def task_of(card: PolicyCard, settings: Settings) -> Task:
    """What the policy was trained for, and how its objects are picked up."""
    slots, told = card.observation.get("obstacles", 0), boxes("obstacle", settings["obstacle"])
    if 0 < slots < len(told):
        raise UsageError(
            f"{len(told)} obstacles are told, and the policy sees {slots} at the most; take some away, or policy=ik"
        )
    return Task(
        hold=build("hold", card.hold),
        **{key: getattr(card, key) for key in ("control_hz", "max_delta_rad", "tolerance_m", "dwell_s")},
        **{key: settings[key] for key in ("time_limit_s", "press_m", "max_press_m")},
        object_size_m=object_size(settings["object_size_m"]),
        observation=observation.kind(card.observation),
        layouts=Obstacles(slots, 0.0) if slots else Reach(),
        obstacles=told,
        actions=card.actions,
    )


def load_policy(name: str) -> ActorPolicy:
    """The packaged policy (``default``), or that of a run folder, or in a file.

    Raises :class:`UsageError` if there is none, and ``PolicyFileError`` for a file that cannot be used.
    """
    if name == DEFAULT_POLICY:
        with resources.as_file(resources.files("uarm_rl.real") / "default.safetensors") as packaged:
            return ActorPolicy.load(packaged)
    path = checks.path("policy", name)
    file = path / files.POLICY if path.is_dir() else path
    if not file.is_file():
        raise UsageError(
            f"there is no policy {file}; --policy takes {DEFAULT_POLICY}, which comes with the program, the folder of a "
            "trained run (uarm-rl train experiment=real_arm makes one for the arm), or ik, the inverse-kinematics controller"
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
    if beyond := _beyond_the_arm(card):
        raise PolicyFileError(f"{beyond}; take a policy that does without")
    warnings = []
    servo = card.servo["name"]
    if servo != "stepper":
        warnings.append(
            f"the policy was trained with servo={servo}; this arm moves as servo=stepper does, so expect less of it than of a "
            "policy trained with experiment=real_arm"
        )
    if card.cup["name"] == "rigid":
        warnings.append(
            "the policy was trained with a rigid cup and may lean on the object instead of stopping above it; what would press "
            "too deep is raised, so expect it to fail more often than one trained with experiment=real_arm"
        )
    if card.hold["name"] != "until_steady":
        warnings.append("the policy was not trained to wait until the arm is steady; on this arm every decision does")
    return warnings


def _beyond_the_arm(card: PolicyCard) -> str:
    """What a policy needs and the arm lacks, in words; empty if it lacks nothing.

    The last action and the pending reference are the computer's own commands, and a stack is made of looks that there are.
    """
    if card.actions == "torque":
        return "the policy commands torques (servo=torque), and this arm's firmware takes none, only places to go to"
    if card.observation["name"] == "velocity":
        return (
            "the policy sees the velocity of the joints (observation=velocity), which this arm does not tell, "
            "its encoders are read when it stands still"
        )
    if card.hold["name"] == "learned":
        return "the policy says how long a command acts (hold=learned), and this arm carries every move out to its end"
    if card.actions == "absolute":
        return "the policy asks for any place in one move (actions=absolute), and this arm goes limits.max_step_rad at most"
    return ""
