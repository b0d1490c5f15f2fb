"""From configuration to objects: what is composed from ``conf/`` becomes what it describes.

The command line is the only caller; below it everything takes plain arguments. Classes are chosen by name from the
open sets, never by a dotted path in a file: the configuration in a downloaded run is data, not code.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from importlib import import_module, resources
from typing import TYPE_CHECKING, Any, Final, cast

from uarm_rl import checks
from uarm_rl.checks import UsageError, did_you_mean
from uarm_rl.sim import engines
from uarm_rl.studies import studies

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from uarm_rl.sim.simulated_arm import SimulatedArm
    from uarm_rl.task.env import UArmSuctionEnv
    from uarm_rl.task.observation import PaperObservation

Settings = dict[str, Any]

# The open sets

#: Configuration group -> its classes by name. Texts, so that a command imports only what it uses.
OPEN_SETS: Final = {
    "task": {"reach": "uarm_rl.task.layouts:Reach", "obstacles": "uarm_rl.task.layouts:Obstacles"},
    "hold": {
        "fixed": "uarm_rl.task.hold:FixedHold",
        "until_steady": "uarm_rl.task.hold:UntilSteady",
        "steady_speed": "uarm_rl.task.hold:SteadySpeed",
        "learned": "uarm_rl.task.hold:LearnedHold",
    },
    "observation": {
        "paper": "uarm_rl.task.observation:PaperObservation",
        "velocity": "uarm_rl.task.observation:VelocityObservation",
        "last_action": "uarm_rl.task.observation:LastActionObservation",
        "reference": "uarm_rl.task.observation:ReferenceObservation",
        "arm_frame": "uarm_rl.task.observation:ArmFrameObservation",
        "stack": "uarm_rl.task.observation:StackedObservation",
    },
    "admission": {
        "all": "uarm_rl.learn.admission:AdmitAll",
        "not_stuck": "uarm_rl.learn.admission:NotStuck",
        "every_step": "uarm_rl.learn.admission:EveryStep",
    },
    "sampling": {"uniform": "uarm_rl.learn.sampling:Uniform", "prioritized": "uarm_rl.learn.sampling:Prioritized"},
    "reward": {"plain": "uarm_rl.task.reward:DistanceReward", "penalty": "uarm_rl.task.reward:DistanceReward"},
    "noise": {"ornstein_uhlenbeck": "uarm_rl.learn.noise:OrnsteinUhlenbeck"},
    "servo": {
        "second_order": "uarm_rl.sim.servo:SecondOrder",
        "stepper": "uarm_rl.sim.servo:Stepper",
        "instant": "uarm_rl.sim.servo:Instant",
        "torque": "uarm_rl.sim.servo:Torque",
    },
    "sim": {"pybullet": "uarm_rl.sim.pybullet_arm:SimArm", "mujoco": "uarm_rl.sim.mujoco_arm:MujocoArm"},
    "cup": {"rigid": "uarm_rl.sim.cup:rigid", "bellows": "uarm_rl.sim.cup:Bellows"},
    "agent": {
        "ddpg": "uarm_rl.learn.ddpg:DDPG",
        "sb3_td3": "uarm_rl.learn.sb3:TwinDelayed",
        "sb3_sac": "uarm_rl.learn.sb3:SoftActorCritic",
        "sb3_her": "uarm_rl.learn.sb3:Hindsight",
    },
    "logger": {
        "csv": "uarm_rl.learn.loggers:Csv",
        "tensorboard": "uarm_rl.learn.loggers:TensorBoard",
        "wandb": "uarm_rl.learn.loggers:WeightsAndBiases",
        "mlflow": "uarm_rl.learn.loggers:MLflow",
        "trackio": "uarm_rl.learn.loggers:Trackio",
    },
    "camera": {
        "openmv": "uarm_rl.real.vision.camera:OpenMVCamera",
        "webcam": "uarm_rl.real.vision.camera:Webcam",
        "file": "uarm_rl.real.vision.camera:StillImages",
        "none": "contextlib:nullcontext",
    },
    "detector": {
        "colour": "uarm_rl.real.vision.detection:ColourDetector",
        "marker": "uarm_rl.real.vision.detection:MarkerDetector",
    },
}


def build(group: str, settings: Mapping[str, Any], **runtime: Any) -> Any:
    """The object that a configuration group describes: its class by ``name``, the other keys as arguments.

    Raises :class:`ValueError` with a sentence for a name or a key that does not exist, or a value out of range.
    """
    classes = OPEN_SETS[group]
    arguments = checks.mapping(group, settings)
    name = arguments.pop("name", None)
    if not isinstance(name, str) or name not in classes:
        raise ValueError(f"{group}.name must be one of {', '.join(classes)}, got {name!r:.60}")
    module, _, made = classes[name].partition(":")
    make = getattr(import_module(module), made)
    check_keys(f"{group}={name}", make, arguments, given=runtime)
    return make(**arguments, **runtime)


def check_keys(where: str, make: Callable[..., Any], settings: Mapping[str, Any], *, given: Collection[str] = ()) -> None:
    """Raises :class:`ValueError` with a sentence unless the keys of ``settings`` are those that ``make`` takes.

    ``given`` are arguments that do not come from the configuration.
    """
    parameters = {name: one for name, one in inspect.signature(make).parameters.items() if name not in given}
    for key in settings:
        if key not in parameters:
            hint = did_you_mean(key, parameters) or f"; it has {', '.join(parameters) or 'no keys'}"
            raise ValueError(f"{where} has no key {key!r}{hint}")
    for name, parameter in parameters.items():
        if parameter.default is parameter.empty and name not in settings:
            raise ValueError(f"{where} lacks the key {name}")


def build_env(
    settings: Settings,
    *,
    time_limit_s: float | None,
    render_mode: str | None = None,
    picture_size: tuple[int, int] | None = (480, 360),
    keep_within: bool = False,
) -> UArmSuctionEnv:
    """The suction task over the simulated arm, from a whole training configuration.

    ``keep_within`` is for training, where the control steps within a decision are stored too.
    A window opens for ``render_mode="human"`` alone: ``sim.gui`` is for the one environment that somebody watches.
    Without a ``picture_size`` what is rendered are scenes, which the arm draws later.
    """
    from uarm_rl.task.env import UArmSuctionEnv

    if keep_within and checks.mapping("servo", settings["servo"]).get("name") != "second_order":
        raise UsageError(
            "admission=every_step needs servo=second_order: others begin a move anew when they are commanded again"
        )
    if keep_within and (
        settings["actions"] != "joint"
        or settings["buffer"]["hold"]["name"] == "learned"
        or settings["observation"]["name"] in ("last_action", "stack")
        or settings["task"]["name"] != "reach"
    ):
        raise UsageError(
            "admission=every_step needs task=reach, actions=joint, another hold than learned, and an observation that hangs on "
            "the present alone: paper, velocity, reference or arm_frame"
        )
    sim = checks.mapping("sim", settings["sim"]) | {"gui": render_mode == "human"}
    servo, cup = build("servo", settings["servo"]), build("cup", settings["cup"])
    arm: SimulatedArm = build("sim", sim, servo=servo, cup=cup, control_hz=settings["control_hz"])
    return UArmSuctionEnv(
        arm,
        arm,
        build("reward", settings["reward"]),
        build("hold", settings["buffer"]["hold"]),
        control_hz=settings["control_hz"],
        max_delta_rad=settings["max_delta_rad"],
        tolerance_m=settings["tolerance_m"],
        dwell_s=settings["dwell_s"],
        time_limit_s=time_limit_s,
        object_height_m=sim["object_size_m"],
        ghost_share=settings["ghost_share"],
        keep_within=keep_within,
        observation=seen(settings),
        layouts=build("task", settings["task"]),
        actions=actions_of(settings),
        tightest_m=settings["tightest_m"],
        render_mode=render_mode,
        render_modes=("rgb_array", "rgb_array_list", *(("human",) if arm.has_screen() or sim["gui"] else ())),
        take_picture=partial(arm.render, *picture_size) if picture_size else arm.scene,
    )


def actions_of(settings: Settings) -> str:
    """What the actions of a whole training configuration are; :class:`UsageError` if servo or observation do not fit them."""
    actions, servo = str(settings["actions"]), checks.mapping("servo", settings["servo"]).get("name")
    if actions == "torque" and servo != "torque":
        raise UsageError(f"actions=torque needs servo=torque; servo={servo} is told where to go")
    if servo != "torque":
        return actions
    if actions not in ("joint", "torque"):
        raise UsageError(f"with servo=torque an action is a torque, which is relative to nothing; leave actions={actions} out")
    if checks.mapping("observation", settings["observation"]).get("name") == "reference":
        raise UsageError("with servo=torque no reference is pending; take another observation, such as velocity")
    return "torque"


def slots_of(settings: Settings) -> int:
    """How many obstacles the task of a whole training configuration has at the most."""
    return int(build("task", settings["task"]).slots)


def observation_of(settings: Settings) -> dict[str, Any]:
    """What is seen, as a policy's card has it: the observation, and room for as many obstacles as the task has."""
    slots = slots_of(settings)
    return checks.mapping("observation", settings["observation"]) | ({"obstacles": slots} if slots else {})


