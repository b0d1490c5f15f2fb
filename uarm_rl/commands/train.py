"""Train one policy, or many with -m.

Examples:
  uarm-rl train experiment=C episodes=100             method C of the paper, for a short budget
  uarm-rl train buffer=adaptive reward=penalty seed=1 the same method, chosen by its parts
  uarm-rl train -m experiment=A,B,C,D seed=0,1,2      twelve runs; resume=true skips and continues
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import torch
import yaml

from uarm_rl import checks
from uarm_rl.checks import UsageError
from uarm_rl.configuration import Settings, build, build_env, policy_card, read_run, value_range
from uarm_rl.evaluation.evaluate import successes
from uarm_rl.learn import run as session
from uarm_rl.learn.async_env import InlineEnv, SubprocessEnv
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.task import positions
from uarm_rl.task.env import ACTION_SIZE
from uarm_rl.task.observation import SIZE


def run(settings: Settings) -> None:
    """Train one policy in its run folder."""

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
    policy = agent.policy(policy_card(settings))
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
                value_range=value_range(settings),
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
    return checks.path("results_dir", settings["results_dir"]) / name / f"seed{seed}"
