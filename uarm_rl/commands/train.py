"""Train one policy, or many with -m.

Examples:
  uarm-rl train experiment=C episodes=100             method C of the paper, for a short budget
  uarm-rl train buffer=adaptive reward=penalty seed=1 the same method, chosen by its parts
  uarm-rl train -m experiment=A,B,C,D seed=0,1,2      twelve runs; resume=true skips and continues
  uarm-rl train -m experiment=A,C seed=0,1 stacked=true four runs in one process, their networks side by side
  uarm-rl train agent=sb3_td3 buffer=uniform name=td3 Stable-Baselines3's TD3 on the same task
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from functools import partial
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from uarm_rl import checks, signals, workers
from uarm_rl.checks import UsageError
from uarm_rl.configuration import Settings, build, build_env, flat, seen, slots_of
from uarm_rl.evaluation.evaluate import successes
from uarm_rl.learn import driver
from uarm_rl.learn import run as session
from uarm_rl.learn.async_env import InlineEnv, SubprocessEnv
from uarm_rl.learn.hindsight import Hindsight
from uarm_rl.learn.learner import Learner
from uarm_rl.learn.loggers import Logger, Write
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.learn.train import Schedule, Stop, Training
from uarm_rl.task import layouts
from uarm_rl.task.env import ACTION_SIZE, UArmSuctionEnv
from uarm_rl.task.policy import Policy
from uarm_rl.trained import policy_card, read_run, value_range

#: Settings that say how a run is carried out, not what comes of it; they are not kept with it.
_TRANSIENT: Final = ("resume", "overwrite", "results_dir", "simulate_beside", "stacked", "device", "logger")

_DEVICES: Final = ("cpu", "cuda")


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
    if _device(settings) == "cpu":
        return driver.alone(_training(settings, stop, hear), stop)

    def failed(number: int, error: Exception) -> None:
        raise error

    return bool(_stacked([settings], [stop], failed, hear)[0])


def side_by_side(jobs: Sequence[Settings], words: Sequence[str], failed: Callable[[int, Exception], None]) -> bool:
    """Train many policies in this process, if that is what they ask for; ``failed`` is told the number of one that fails.

    Runs whose networks have the same shapes are stacked, one such group after the other.
    """
    if not any(checks.boolean("stacked", job["stacked"]) or _device(job) != "cpu" for job in jobs):
        return False
    if launcher := [word for word in words if word.startswith("hydra")]:
        raise UsageError(f"{launcher[0]} gives each run a process, and these share one; leave it out, or stacked and device")
    groups: dict[str, list[int]] = {}
    for number, job in enumerate(jobs):
        groups.setdefault(_kind(job) or str(number), []).append(number)
    for numbers in groups.values():
        stops = [Stop() for _ in numbers]

        def told(place: int, error: Exception, numbers: list[int] = numbers) -> None:
            failed(numbers[place], error)

        _stacked([jobs[number] for number in numbers], stops, told)
        if signal := max(stop.signal for stop in stops):
            signals.hand_on(signal)
            raise SystemExit(130)
    return True


def _kind(job: Settings) -> str:
    """What runs must have in common to be stacked, in words; empty for a run that cannot be."""
    agent, hold = job["agent"], job["buffer"]["hold"]["name"]
    if agent["name"] != "ddpg":
        return ""
    others = [job[name] for name in ("batch_size", "updates_per_experience", "device", "observation")]
    return repr((agent["hidden"], hold == "learned", others))


def _stacked(
    jobs: Sequence[Settings], stops: Sequence[Stop], failed: Callable[[int, Exception], None], hear: Write | None = None
) -> list[bool | None]:
    """Train policies of one kind side by side; of each what :func:`train` returns, or ``None`` if it failed."""
    tools = {job["logger"]["name"] for job in jobs} - {"csv", "tensorboard"}
    if len(jobs) > 1 and tools:
        raise UsageError(f"logger={min(tools)} has one run a process, and these share one; take logger=csv or tensorboard")
    validating = min(len(jobs), workers.cores())
    with ProcessPoolExecutor(validating, workers.CONTEXT, workers.begin) as pool:
        return driver.together(
            [_training(job, stop, hear, pool) for job, stop in zip(jobs, stops, strict=True)],
            stops,
            batch_size=jobs[0]["batch_size"],
            device=jobs[0]["device"],
            batched=jobs[0]["device"] != "cpu",
            failed=failed,
        )


def _device(settings: Settings) -> str:
    device = checks.one_of("device", settings["device"], _DEVICES)
    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError("device=cuda needs a GPU that torch can use, and here is none; device=cpu trains without")
    return device


def _training(
    settings: Settings, stop: Stop, hear: Write | None = None, pool: ProcessPoolExecutor | None = None
) -> Training[bool]:
    """One run in its folder, to be driven; what :func:`train` returns. With a ``pool`` it is there that it validates."""
    workers.one_thread()
    torch.set_num_threads(1)  # two threads are slower at this size, and would change the last bits
    for name in ("resume", "overwrite", "simulate_beside", "stacked"):
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
        work = _built(settings, stack, pool)  # and so every value is checked, before the folder is touched
        stack.enter_context(session.claim(run_dir, kept, read_run, resume=settings["resume"], overwrite=settings["overwrite"]))
        experiences = settings["episodes"] * settings["experiences_per_episode"]
        print(f"{run_dir}: {experiences:,} experiences are to be stored")
        log = _heard(build("logger", settings["logger"]).opened(run_dir, flat(kept)), hear)
        finished = yield from work(run_dir, log=log, stop=stop)
    if finished:
        print(f"trained: {run_dir}; test it with: uarm-rl evaluate run={shlex.quote(str(run_dir))}")
    else:
        print(f"stopped: {run_dir}; the same command with resume=true continues it")
    return finished


def check(settings: Settings) -> None:
    """Raises what a training with these settings would raise before it touches its folder; builds all that it is made of."""
    with ExitStack() as stack:
        _built(settings, stack)


def _built(settings: Settings, stack: ExitStack, pool: ProcessPoolExecutor | None = None) -> Callable[..., Training[bool]]:
    """A training, to be called with its folder, ``log`` and ``stop``."""
    checks.one_of("device", settings["device"], _DEVICES)
    logger: Logger = build("logger", settings["logger"])
    if logger.needs and not find_spec(logger.needs):
        raise UsageError(f"logger={logger.needs} needs an extra; {checks.how_to_add(logger.needs)}")
    schedule = Schedule(**{name: settings[name] for name in Schedule.__dataclass_fields__})
    with ExitStack() as checked:
        env = (checked if pool else stack).enter_context(_validation_env(settings))
    begin = _library if checks.text("agent.name", settings["agent"]["name"]).startswith("sb3_") else _ours
    validate = partial(_validated_in, pool, settings) if pool else partial(_validated, settings, env)
    return partial(begin(settings, schedule, stack), validate=validate)


def _validation_env(settings: Settings) -> AbstractContextManager[UArmSuctionEnv]:
    return closing(build_env(settings, time_limit_s=settings["time_limit_s"]))


def _validated(settings: Settings, env: UArmSuctionEnv, policy: Policy) -> Iterator[bool]:
    """Whether a policy reaches the validation positions, one after the other."""
    return successes(env, policy, layouts.load_named("validation", slots_of(settings), settings["sim"]["object_size_m"]))


def _validated_in(pool: ProcessPoolExecutor, settings: Settings, policy: Policy) -> Iterator[bool]:
    """The same in another process, which begins at once."""
    return chain.from_iterable(map(Future.result, [pool.submit(_validated_there, settings, policy)]))


def _validated_there(settings: Settings, policy: Policy) -> list[bool]:
    with _validation_env(settings) as env:
        return list(_validated(settings, env, policy))


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
    if settings["task"]["name"] != "reach" and name == f"{settings['buffer']['name']}-{settings['reward']['name']}":
        task = settings["task"]["name"]
        raise UsageError(f"task={task} needs a name of its own, as in name={task}-{name}: {name} is a run of task=reach")
    return checks.path("results_dir", settings["results_dir"]) / name / f"seed{seed}"


def _ours(settings: Settings, schedule: Schedule, stack: ExitStack) -> Callable[..., Training[bool]]:
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


def _library(settings: Settings, schedule: Schedule, stack: ExitStack) -> Callable[..., Training[bool]]:
    """A learner of Stable-Baselines3 in its own loop, to be called likewise; nobody else gets a turn before its end."""
    name = settings["agent"]["name"]
    if not find_spec("stable_baselines3"):
        raise UsageError(f"agent={name} needs an extra; {checks.how_to_add('sb3')}")
    if settings["device"] != "cpu":
        raise UsageError(f"agent={name} learns on the processor; leave device={settings['device']} out, or take agent=ddpg")
    if settings["task"]["name"] != "reach":
        raise UsageError(f"agent={name} learns with task=reach alone; take agent=ddpg for {settings['task']['name']}")
    if settings["observation"]["name"] != "paper" or settings["buffer"]["hold"]["name"] == "learned":
        raise UsageError(f"agent={name} learns with observation=paper and without hold=learned; take agent=ddpg for the others")
    if settings["hindsight_targets"]:
        raise UsageError(f"agent={name} has no hindsight_targets; take agent=ddpg, or sb3_her with its own")
    from uarm_rl.learn import sb3_training

    sb3_training.check_settings(settings["buffer"], name)
    work = partial(
        sb3_training.run,
        agent=build("agent", settings["agent"], action_size=ACTION_SIZE),
        env=stack.enter_context(closing(build_env(settings, time_limit_s=None, render_mode=_watched(settings)))),
        schedule=schedule,
        seed=int(np.random.SeedSequence(settings["seed"]).generate_state(1)[0]),
        capacity=checks.integer("buffer.capacity", settings["buffer"]["capacity"], low=1, high=10_000_000),
        card=policy_card(settings),
    )

    def training(*arguments: Any, **keywords: Any) -> Training[bool]:
        yield from ()
        return work(*arguments, **keywords)

    return training


def _watched(settings: Settings) -> str | None:
    return "human" if checks.boolean("sim.gui", settings["sim"]["gui"]) else None


def _learner(settings: Settings) -> Learner:
    """All that learns, each part with a generator of its own."""
    seeds = np.random.SeedSequence(settings["seed"]).spawn(4)
    env_seed, network_seed = (int(sequence.generate_state(1)[0]) for sequence in seeds[:2])
    networks = torch.Generator().manual_seed(network_seed)
    observation, task = seen(settings), build("task", settings["task"])
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
            observation=observation,
            touching=task.touching,
            margin_m=task.margin_m,
        ),
    )


def _check_hindsight(settings: Settings) -> None:
    """Raises :class:`UsageError` where a decision does not hold what another target would have made of it."""
    told = settings["observation"]["name"] == "stack" or settings["reward"]["pressing"]
    if settings["hindsight_targets"] and told:
        raise UsageError("hindsight_targets needs an observation of one moment, not stack, and a reward without pressing")