def seen(settings: Settings) -> PaperObservation:
    """What a whole training configuration describes as the observation."""
    from uarm_rl.task.observation import WithObstacles

    kind: PaperObservation = build("observation", settings["observation"])
    slots = slots_of(settings)
    return WithObstacles(kind, slots) if slots else kind


def make_env(overrides: tuple[str, ...] = (), render_mode: str | None = None) -> UArmSuctionEnv:
    """Entry point of ``gymnasium.make("uarm_rl/UArmSuction-v0")``; ``overrides`` as on the command line of train."""
    settings = compose("train", overrides)
    render_mode = render_mode or ("human" if settings["sim"]["gui"] else None)
    return build_env(settings, time_limit_s=settings["time_limit_s"], render_mode=render_mode)


def groups() -> list[str]:
    """The configuration groups: the folders of ``conf/``."""
    return [path.name for path in resources.files("uarm_rl.conf").iterdir() if path.is_dir() and path.name != "__pycache__"]


@contextmanager
def our_hydra() -> Iterator[Any]:
    """Hydra over ``conf/``. Another that is running, for a multirun or a program around this one, is set aside meanwhile."""
    import hydra
    from hydra.core.config_store import ConfigStore
    from hydra.core.global_hydra import GlobalHydra

    ConfigStore.instance().store("installed", {"defaults": [engines.installed()]}, group="sim")  # what sim=auto stands for
    running, GlobalHydra.instance().hydra = GlobalHydra.instance().hydra, None
    try:
        with hydra.initialize_config_module("uarm_rl.conf", version_base="1.3"):
            yield GlobalHydra.instance().hydra
    finally:
        GlobalHydra.instance().hydra = running


