"""The command line, and the only place where configuration is read: below this file everything takes plain arguments.

Hydra composes the configuration from ``conf/``; it is turned into a plain dict at once. Classes are chosen by name from
the small dicts below, never by a dotted path in a file: the configuration in a downloaded run is data, not code.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from uarm_rl import checks
from uarm_rl.usage import (
    COMMANDS,
    OVERVIEW,
    UsageError,
    as_overrides,
    config_name,
    explain,
    groups,
    help_text,
    printable,
)

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from uarm_rl.env import UArmSuctionEnv
    from uarm_rl.policy import Policy
    from uarm_rl.real.trials import Search

Settings = dict[str, Any]

# ------------------------------------------------------------------------------------------ from names to objects


def _holds() -> dict[str, Callable[..., Any]]:
    from uarm_rl.hold import FixedHold, UntilSteady

    return {"fixed": FixedHold, "until_steady": UntilSteady}


def _admissions() -> dict[str, Callable[..., Any]]:
    from uarm_rl.admission import AdmitAll, NotStuck

    return {"all": AdmitAll, "not_stuck": NotStuck}


def _rewards() -> dict[str, Callable[..., Any]]:
    from uarm_rl.reward import DistanceReward

    return {"plain": DistanceReward, "penalty": DistanceReward}


def _noises() -> dict[str, Callable[..., Any]]:
    from uarm_rl.noise import Gaussian, OrnsteinUhlenbeck

    return {"ornstein_uhlenbeck": OrnsteinUhlenbeck, "gaussian": Gaussian}


def _servos() -> dict[str, Callable[..., Any]]:
    from uarm_rl.sim.servo import Instant, SecondOrder, Stepper

    return {"second_order": SecondOrder, "stepper": Stepper, "instant": Instant}


def _agents() -> dict[str, Callable[..., Any]]:
    from uarm_rl.ddpg import DDPG

    return {"ddpg": DDPG}


def _cameras() -> dict[str, Callable[..., Any]]:
    from uarm_rl.real.camera import OpenMVCamera, StillImages, Webcam

    def file(path: str) -> StillImages:
        return StillImages(Path(path))

    return {"openmv": OpenMVCamera, "webcam": Webcam, "file": file, "none": nullcontext}


def _detectors() -> dict[str, Callable[..., Any]]:
    from uarm_rl.real.detection import ColourDetector, MarkerDetector

    return {"colour": ColourDetector, "marker": MarkerDetector}


#: The open sets: configuration group -> its classes by name. Functions, so that a command imports only what it uses.
OPEN_SETS: Final = {
    "hold": _holds,
    "admission": _admissions,
    "reward": _rewards,
    "noise": _noises,
    "servo": _servos,
    "agent": _agents,
    "camera": _cameras,
    "detector": _detectors,
}


def build(group: str, settings: Mapping[str, Any], **runtime: Any) -> Any:
    """The object that a configuration group describes: its class by ``name``, the other keys as arguments.

    Raises :class:`ValueError` with a sentence for a name or a key that does not exist, or a value out of range.
    """
    classes = OPEN_SETS[group]()
    arguments = checks.mapping(group, settings)
    name = arguments.pop("name", None)
    if name not in classes:
        raise ValueError(f"{group} has no {name!r}; choose one of {', '.join(classes)}")
    try:
        return classes[name](**arguments, **runtime)
    except TypeError as error:  # a missing or an unknown argument
        raise ValueError(f"the keys of {group}={name} do not fit: {error}") from error


def build_env(
    settings: Settings,
    *,
    time_limit_s: float | None,
    render_mode: str | None = None,
    picture_size: tuple[int, int] = (480, 360),
) -> UArmSuctionEnv:
    """The suction task over the simulated arm, from a whole training configuration.

    A window opens for ``render_mode="human"`` alone: ``sim.gui`` is for the one environment that somebody watches.
    """
    from uarm_rl.env import UArmSuctionEnv
    from uarm_rl.sim.arm import SimArm

    sim = checks.mapping("sim", settings["sim"]) | {"gui": render_mode == "human"}
    try:
        arm = SimArm(build("servo", settings["servo"]), control_hz=settings["control_hz"], **sim)
    except TypeError as error:
        raise ValueError(f"the keys of sim do not fit: {error}") from error
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
        render_mode=render_mode,
        take_picture=partial(arm.render, *picture_size),
    )


def make_env(overrides: tuple[str, ...] = (), render_mode: str | None = None) -> UArmSuctionEnv:
    """Entry point of ``gymnasium.make("uarm_rl/UArmSuction-v0")``; ``overrides`` as on the command line of train."""
    settings = compose("train", overrides)
    render_mode = render_mode or ("human" if settings["sim"]["gui"] else None)
    return build_env(settings, time_limit_s=settings["time_limit_s"], render_mode=render_mode)


def compose(command: str, overrides: tuple[str, ...] = ()) -> Settings:
    """The configuration of a command as a plain dict, with ``overrides`` as on the command line."""
    import hydra

    with hydra.initialize_config_module("uarm_rl.conf", version_base="1.3"):
        return _plain(hydra.compose(config_name(command), list(overrides)))


def _plain(cfg: DictConfig) -> Settings:
    """A configuration as a plain dict, interpolations resolved. Raises :class:`UsageError` for a missing value."""
    from omegaconf import OmegaConf

    if missing := OmegaConf.missing_keys(cfg):
        raise UsageError(f"{min(missing)}=VALUE is needed; --help tells what it is")
    settings = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(settings, dict)
    return {str(key): value for key, value in settings.items()}


# -------------------------------------------------------------------------------------------------- the commands


def train(settings: Settings) -> None:
    """Train one policy in its run folder."""
    import numpy as np
    import torch
    import yaml

    from uarm_rl import positions, session
    from uarm_rl.env import ACTION_SIZE
    from uarm_rl.evaluate import successes
    from uarm_rl.observation import SIZE
    from uarm_rl.pipeline import InlineEnv, SubprocessEnv
    from uarm_rl.replay import ReplayBuffer

    torch.set_num_threads(1)  # two threads are slower at this size, and would change the last bits
    for name in ("resume", "overwrite", "simulate_beside", "tensorboard"):
        checks.boolean(name, settings[name])
    run_dir = _run_folder(settings)
    transient = ("resume", "overwrite", "results_dir", "simulate_beside", "tensorboard")
    kept = {key: value for key, value in settings.items() if key not in transient}
    kept["sim"] = checks.mapping("sim", settings["sim"]) | {"gui": False}
    if settings["resume"] and session.is_finished(run_dir):
        before = read_run(run_dir)
        changed = [key for key in kept if key in before and before[key] != kept[key]]
        if changed:
            raise session.RunFolderError(
                f"{run_dir} is finished, with another {changed[0]}; name=NAME or seed=N makes another run, overwrite=true "
                "deletes this one"
            )
        print(f"{run_dir} is finished; nothing to do")
        return
    schedule = session.Schedule(**{name: settings[name] for name in session.Schedule.__dataclass_fields__})
    seeds = np.random.SeedSequence(settings["seed"]).spawn(4)
    env_seed, network_seed = (int(sequence.generate_state(1)[0]) for sequence in seeds[:2])
    # Everything is built, and so every value checked, before the folder is touched.
    watched = "human" if checks.boolean("sim.gui", settings["sim"]["gui"]) else None
    make_training_env = partial(build_env, settings, time_limit_s=None, render_mode=watched)
    validation_env = build_env(settings, time_limit_s=settings["time_limit_s"])
    networks = torch.Generator().manual_seed(network_seed)
    agent = build("agent", settings["agent"], action_size=ACTION_SIZE, generator=networks)
    replay = ReplayBuffer(
        settings["buffer"]["capacity"],
        observation_size=SIZE,
        action_size=ACTION_SIZE,
        generator=np.random.default_rng(seeds[2]),
    )
    noise = build("noise", settings["noise"], action_size=ACTION_SIZE, generator=np.random.default_rng(seeds[3]))
    admission = build("admission", settings["buffer"]["admission"])
    policy = agent.policy(_policy_metadata(settings))
    validation_positions = positions.load_packaged("validation_positions.csv")

    config = yaml.safe_dump(kept, sort_keys=False)
    with session.claim(run_dir, config, resume=settings["resume"], overwrite=settings["overwrite"]):
        spare = build("agent", settings["agent"], action_size=ACTION_SIZE, generator=torch.Generator())
        seconds = session.estimate_s(schedule, spare, validation_env, beside=settings["simulate_beside"])
        experiences = schedule.episodes * schedule.experiences_per_episode
        duration = f"about {round(seconds / 60)} min" if seconds > 60 else "less than a minute"
        print(f"{run_dir}: {experiences:,} decisions and gradient steps in all, {duration}")
        env = (SubprocessEnv if settings["simulate_beside"] else InlineEnv)(make_training_env, env_seed)
        try:
            finished = session.run(
                run_dir,
                env,
                agent,
                policy,
                replay,
                admission,
                noise,
                schedule,
                value_range=_value_range(settings),
                validate=lambda policy: successes(validation_env, policy, validation_positions),
                tensorboard=settings["tensorboard"],
                say=print,
            )
        finally:
            env.close()
            validation_env.close()
    if finished:
        print(f"trained: {run_dir}; test it with: uarm-rl evaluate run={run_dir}")
    else:
        print(f"stopped: {run_dir}; the same command with resume=true continues it")
        raise SystemExit(130)


def _run_folder(settings: Settings) -> Path:
    name, seed = checks.text("name", settings["name"]), checks.integer("seed", settings["seed"], low=0, high=2**32)
    if not re.fullmatch(r"\w[\w.,+ -]*", name):
        raise UsageError(
            f"name={name} is no name of a folder; take letters, digits and . , + - _, and results_dir=PATH for paths"
        )
    return _path(settings, "results_dir") / name / f"seed{seed}"


def _path(settings: Settings, name: str) -> Path:
    return Path(checks.text(name, settings[name]))


def _value_range(settings: Settings) -> tuple[float, float]:
    """Lowest and highest value that a state can have: a step's reward at its bounds, for ever."""
    from uarm_rl.kinematics import HEIGHT_M, REACH_M

    gamma = settings["agent"]["gamma"]
    horizon = 1.0 / (1.0 - gamma) if gamma < 1.0 else math.inf
    lowest, highest = build("reward", settings["reward"]).bounds(2.0 * REACH_M, HEIGHT_M)
    return lowest * horizon, highest * horizon


