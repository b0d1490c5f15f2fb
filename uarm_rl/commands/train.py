"""Train one policy, or many with -m.

Examples:
  uarm-rl train experiment=C episodes=100             method C of the paper, for a short budget
  uarm-rl train buffer=adaptive reward=penalty seed=1 the same method, chosen by its parts
  uarm-rl train -m experiment=A,B,C,D seed=0,1,2      twelve runs; resume=true skips and continues
  uarm-rl train agent=sb3_td3 buffer=uniform name=td3 Stable-Baselines3's TD3 on the same task
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np
import torch

from uarm_rl import checks, signals, workers
from uarm_rl.checks import UsageError
from uarm_rl.configuration import Settings, build, build_env, flat
from uarm_rl.evaluation.evaluate import successes
from uarm_rl.learn import run as session
from uarm_rl.learn.async_env import InlineEnv, SubprocessEnv
from uarm_rl.learn.hindsight import Hindsight
from uarm_rl.learn.learner import Learner
from uarm_rl.learn.loggers import Logger, Write
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.learn.train import Schedule, Stop
from uarm_rl.task import positions
from uarm_rl.task.env import ACTION_SIZE
from uarm_rl.trained import policy_card, read_run, value_range

#: Settings that say how a run is carried out, not what comes of it; they are not kept with it.
_TRANSIENT: Final = ("resume", "overwrite", "results_dir", "simulate_beside", "logger")


def run(settings: Settings) -> None:
    """Train one policy in its run folder."""
    stop = Stop()
    if not train(settings, stop):
        signals.hand_on(stop.signal)
        raise SystemExit(130)


def train(settings: Settings, stop: Stop, hear: Write | None = None) -> bool:
    """Train one policy in its run folder. False when it was told to stop, by a signal or by whoever has ``stop`` too.

    ``hear`` is called with the numbers of every episode and how many experiences there are.
    """
    workers.one_thread()
    torch.set_num_threads(1)  # two threads are slower at this size, and would change the last bits
    for name in ("resume", "overwrite", "simulate_beside"):
        checks.boolean(name, settings[name])
    if settings["resume"] and settings["overwrite"]:
        raise UsageError("resume=true continues a run and overwrite=true deletes it; give one of them")
    run_dir = output(settings)
    kept = {key: value for key, value in settings.items() if key not in _TRANSIENT}
    kept["sim"] = checks.mapping("sim", settings["sim"]) | {"gui": False}
    if settings["resume"] and session.is_finished(run_dir):
        session.check_same(run_dir, kept, read_run(run_dir))
        print(f"{run_dir} is finished; nothing to do")
        return True
    with ExitStack() as stack:
        work = _built(settings, stack)  # and so every value is checked, before the folder is touched
        stack.enter_context(session.claim(run_dir, kept, read_run, resume=settings["resume"], overwrite=settings["overwrite"]))
        experiences = settings["episodes"] * settings["experiences_per_episode"]
        print(f"{run_dir}: {experiences:,} decisions and gradient steps in all")
        finished = work(run_dir, log=_heard(build("logger", settings["logger"]).opened(run_dir, flat(kept)), hear), stop=stop)
    if finished:
        print(f"trained: {run_dir}; test it with: uarm-rl evaluate run={shlex.quote(str(run_dir))}")
    else:
        print(f"stopped: {run_dir}; the same command with resume=true continues it")
    return finished


def check(settings: Settings) -> None:
    """Raises what a training with these settings would raise before it touches its folder; builds all that it is made of."""
    with ExitStack() as stack:
        _built(settings, stack)


def _built(settings: Settings, stack: ExitStack) -> Callable[..., bool]:
    """A training, to be called with its folder, ``log`` and ``stop``."""
    logger: Logger = build("logger", settings["logger"])
    if logger.needs and not find_spec(logger.needs):
        raise UsageError(f"logger={logger.needs} needs an extra; {checks.how_to_add(logger.needs)}")
    schedule = Schedule(**{name: settings[name] for name in Schedule.__dataclass_fields__})
    validation_positions = positions.load_packaged("validation_positions.csv", settings["sim"]["object_size_m"])
    validation_env = stack.enter_context(closing(build_env(settings, time_limit_s=settings["time_limit_s"])))
    begin = _library if checks.text("agent.name", settings["agent"]["name"]).startswith("sb3_") else _ours
    return partial(
        begin(settings, schedule, stack), validate=lambda policy: successes(validation_env, policy, validation_positions)
    )


@contextmanager
def _heard(log: AbstractContextManager[Write], hear: Write | None) -> Iterator[Write]:
    """A log whose rows ``hear`` gets too."""
    with log as write:

        def both(row: Mapping[str, float], experiences: int) -> None:
            write(row, experiences)
            if hear:
                hear(row, experiences)

        yield both


def output(settings: Settings) -> Path:
    """The run's folder."""
    name, seed = checks.text("name", settings["name"]), checks.integer("seed", settings["seed"], low=0, high=2**32)
    if not re.fullmatch(r"\w[\w.,+ -]*", name):
        raise UsageError(
            f"name={name} is no name of a folder; take letters, digits and . , + - _, and results_dir=PATH for paths"
        )
    return checks.path("results_dir", settings["results_dir"]) / name / f"seed{seed}"


