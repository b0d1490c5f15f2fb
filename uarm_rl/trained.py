"""What was trained: the configuration of a run on today's defaults, its policy, and what that says of itself."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from uarm_rl import checks, files
from uarm_rl.checks import UsageError
from uarm_rl.configuration import Settings, actions_of, build, choices, compose, groups_of, observation_of
from uarm_rl.files import CONFIG, POLICY

if TYPE_CHECKING:
    from uarm_rl.task.policy import Policy, PolicyCard


def value_range(settings: Settings) -> tuple[float, float]:
    """Lowest and highest value that a state can have: a step's reward at its bounds, for ever."""
    from uarm_rl.task.kinematics import HEIGHT_M, REACH_M

    gamma = settings["agent"]["gamma"]  # per control step too: a decision may take no more than one
    horizon = 1.0 / (1.0 - gamma) if gamma < 1.0 else math.inf
    lowest, highest = build("reward", settings["reward"]).bounds(2.0 * REACH_M, HEIGHT_M)
    return lowest * horizon + build("task", settings["task"]).touching, highest * horizon


def policy_card(settings: Settings) -> PolicyCard:
    """What a policy that is trained with these settings says of itself."""
    from uarm_rl.task.policy import PolicyCard

    return PolicyCard(
        **{
            key: settings[key]
            for key in ("max_delta_rad", "control_hz", "servo", "cup", "tolerance_m", "dwell_s", "episodes", "seed")
        },
        actions=actions_of(settings),
        observation=observation_of(settings),
        hold=settings["buffer"]["hold"],
        buffer=settings["buffer"]["name"],
        reward=settings["reward"]["name"],
    )


_MAX_CONFIG_BYTES: Final = 1 << 20

#: Settings that older versions had and that never did anything.
_RETIRED: Final = {"sim": ("cup_stiffness_n_m", "cup_damping_n_s_m")}


def read_run(run_dir: Path) -> Settings:
    """The configuration that a run was trained with; what an older version did not have yet has its default.

    Raises :class:`UsageError` if the folder holds no run.
    """
    settings = read_yaml(run_dir / CONFIG)
    needed = ("sim", "servo", "reward", "buffer", "control_hz", "max_delta_rad", "tolerance_m", "dwell_s", "time_limit_s")
    if missing := [key for key in needed if key not in settings]:
        raise UsageError(f"{run_dir / CONFIG} lacks {missing[0]}; it was not written by uarm-rl train")
    for group in ("sim", "servo", "reward", "buffer"):
        checks.mapping(group, settings[group])
    checks.number("time_limit_s", settings["time_limit_s"], low=0.0, open_low=True)
    for group, retired in _RETIRED.items():
        settings[group] = {key: value for key, value in settings[group].items() if key not in retired}
    settings["sim"].setdefault("name", "pybullet")  # the only engine that older versions had
    names = {group: value.get("name") for group, value in settings.items() if isinstance(value, Mapping)}
    chosen = tuple(f"{group}={name}" for group, name in sorted(names.items()) if name in choices(group))
    return merged(_defaults(chosen), settings)


def in_engine(settings: Settings, sim: Mapping[str, Any] | None) -> Settings:
    """A run's settings in another engine, if one is given; the object stays the same."""
    kept = {key: settings["sim"][key] for key in ("object_size_m", "object_mass_kg")}
    return settings | {"sim": {**sim, **kept}} if sim else settings