def compose(command: str, overrides: Sequence[str] = (), *, incomplete: bool = False) -> Settings:
    """The configuration of a command as a plain dict, with ``overrides`` as on the command line.

    Raises :class:`UsageError` for an override that cannot be read or names nothing, and for a value that is missing, unless
    ``incomplete``: then it is ``"???"``; and :class:`ValueError` for a value of another kind than the configuration files have.
    """
    import hydra
    from hydra.errors import HydraException
    from omegaconf import open_dict
    from omegaconf.errors import OmegaConfBaseException

    for override in overrides:
        key, _, value = override.partition("=")
        there = choices(key.partition("@")[0])
        if there and value not in there and not re.search(r"[\[(,]", value):
            raise UsageError(f"there is no {override}{did_you_mean(value, there) or ';'} {key} is one of {', '.join(there)}")
    try:
        with our_hydra():
            cfg = hydra.compose(command.replace("-", "_"), list(overrides), return_hydra_config=True)
        with open_dict(cfg):
            chosen = cfg.pop("hydra").runtime.choices.get("sim")
        settings = plain(cfg, incomplete=incomplete)
    except (HydraException, OmegaConfBaseException) as error:
        raise UsageError(_sentence(" ".join(str(error).split()), command)) from error
    if values := [override for override in overrides if not choices(override.partition("=")[0].partition("@")[0])]:
        checks.like("", settings, _usual(command, tuple(override for override in overrides if override not in values)))
    if chosen == "auto" and settings["sim"]["name"] == "mujoco" and not incomplete:
        engines.tell()
    return settings


@cache
def _usual(command: str, groups: tuple[str, ...]) -> Settings:
    """What a command's configuration is with these choices of groups."""
    return compose(command, groups, incomplete=True)


def groups_of(command: str) -> dict[str, list[str]]:
    """The groups of a command as an override names them, such as ``buffer`` and ``hold@buffer.hold``, with their choices."""
    import hydra

    with our_hydra():
        chosen = hydra.compose(command.replace("-", "_"), return_hydra_config=True).hydra.runtime.choices
    return {key: choices(key.partition("@")[0]) for key in map(str, chosen) if not key.startswith("hydra/")}


def _sentence(text: str, command: str) -> str:
    """Hydra's own sentence in words that a user of this program knows."""
    text = text.split(" See https")[0].split(" Config search path")[0].split(" full_key: ")[0]
    if match := re.search(r"Could not override '([^']+)'\. Did you mean to override ([^?]+)\?", text):
        return f"{command} has no group {match[1]!r}; did you mean {match[2]}?"
    if match := re.search(r"Could not override '([^']+)'", text):
        return f"{command} has no setting {match[1]!r}{_near(match[1], command) or ';'} --help and --cfg job list what there is"
    if match := re.search(r"Interpolation key '([^']+)' not found", text):
        return f"{command} has no setting {match[1]!r} to put in the place of ${{{match[1]}}}{_near(match[1], command)}"
    if match := re.search(r"Ambiguous value for argument '([^=]+)=([^']*)'", text):
        return f"{match[1]}={match[2]} are several values: with -m there is a run of each; a list is {match[1]}=[{match[2]}]"
    if match := re.search(r"Sweep parameters '(.*)' requires", text):
        return f"{match[1]} are several values: with -m there is a run of each"
    if match := re.search(
        r"LexerNoViableAltException: (.*) \^|(?:Error parsing override|alternative at input) '(.*?)'(?: |$)", text
    ):
        return f"{match[1] or match[2]} cannot be read; write name=value, a list as [1,2,3], and put odd signs in quotes"
    return f"{text}; --help lists what there is"