def _policy_metadata(settings: Settings) -> Settings:
    """What a user of the policy has to know to run it as it was trained."""
    return {
        "max_delta_rad": settings["max_delta_rad"],
        "control_hz": settings["control_hz"],
        "hold": settings["buffer"]["hold"],
        "servo": settings["servo"],
        "tolerance_m": settings["tolerance_m"],
        "dwell_s": settings["dwell_s"],
        "buffer": settings["buffer"]["name"],
        "reward": settings["reward"]["name"],
        "episodes": settings["episodes"],
        "seed": settings["seed"],
    }


_MAX_CONFIG_BYTES: Final = 1 << 20


def read_run(run_dir: Path) -> Settings:
    """The configuration that a run was trained with. Raises :class:`UsageError` if the folder holds no run."""
    import yaml

    from uarm_rl import files
    from uarm_rl.session import CONFIG

    if not run_dir.is_dir():
        raise UsageError(f"there is no run folder {run_dir}; a run is results/NAME/seedN, made by uarm-rl train")
    path = run_dir / CONFIG
    try:
        text = files.read(path, at_most=_MAX_CONFIG_BYTES).decode()
        depth = 0
        for event in yaml.parse(text, yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > 20:
                raise UsageError(f"{path} refers to its own parts or is nested too deeply; uarm-rl writes no such file")
        settings = yaml.safe_load(text)
    except FileNotFoundError:
        raise UsageError(f"{run_dir} holds no {CONFIG}; a run is results/NAME/seedN, made by uarm-rl train") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise UsageError(f"{path} is damaged: {' '.join(str(error).split())}") from None
    needed = ("sim", "servo", "reward", "buffer", "control_hz", "max_delta_rad", "tolerance_m", "dwell_s", "time_limit_s")
    missing = [key for key in needed if not isinstance(settings, dict) or key not in settings]
    if missing:
        raise UsageError(f"{path} lacks {missing[0]}; it was not written by uarm-rl train")
    for group in ("sim", "servo", "reward", "buffer"):
        checks.mapping(group, settings[group])
    checks.number("time_limit_s", settings["time_limit_s"], low=0.0, open_low=True)
    return dict(settings)


def _load_policy(run_dir: Path, name: str | None, settings: Settings) -> Policy:
    from uarm_rl.policy import FILE, ActorPolicy, InverseKinematicsPolicy

    if name == "ik":
        return InverseKinematicsPolicy(settings["max_delta_rad"])
    if name is not None:
        raise UsageError(f"policy={name} is unknown; leave it out for the run's own policy, or give policy=ik")
    if not (run_dir / FILE).exists():
        raise UsageError(f"{run_dir} holds no {FILE}: its training is not finished; continue it with resume=true")
    return ActorPolicy.load(run_dir / FILE)


def evaluate(settings: Settings) -> None:
    """Test policies on fixed positions and write one CSV row a position."""
    results_dir = _path(settings, "results_dir")
    changed = ["positions"] if settings["positions"] != "test" else []
    changed += [key for key in ("tolerance_m", "time_limit_s", "hold") if settings.get(key) is not None]
    file = checks.text("out", settings["out"] or "evaluation.csv")
    if changed and (not settings["out"] or (file == "evaluation.csv" and not settings["run"])):
        raise UsageError(
            f"{changed[0]} changes the test, so give out=FILE for its result; evaluation.csv is for the standard test"
        )
    if settings["run"]:
        run_dir = _path(settings, "run")
        _evaluate_run(settings, run_dir, read_run(run_dir), Path(file) if settings["out"] else run_dir / file)
        return
    if Path(file).name != file:
        raise UsageError(
            f"out={file} takes the result of one run, so give run=DIR too; out=NAME.csv without a folder is that file in "
            "the folder of every run"
        )
    if not file.endswith(".csv") or file == "progress.csv":
        raise UsageError(f"out={file} is no name for an evaluation in a run's folder; take another that ends in .csv")
    # The baseline has no training: it does the task of a default one, in a folder beside the runs.
    ik = settings["policy"] == "ik"
    run_dirs = [results_dir / "ik" / "seed0"] if ik else _trained_runs(results_dir)
    done = [run_dir for run_dir in run_dirs if (run_dir / file).exists() and not settings["overwrite"]]
    for run_dir in run_dirs:
        if run_dir not in done:
            _evaluate_run(settings, run_dir, compose("train") if ik else read_run(run_dir), run_dir / file)
    if done:
        print(f"evaluated already, {file} is there (overwrite=true evaluates again): {', '.join(map(str, done))}")


def _trained_runs(results_dir: Path) -> list[Path]:
    from uarm_rl.policy import FILE

    trained = sorted(path.parent for path in results_dir.glob(f"*/seed*/{FILE}"))
    if not trained:
        raise UsageError(
            f"{results_dir} holds no trained run; make one with uarm-rl train, or name its folder: results_dir=DIR"
        )
    return trained


def _evaluate_run(settings: Settings, run_dir: Path, run_settings: Settings, out: Path) -> None:
    from tqdm import tqdm

    from uarm_rl import positions
    from uarm_rl.evaluate import COLUMNS, TRACES, Row, measure, trace_rows
    from uarm_rl.evaluate import evaluate as evaluate_policy
    from uarm_rl.logbook import write_rows
    from uarm_rl.sim.servo import rise_time_s

    if out.exists() and not settings["overwrite"]:
        raise UsageError(f"{out} exists already; overwrite=true replaces it, out=FILE writes elsewhere")
    run_settings = run_settings | {key: settings[key] for key in ("tolerance_m", "time_limit_s") if settings[key] is not None}
    if settings.get("hold"):
        run_settings = run_settings | {"buffer": run_settings["buffer"] | {"hold": settings["hold"]}}
    where = positions.load_named(str(settings["positions"]))
    policy = _load_policy(run_dir, settings["policy"], run_settings)
    make = partial(build_env, run_settings, time_limit_s=run_settings["time_limit_s"])
    make().close()  # a bad value shows here, as a sentence, and not in a worker
    cores = len(os.sched_getaffinity(0))
    workers = cores if settings["workers"] is None else checks.integer("workers", settings["workers"], low=1)
    traced = checks.integer("traces", settings["traces"], low=0)
    common_reward = build("reward", settings["common_reward"])
    control_hz = run_settings["control_hz"]
    conditions = {
        "tolerance_m": run_settings["tolerance_m"],
        "hold": str(build("hold", run_settings["buffer"]["hold"])),
        "control_hz": control_hz,
        "servo_rise_s": rise_time_s(build("servo", run_settings["servo"])),
        "sigma": run_settings["reward"]["sigma"],
    }
    rows: list[Row] = []
    traces: list[Row] = []
    episodes = evaluate_policy(make, policy, where, workers=min(workers, len(where)))
    bar = tqdm(episodes, total=len(where), unit="position", desc=str(run_dir), dynamic_ncols=True)
    for number, episode in enumerate(bar):
        rows.append(measure(number, episode, common_reward, control_hz=control_hz) | conditions)
        if number < traced:
            traces += trace_rows(number, episode, control_hz=control_hz)
    out.parent.mkdir(parents=True, exist_ok=True)
    if traced:  # first, so that a result that is there has its traces
        write_rows(out.with_name(f"{out.stem}-traces.csv"), TRACES, traces)
    write_rows(out, COLUMNS, rows)
    successes = sum(bool(row["success"]) for row in rows)
    print(f"{run_dir}: {successes} of {len(rows)} positions reached; {out}")


def report(settings: Settings) -> None:
    """Rebuild table and figures."""
    from uarm_rl.report import report as write_report

    print(write_report(_path(settings, "results_dir")))


def render(settings: Settings) -> None:
    """Film a policy."""
    import numpy as np

    from uarm_rl.render import film, write_film

    run_dir = _path(settings, "run")
    run_settings = read_run(run_dir)
    policy = _load_policy(run_dir, settings["policy"], run_settings)
    out = _path(settings, "out") if settings["out"] else run_dir / "episode.gif"
    size = (checks.integer("width", settings["width"], low=64), checks.integer("height", settings["height"], low=64))
    episodes = checks.integer("episodes", settings["episodes"], low=1)
    first_seed = checks.integer("seed", settings["seed"], low=0)
    resets: list[dict[str, Any]] = [{"seed": first_seed + number} for number in range(episodes)]
    if settings["position"] is not None:
        resets = [{"options": {"object_position": np.array(settings["position"], np.float64)}}]
    time_limit_s = run_settings["time_limit_s"]
    with_pictures = partial(build_env, run_settings, time_limit_s=time_limit_s, render_mode="rgb_array_list", picture_size=size)
    env = with_pictures()
    try:
        pictures, successes = film(env, policy, resets)
    finally:
        env.close()
    write_film(out, pictures, frames_per_second=run_settings["control_hz"])
    print(f"{out}: {len(pictures)} pictures, {successes} of {len(resets)} episodes successful")


# --------------------------------------------------------------------------------------- the commands at the real arm


def run_real(settings: Settings) -> None:
    """Trials of a policy on the real arm."""
    import numpy as np
    import yaml

    from uarm_rl import lab
    from uarm_rl.real.trials import GivenTarget, RandomTargets, Task

    dry_run = checks.boolean("dry_run", settings["dry_run"])
    size_m = lab.object_size(settings["object_size_m"])
    limits = lab.limits(settings["limits"])
    policy, metadata, folder = _policy_for_the_arm(settings)
    for warning in lab.check_policy(metadata, limits.max_step_rad):
        print(f"warning: {warning}", file=sys.stderr)
    task = Task(
        hold=build("hold", metadata["hold"]),
        **{key: metadata[key] for key in ("control_hz", "max_delta_rad", "tolerance_m", "dwell_s")},
        **{key: settings[key] for key in ("time_limit_s", "press_m", "max_press_m")},
    )
    lab.check_press(size_m[2], task.max_press_m, limits)
    target = None if settings["target"] is None else lab.target(settings["target"], task.max_press_m, limits)
    generator = np.random.default_rng(checks.integer("seed", settings["seed"], low=0))
    arm_settings = {"limits": limits, "feed": lab.feed(metadata, settings["feed"]), "control_hz": metadata["control_hz"]}

    def open_search(stack: ExitStack) -> Search:
        if target is not None:
            return GivenTarget(target)
        if dry_run and settings["camera"]["name"] != "file":
            return RandomTargets(generator, size_m[2])
        return _camera_search(settings, stack, size_m)

    lab.run_trials_and_record(
        policy,
        task,
        open_search,
        partial(lab.rehearse, print, **arm_settings)
        if dry_run
        else partial(lab.connect, settings["port"], speed=settings["speed"], **arm_settings),
        None if target is not None else lab.scattered(generator),
        trials=checks.integer("trials", settings["trials"], low=1),
        folder=None if dry_run else Path(settings["out"] or folder / "real"),
        overwrite=checks.boolean("overwrite", settings["overwrite"]),
        config=yaml.safe_dump(settings, sort_keys=False),
        say=partial(print, flush=True),
    )


def _policy_for_the_arm(settings: Settings) -> tuple[Policy, Settings, Path]:
    """The policy, its metadata, and the folder whose ``real/`` takes its results."""
    from uarm_rl import lab
    from uarm_rl.policy import InverseKinematicsPolicy

    if settings["policy"] == "ik":
        metadata = _policy_metadata(compose("train", ("experiment=real_arm",)))
        return InverseKinematicsPolicy(metadata["max_delta_rad"]), metadata, Path(settings["results_dir"]) / "ik" / "seed0"
    path = Path(str(settings["policy"]))
    policy = lab.load_policy(path)
    return policy, policy.metadata, path if path.is_dir() else path.parent


def _camera_search(settings: Settings, stack: ExitStack, size_m: tuple[float, float, float]) -> Search:
    """The search with the configured camera, which ``stack`` closes."""
    from uarm_rl import lab

    if settings["camera"]["name"] == "none":
        raise UsageError("without a camera the object has to be told: give --target X Y Z (metres), or choose a camera")
    emulated = settings["port"] is not None and lab.is_emulated(settings["port"])
    detector = build("detector", settings["detector"])
    return lab.camera_search(
        stack.enter_context(_camera(settings)),
        detector,
        Path(settings["calibration"]),
        emulated=emulated,
        object_size_m=size_m,
        whole_object=settings["detector"]["name"] == "colour",
    )


def _camera(settings: Settings) -> Any:
    """The configured camera; that of an emulated arm if no other is named."""
    from uarm_rl import lab

    camera = settings["camera"]
    if camera["name"] == "openmv" and camera["port"] is None and settings["port"] and lab.is_emulated(settings["port"]):
        camera = camera | {"port": lab.emulated_camera(settings["port"])}
    return build("camera", camera)


def jog(settings: Settings) -> None:
    """Move one joint of the real arm by a few degrees."""
    from uarm_rl import lab

    arm_settings = {"limits": lab.limits(settings["limits"]), "feed": settings["feed"], "speed": settings["speed"]}
    print("\n".join(lab.jog(settings["port"], settings["joint"], settings["degrees"], **arm_settings)))


def doctor(settings: Settings) -> None:
    """Look at everything that the real arm needs; exit code 1 if there is a problem."""
    from uarm_rl import lab

    findings = []
    for finding in lab.examine(
        settings["port"],
        None if settings["camera"]["name"] == "none" else partial(_camera, settings),
        Path(settings["calibration"]),
        Path(settings["policy"]),
        lab.limits(settings["limits"]).max_step_rad,
    ):
        print(finding, flush=True)
        findings.append(finding)
    problems = sum(finding.state == "problem" for finding in findings)
    print(f"{problems} problem{'s' * (problems != 1)}")
    if problems:
        raise SystemExit(1)


def calibrate_camera(settings: Settings) -> None:
    """Measure the camera's lens with pictures of a board, taken now or in a folder already."""
    from uarm_rl import lab
    from uarm_rl.real import collecting
    from uarm_rl.real.calibration import Board

    board, folder, out = Board(**settings["board"]), Path(settings["pictures"]), Path(settings["out"])
    count = checks.integer("count", settings["count"], low=1)
    with build("camera", settings["camera"]) as camera:
        if camera is not None:
            collecting.collect_board_pictures(camera, board, folder, lab.ask, count)
    intrinsics, report = collecting.calibrate_intrinsics_from_folder(folder, board, settings["camera"]["name"])
    intrinsics.save(out)
    print(f"{report}\n{out}: the lens; go on with uarm-rl calibrate-hand-eye")


def calibrate_hand_eye(settings: Settings) -> None:
    """Measure where the camera sits on the arm with touched marks, touched now or in a file already."""
    from uarm_rl import lab
    from uarm_rl.real import collecting
    from uarm_rl.real.calibration import Intrinsics, calibrate_hand_eye, nominal

    detector, path, out = build("detector", settings["detector"]), Path(settings["observations"]), Path(settings["out"])
    lens = Intrinsics.load(Path(settings["lens"]))
    arm_settings = {"limits": lab.limits(settings["limits"]), "feed": settings["feed"], "speed": settings["speed"]}
    with ExitStack() as stack:
        camera = stack.enter_context(_camera(settings))
        if camera is not None:
            stack.enter_context(lab.stopped_by_signals())
            lens.check_size(camera.read())
            arm = stack.enter_context(lab.connect(settings["port"], **arm_settings))
            arm.home()
            collecting.collect_observations(arm, camera, detector, nominal(lens.image_size), path, lab.ask)
    calibration, report = calibrate_hand_eye(collecting.read_observations(path, lens, detector), lens)
    calibration.save(out)
    print(f"{report}\n{out}: lens and mount, what run-real needs")


def emulate(settings: Settings) -> None:
    """Emulate the arm and the camera on two pseudo-terminals until Ctrl-C."""
    from uarm_rl.emulator.emulate import emulate as serve

    serve(**{key: value for key, value in settings.items() if key != "results_dir"})


# --------------------------------------------------------------------------------------------------- the front door


def main() -> None:
    """Run the command that ``sys.argv`` names. Exit codes: 0 done, 1 it failed, 2 the command line is wrong."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: one observation is no work for two threads
    try:
        _dispatch(sys.argv[1:])
        sys.stdout.flush()
    except BrokenPipeError:  # the reader, `head` say, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        _fail("interrupted; what was saved before is whole", 130)
    except Exception as error:
        if os.environ.get("UARM_RL_TRACEBACK"):
            raise
        _fail(*explain(error))


def _dispatch(words: list[str]) -> None:
    if _completes(words):
        return
    if not words or words[0] in ("-h", "--help"):
        print(OVERVIEW.format(commands="\n".join(f"  {name:18} {text}" for name, text in COMMANDS.items())))
    elif words[0] == "--version":
        from uarm_rl import __version__

        print(f"uarm-rl {__version__}")
    else:
        words = [words[0], *as_overrides(words[1:])]
        _check_words(words)
        _run(words[0], words[1:])


def _fail(sentence: str, code: int) -> None:
    print(f"error: {printable(sentence)}", file=sys.stderr)
    raise SystemExit(code)


#: What a user of this program needs of Hydra. Its other switches and settings (callbacks, search paths, logging)
#: could run code that a configuration names.
_FLAGS: Final = ("-m", "--multirun", "-h", "--help", "-c", "--cfg")
_HYDRA_OVERRIDES: Final = ("hydra/launcher=basic", "hydra/launcher=joblib")


def _check_words(words: list[str]) -> None:
    command, *rest = words
    if command not in COMMANDS:
        near = difflib.get_close_matches(command, COMMANDS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(COMMANDS)}"
        raise UsageError(f"there is no command {command!r}; {hint}")
    for word in rest:
        if word.startswith("-") and word not in _FLAGS:
            raise UsageError(f"{word} is no option of uarm-rl {command}; it takes name=value or --name value, -m and --help")
        if word.startswith(("+", "~")):
            raise UsageError(f"{word} adds or removes a setting; settings can only be changed, with name=value")
        if word.startswith("hydra") and word not in _HYDRA_OVERRIDES and not _is_job_count(word):
            raise UsageError(f"{word} is not for the command line; of Hydra's own settings only hydra/launcher=joblib is")
        name, _, value = word.partition("=")
        if name.strip("/ ").partition("@")[0] in groups() and not re.fullmatch(r"[\w,()\[\]* ]*", value):
            raise UsageError(f"{word} is no choice of a group; a choice is a name (--help lists them), not a path")


def _is_job_count(word: str) -> bool:
    name, _, value = word.partition("=")
    return name == "hydra.launcher.n_jobs" and value.lstrip("-").isdigit()


def _run(command: str, words: list[str]) -> None:
    if {"-h", "--help"} & set(words):
        print(help_text(command))
    elif {"-c", "--cfg"} & set(words):
        import yaml

        overrides = tuple(word for word in words if not word.startswith("-") and word != "job")
        print(yaml.safe_dump(compose(command, overrides), sort_keys=False), end="")
    elif {"-m", "--multirun"} & set(words):
        _run_many(command, [word for word in words if not word.startswith("-")])
    else:
        _task(command)(compose(command, tuple(words)))


def _task(command: str) -> Callable[[Settings], None]:
    tasks: dict[str, Callable[[Settings], None]] = {
        "train": train,
        "evaluate": evaluate,
        "report": report,
        "render": render,
        "run-real": run_real,
        "jog": jog,
        "doctor": doctor,
        "calibrate-camera": calibrate_camera,
        "calibrate-hand-eye": calibrate_hand_eye,
        "emulate": emulate,
    }
    return tasks[command]


def _run_many(command: str, overrides: list[str]) -> None:
    """Every combination of the overrides' values, one after the other or through ``hydra/launcher=joblib``.

    A job that fails is named at once and does not keep the others from running; the first failure is raised at the end.
    """
    import hydra
    from hydra.core.hydra_config import HydraConfig

    def task(cfg: DictConfig) -> None:
        try:
            _task(command)(_plain(cfg))
        except Exception as error:
            job = " ".join(HydraConfig.get().overrides.task)
            print(f"failed: {job}: {printable(explain(error)[0])}", file=sys.stderr)
            raise

    results_dir = next((word.partition("=")[2] for word in reversed(overrides) if word.startswith("results_dir=")), "results")
    for path in (Path(results_dir) / ".hydra", Path(results_dir) / ".hydra" / "multirun.yaml"):
        if path.is_symlink():
            raise UsageError(f"{path} is a link, and Hydra would write through it; remove it")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # exceptions come through to main(), which explains them
    sys.argv = [sys.argv[0], "--multirun", *overrides]
    hydra.main(config_path="pkg://uarm_rl.conf", config_name=config_name(command), version_base="1.3")(task)()


def _completes(words: list[str]) -> bool:
    """Answer the shell's completion queries: commands here, everything behind a command by Hydra."""
    if not words or words[0] not in ("-sc", "--shell-completion"):
        return False
    if len(words) != 2 or not re.fullmatch(r"(install|uninstall|query)=(bash|fish|zsh)", words[1]):
        raise UsageError("-sc takes install=SHELL or uninstall=SHELL, where SHELL is bash, fish or zsh")
    import hydra

    line = os.environ.get("COMP_LINE", "").split(" ")
    if words[1].startswith("query=") and len(line) == 2:
        print("\n".join(name for name in COMMANDS if name.startswith(line[1])))
        return True
    command = line[1] if len(line) > 2 and line[1] in COMMANDS else "train"
    if len(line) > 2:
        os.environ["COMP_LINE"] = " ".join([line[0], *line[2:]])
    hydra.main(config_path="pkg://uarm_rl.conf", config_name=config_name(command), version_base="1.3")(lambda cfg: None)()
    return True


if __name__ == "__main__":
    main()