def read_yaml(path: Path) -> Settings:
    """A mapping from a YAML file that may come from anywhere: no tags, no aliases, no depths."""
    import yaml

    if not path.parent.is_dir():
        raise UsageError(f"there is no run folder {path.parent}; a run is results/NAME/seedN, made by uarm-rl train")
    try:
        text = files.read(path, at_most=_MAX_CONFIG_BYTES).decode()
        depth = 0
        for event in yaml.parse(text, yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > 20:
                raise UsageError(f"{path} refers to its own parts or is nested too deeply; uarm-rl writes no such file")
        return checks.mapping("it", yaml.safe_load(text))
    except FileNotFoundError:
        seeds = sorted(path.parent.glob(f"seed*/{path.name}"))
        meant = f"did you mean {seeds[0].parent}?" if seeds else "a run is results/NAME/seedN, made by uarm-rl train"
        raise UsageError(f"{path.parent} holds no {path.name}; {meant}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise UsageError(f"{path} is damaged: {' '.join(str(error).split())}") from None


@cache
def _defaults(chosen: tuple[str, ...]) -> Settings:
    return compose("train", chosen)


def merged(defaults: Settings, settings: Settings) -> Settings:
    """``settings`` over ``defaults``; a group of another name is taken as it is, since its keys are others."""
    result = defaults | settings
    for key, value in settings.items():
        default = defaults.get(key)
        if (
            isinstance(value, dict)
            and isinstance(default, dict)
            and value.get("name", default.get("name")) == default.get("name")
        ):
            result[key] = merged(default, value)
    return result


def load_policy(run_dir: Path, name: str | None, settings: Settings) -> Policy:
    """The policy of a run, or with the name ``ik`` the controller. Raises :class:`UsageError` if there is none that fits."""
    from uarm_rl.task.policy import ActorPolicy, InverseKinematicsPolicy

    if name == "ik":
        if actions_of(settings) != "joint" or settings["buffer"]["hold"]["name"] == "learned":
            raise UsageError(
                "policy=ik moves relative to the current joints and leaves the hold alone; this run has other actions"
            )
        return InverseKinematicsPolicy(settings["max_delta_rad"])
    if name == "planner":
        return _planner(settings)
    if name is not None:
        known = "policy=ik, or policy=planner for a task with obstacles"
        raise UsageError(f"policy={name} is unknown; leave it out for the run's own policy, or give {known}")
    if not (run_dir / POLICY).exists():
        raise UsageError(f"{run_dir} holds no {POLICY}: its training is not finished; continue it with resume=true")
    policy = ActorPolicy.load(run_dir / POLICY)
    own = {"observation": policy.card.observation, "actions": policy.card.actions}
    if changed := checks.differences({"observation": observation_of(settings), "actions": actions_of(settings)}, own):
        raise UsageError(f"{run_dir / POLICY} is not of this run: the run has {', '.join(changed)}")
    return policy


def _planner(settings: Settings) -> Policy:
    """The planner, with the same actions as the controller."""
    if settings["task"]["name"] != "obstacles" or actions_of(settings) != "joint":
        raise UsageError("policy=planner goes past obstacles, relative to the current joints; this run has others, or none")
    from uarm_rl.task.planner import PlannerPolicy

    return PlannerPolicy(settings["max_delta_rad"], settings["task"]["slots"])


def words_for(settings: Settings) -> list[str]:
    """The words of ``uarm-rl train`` that make a run's settings: choices of groups, and what differs from them.

    Raises :class:`UsageError` if none do: the settings are of another version.
    """
    usual, chosen = _defaults(()), []
    for group, names in groups_of("train").items():
        name, default = (_name_in(of, group.partition("@")[2] or group) for of in (settings, usual))
        if name in names and (name != default or group == "sim"):  # sim=auto may be another tomorrow
            chosen.append(f"{group}={name}")
    words = [*chosen, *_changes("", compose("train", chosen), settings)]
    if compose("train", words) != settings:
        raise UsageError("no words of this version of uarm-rl give its settings")
    return words


def _name_in(settings: Mapping[str, Any], place: str) -> str | None:
    found: Any = settings
    for part in (*place.split("."), "name"):
        found = found.get(part) if isinstance(found, Mapping) else None
    return found if isinstance(found, str) else None


def _changes(prefix: str, usual: Mapping[str, Any], settings: Mapping[str, Any]) -> Iterator[str]:
    """Words for what ``settings`` has otherwise than ``usual``."""
    for key, value in settings.items():
        before = usual.get(key)
        if isinstance(before, Mapping) and isinstance(value, Mapping):
            yield from _changes(f"{prefix}{key}.", before, value)
        elif before != value:
            bare = isinstance(value, str) and re.fullmatch(r"[A-Za-z_][\w-]*", value)
            yield f"{prefix}{key}={value if bare else json.dumps(value, ensure_ascii=False)}"