def _near(name: str, command: str) -> str:
    """What may have been meant by the name of a setting that does not exist, as the end of a sentence."""
    group, _, key = name.rpartition(".")
    folder = resources.files("uarm_rl.conf") / group
    having = [choice for choice in choices(group) if f"\n{key}:" in (folder / f"{choice}.yaml").read_text(encoding="utf-8")]
    if having:
        return f"; it belongs to {' and '.join(f'{group}={choice}' for choice in having)}."
    choices_of = groups_of(command)
    known = [*choices_of, *flat(compose(command, incomplete=True))]
    same = [other for other in known if other.rpartition(".")[2] == name]
    same += [f"{group}={name}" for group, names in choices_of.items() if name in names]
    return f"; did you mean {same[0]}?" if same else did_you_mean(name, known)


def choices(group: str) -> list[str]:
    """The names that a configuration group can be given; empty if there is no such group."""
    folder = resources.files("uarm_rl.conf") / group
    files_there = folder.iterdir() if group and folder.is_dir() else ()
    return sorted(path.name.removesuffix(".yaml") for path in files_there if path.name.endswith(".yaml"))


def plain(cfg: DictConfig, *, incomplete: bool = False) -> Settings:
    """A configuration as a plain dict, interpolations resolved. Raises :class:`UsageError` for a missing value."""
    from omegaconf import OmegaConf

    if not incomplete and (missing := OmegaConf.missing_keys(cfg)):
        raise UsageError(f"{min(missing)}=VALUE is needed; --help tells what it is")
    settings = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(settings, dict)
    return {str(key): value for key, value in settings.items()}


def flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by their dotted names, as in ``{"agent.gamma": 0.9, "agent.hidden.0": 400}``."""
    values: dict[str, Any] = {}
    for key, value in settings.items():
        inner = dict(enumerate(value)) if isinstance(value, list) else value
        if isinstance(inner, Mapping) and inner:
            values |= {f"{key}.{name}": leaf for name, leaf in flat({str(name): leaf for name, leaf in inner.items()}).items()}
        else:
            values[key] = value
    return values


# Which runs words stand for


def combinations(overrides: Iterable[str]) -> tuple[frozenset[str], list[list[str]]]:
    """The keys that are given several values, and the overrides of every job.

    A study sweeps by itself what it varies; where the command line gives one of these keys too, the command line counts.
    """
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser

    swept: set[str] = set()
    jobs: list[list[str]] = []
    with our_hydra() as hydra:
        parser = OverridesParser.create(config_loader=hydra.config_loader)
        given = [override for override in parser.parse_overrides([*overrides]) if not override.is_hydra_override()]
        experiments = [override for override in given if override.get_key_element() == "experiment"]
        others = [override for override in given if override.get_key_element() != "experiment"]
        for experiment in BasicSweeper.split_arguments(experiments, None)[0]:
            study = studies().get("".join(experiment).partition("=")[2], {})
            words = [*experiment, *(f"{key}={','.join(map(str, values))}" for key, values in study.items())]
            jobs += BasicSweeper.split_arguments([*parser.parse_overrides(words), *others], None)[0]
            swept |= set(study)
        swept |= {override.get_key_element() for override in given if override.is_sweep_override()}
    return frozenset(swept), jobs


def search_space(overrides: Iterable[str]) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """The settings that are to be searched, as ``commands/sweep.py`` takes them, and the other words."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    space: dict[str, dict[str, Any]] = {}
    others = []
    with our_hydra() as hydra:
        for override in OverridesParser.create(config_loader=hydra.config_loader).parse_overrides([*overrides]):
            name, value = override.get_key_element(), cast(Any, override.value())
            if not override.is_sweep_override():
                others.append(str(override.input_line))
            elif override.is_interval_sweep():
                low, high, log = value.start, value.end, "log" in value.tags
                if not low < high or (log and low <= 0):
                    raise UsageError(
                        f"{override.input_line} is no interval to search: the first number must be the smaller one"
                    )
                space[name] = {"low": low, "high": high, "log": log, "whole": isinstance(low, int) and isinstance(high, int)}
            elif choices := [*override.sweep_string_iterator()]:
                space[name] = {"choices": choices}
            else:
                raise UsageError(f"{override.input_line} is no search; name the values, or give an interval(LOW,HIGH)")
    return space, others