def _ours(settings: Settings, schedule: Schedule, stack: ExitStack) -> Callable[..., bool]:
    """Our own learner and loop, to be called with the folder and ``validate``. Everything is built, and so checked, before."""
    learner = _learner(settings)
    stack.callback(learner.env.close)
    learner.env.state()  # the environment beside begins when it is asked
    return partial(
        session.run,
        learner=learner,
        schedule=schedule,
        value_range=value_range(settings),
    )


def _library(settings: Settings, schedule: Schedule, stack: ExitStack) -> Callable[..., bool]:
    """A learner of Stable-Baselines3 in its own loop, to be called likewise."""
    name = settings["agent"]["name"]
    if not find_spec("stable_baselines3"):
        raise UsageError(f"agent={name} needs an extra; {checks.how_to_add('sb3')}")
    if settings["observation"]["name"] != "paper" or settings["buffer"]["hold"]["name"] == "learned":
        raise UsageError(f"agent={name} learns with observation=paper and without hold=learned; take agent=ddpg for the others")
    if settings["hindsight_targets"]:
        raise UsageError(f"agent={name} has no hindsight_targets; take agent=ddpg, or sb3_her with its own")
    from uarm_rl.learn import sb3_training

    sb3_training.check_settings(settings["buffer"], name)
    return partial(
        sb3_training.run,
        agent=build("agent", settings["agent"], action_size=ACTION_SIZE),
        env=stack.enter_context(closing(build_env(settings, time_limit_s=None, render_mode=_watched(settings)))),
        schedule=schedule,
        seed=int(np.random.SeedSequence(settings["seed"]).generate_state(1)[0]),
        capacity=checks.integer("buffer.capacity", settings["buffer"]["capacity"], low=1, high=10_000_000),
        card=policy_card(settings),
    )


def _watched(settings: Settings) -> str | None:
    return "human" if checks.boolean("sim.gui", settings["sim"]["gui"]) else None


def _learner(settings: Settings) -> Learner:
    """All that learns, each part with a generator of its own."""
    seeds = np.random.SeedSequence(settings["seed"]).spawn(4)
    env_seed, network_seed = (int(sequence.generate_state(1)[0]) for sequence in seeds[:2])
    networks = torch.Generator().manual_seed(network_seed)
    observation = build("observation", settings["observation"])
    _check_hindsight(settings)
    draws = np.random.default_rng(seeds[2])  # of the buffer, and of the targets that are made up for it
    action_size = ACTION_SIZE + build("hold", settings["buffer"]["hold"]).choices
    agent = build("agent", settings["agent"], action_size=action_size, generator=networks, observation=observation)
    admission = build("admission", settings["buffer"]["admission"])
    make_env = partial(build_env, settings, time_limit_s=None, render_mode=_watched(settings), keep_within=admission.within)
    env_class = SubprocessEnv if settings["simulate_beside"] else InlineEnv
    return Learner(
        replay=ReplayBuffer(
            settings["buffer"]["capacity"],
            observation_size=observation.size,
            action_size=action_size,
            generator=draws,
            sampling=build("sampling", settings["buffer"]["sampling"]),
        ),
        noise=build("noise", settings["noise"], action_size=action_size, generator=np.random.default_rng(seeds[3])),
        admission=admission,
        agent=agent,
        policy=agent.policy(policy_card(settings)),
        env=env_class(make_env, env_seed),
        hindsight=Hindsight(
            targets=settings["hindsight_targets"],
            reward=build("reward", settings["reward"]),
            object_height_m=settings["sim"]["object_size_m"],
            generator=draws,
        ),
    )


def _check_hindsight(settings: Settings) -> None:
    """Raises :class:`UsageError` where a decision does not hold what another target would have made of it."""
    if settings["hindsight_targets"] and (settings["observation"]["name"] == "stack" or settings["reward"]["pressing"]):
        raise UsageError("hindsight_targets needs an observation of one moment, not stack, and a reward without pressing")
