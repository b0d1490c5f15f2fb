"""Speed, as ratios measured side by side in one run: alternating rounds, medians, one thread each.

    python benchmarks/bench.py [--quick] [--profile]     (or: make bench)

Prints a table and writes ``benchmarks/bench.csv``. What a user would pick instead is Stable-Baselines3's DDPG with the same
networks, batch and optimiser; the floor of an update is its matrix products alone, and that of a simulation its bare
``stepSimulation`` calls. Every ratio is "how many times the reference's rate", so more is better.
"""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy

import argparse
import csv
import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import gymnasium
import mujoco
import numpy as np
import pybullet
import stable_baselines3
import torch
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

import uarm_rl
from uarm_rl import configuration, trained
from uarm_rl.commands.words import LAUNCHERS
from uarm_rl.evaluation.evaluate import evaluate
from uarm_rl.evaluation.measures import measure
from uarm_rl.learn import checkpoint
from uarm_rl.learn.async_env import InlineEnv, SubprocessEnv
from uarm_rl.learn.driver import alone, together
from uarm_rl.learn.learner import Learner
from uarm_rl.learn.replay import ReplayBuffer
from uarm_rl.learn.train import Schedule, Stop, Training, train
from uarm_rl.sim.mujoco_arm import MujocoArm
from uarm_rl.sim.simulated_arm import SimulatedArm
from uarm_rl.task import layouts, observation
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.policy import InverseKinematicsPolicy

HERE = Path(__file__).parent
BATCH = 128


class Row(NamedTuple):
    """One line of the table: rates per second (or seconds, or megabytes) of a subject and its reference."""

    name: str
    unit: str
    ours: float
    reference: float
    reference_name: str
    ratio: float
    target: str


def rate(work: Callable[[], object], count: int) -> float:
    """How often per second ``work``, which does ``count`` things, does one."""
    begin = time.perf_counter()
    work()
    return count / (time.perf_counter() - begin)


def alternate(rounds: int, **work: tuple[Callable[[], object], int]) -> dict[str, float]:
    """Median rate of each kind of work; a round runs them all once, so that a slow minute slows them all."""
    rates: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(rounds + 1):
        for name, (do, count) in work.items():
            rates[name].append(rate(do, count))
    return {name: statistics.median(values[1:]) for name, values in rates.items()}  # the first round warms up


def compare(name: str, unit: str, rates: dict[str, float], target: str = "") -> list[Row]:
    """Rows that hold the first kind of work against each of the others."""
    (_, ours), *others = rates.items()
    return [Row(name, unit, ours, reference, other.replace("_", " "), ours / reference, target) for other, reference in others]


def repeat(work: Callable[[], object], count: int) -> tuple[Callable[[], None], int]:
    def run() -> None:
        for _ in range(count):
            work()

    return run, count


def our_agent():
    settings = configuration.compose("train")
    return configuration.build("agent", settings["agent"], action_size=3, generator=torch.Generator().manual_seed(0))


def our_replay(capacity: int = 50_000, filled: int = 20_000) -> ReplayBuffer:
    replay = ReplayBuffer(capacity, observation_size=observation.SIZE, action_size=3, generator=np.random.default_rng(0))
    generator = np.random.default_rng(1)
    replay.rows[:filled] = generator.normal(0, 0.1, (filled, replay.rows.shape[1]))
    replay.added = filled
    return replay


def reference_agent(env: gymnasium.Env, replay: ReplayBuffer | None = None) -> stable_baselines3.DDPG:
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(3), 0.3 * np.ones(3))
    agent = stable_baselines3.DDPG(
        "MlpPolicy",
        env,
        learning_rate=1e-4,  # one for both networks; with ours for the critic its actor soon pushes against a limit
        buffer_size=50_000,
        learning_starts=200,
        batch_size=BATCH,
        gamma=0.9,
        train_freq=1,
        gradient_steps=1,
        action_noise=noise,
        policy_kwargs={"net_arch": [400, 300]},
        device="cpu",
    )
    agent._setup_learn(1)  # what learn() does before the first step: logger and counters
    for row in [] if replay is None else replay.rows[: len(replay)]:
        agent.replay_buffer.add(row[:20], row[24:44], row[20:23], row[23:24], np.zeros(1), [{}])
    return agent


def bare_products() -> Callable[[], None]:
    """The matrix products of one update, and nothing else: forward and backward of actor and critic, forward of the targets."""
    shapes = []
    for inputs, outputs in ((20, 400), (400, 300), (300, 3)):  # actor
        shapes += [(BATCH, inputs, outputs)] * 2 + [(inputs, BATCH, outputs)]  # forward twice (target too), weights' gradient
    for inputs, outputs in ((23, 400), (400, 300), (300, 1)):  # critic
        shapes += [(BATCH, inputs, outputs)] * 3 + [(inputs, BATCH, outputs)]
    shapes += [(BATCH, 3, 300), (BATCH, 300, 400)]  # back through the actor's hidden layers
    shapes += [(BATCH, 1, 300), (BATCH, 300, 400)] * 2 + [(BATCH, 400, 3)]  # the critic's, and to the action
    matrices = [(torch.randn(a, b), torch.randn(b, c), torch.empty(a, c)) for a, b, c in shapes]

    def run() -> None:
        for left, right, result in matrices:
            torch.mm(left, right, out=result)

    return run


def bench_update(rounds: int) -> Iterator[Row]:
    agent, replay = our_agent(), our_replay()
    with closing(gymnasium.make("uarm_rl/UArmSuction-v0")) as env:
        reference = reference_agent(env, replay)
        rates = alternate(
            rounds,
            ours=repeat(lambda: agent.update(replay.sample(BATCH)), 60),
            SB3=(lambda: reference.train(gradient_steps=60, batch_size=BATCH), 60),
            floor=repeat(bare_products(), 60),
        )
        yield from compare("one update against SB3", "1/s", {name: rates[name] for name in ("ours", "SB3")}, "> 1.3")
        yield from compare("one update against its products", "1/s", {name: rates[name] for name in ("ours", "floor")}, "> 0.6")
        policy = agent.policy(trained.policy_card(configuration.compose("train")))
        seen = np.random.default_rng(0).normal(0, 0.1, observation.SIZE).astype(np.float32)
        rates = alternate(
            rounds,
            ours=repeat(lambda: policy.act(seen), 500),
            SB3=repeat(lambda: reference.predict(seen, deterministic=True), 500),
        )
        yield from compare("one greedy action", "1/s", rates, "> 8")


def bench_simulation(rounds: int) -> Iterator[Row]:
    for buffer in ("uniform", "adaptive"):
        settings = configuration.compose("train", (f"buffer={buffer}",))
        with closing(configuration.build_env(settings, time_limit_s=None)) as env:
            generator = np.random.default_rng(0)
            env.reset(seed=0)
            steps = 0  # control steps so far

            def decide(env=env, generator=generator) -> None:
                nonlocal steps
                *_, terminated, truncated, info = env.step(generator.uniform(-1, 1, 3).astype(np.float32))
                steps += info["control_steps"]
                if terminated or truncated:
                    env.reset()

            decisions = 300 if buffer == "uniform" else 60
            repeat(decide, decisions)[0]()
            per_decision = steps / decisions
            bare = partial(pybullet.stepSimulation, physicsClientId=env.arm._client)
            physics_steps = round(6 * per_decision * decisions)  # 120 Hz against 20 Hz
            rates = alternate(
                rounds, ours=repeat(decide, decisions), bare_stepSimulation=(repeat(bare, physics_steps)[0], decisions)
            )
            yield from compare(f"simulated decisions, {buffer} ({per_decision:.1f} control steps each)", "1/s", rates)


def bench_engines(rounds: int) -> Iterator[Row]:
    """MuJoCo against PyBullet, each in a world of its own: the same rows on the way from a physics step to a training."""
    with ExitStack() as stack:
        settings = {engine: configuration.compose("train", (f"sim={engine}",)) for engine in ("mujoco", "pybullet")}
        work: dict[str, dict[str, tuple[Callable[[], object], int]]] = {}
        for engine, chosen in settings.items():
            env = stack.enter_context(closing(configuration.build_env(chosen, time_limit_s=None)))
            training = stack.enter_context(closing(OurTraining(chosen, InlineEnv)))
            env.reset(seed=0)
            work.setdefault("bare physics steps", {})[engine] = repeat(bare_step(env.arm), 2000)
            work.setdefault("control steps", {})[engine] = repeat(env.arm.advance, 400)
            work.setdefault("adaptive decisions", {})[engine] = repeat(random_decision(env), 60)
            work.setdefault("training, adaptive", {})[engine] = (partial(training, 1), EPISODE)
        for name, engines in work.items():
            target = "> 2" if name == "adaptive decisions" else ""
            yield from compare(f"MuJoCo: {name}", "1/s", alternate(rounds, **engines), target)


def bare_step(arm: SimulatedArm) -> Callable[[], None]:
    """One step of the engine alone, without a servo."""
    if isinstance(arm, MujocoArm):
        return partial(mujoco.mj_step, arm._model, arm._data)
    return partial(pybullet.stepSimulation, physicsClientId=arm._client)


def random_decision(env: UArmSuctionEnv) -> Callable[[], None]:
    generator = np.random.default_rng(0)

    def decide() -> None:
        *_, terminated, truncated, _ = env.step(generator.uniform(-1, 1, 3).astype(np.float32))
        if terminated or truncated:
            env.reset()

    return decide


EPISODE = 200  # stored experiences, as in the paper


class OurTraining:
    """Trains for so many more episodes at each call; two are over, so that every experience has its update."""

    def __init__(self, settings: dict, env_class: type, seed: int = 0) -> None:
        agent = our_agent()
        self.learner = Learner(
            env=env_class(partial(configuration.build_env, settings, time_limit_s=None), seed),
            agent=agent,
            policy=agent.policy(trained.policy_card(settings)),
            replay=ReplayBuffer(
                300_000, observation_size=observation.SIZE, action_size=3, generator=np.random.default_rng(seed)
            ),
            admission=configuration.build("admission", settings["buffer"]["admission"]),
            noise=configuration.build("noise", settings["noise"], action_size=3, generator=np.random.default_rng(seed)),
        )
        self.counters = self.learner.counters
        self(2)

    def __call__(self, episodes: int) -> None:
        alone(*self.training(episodes))

    def training(self, episodes: int) -> tuple[Training[None], Stop]:
        """So many more episodes, to be driven, and their stop."""
        goal, stop = self.counters.episode + episodes, Stop()

        def end_of_episode(row: dict[str, object]) -> tuple[()]:
            stop.requested = self.counters.episode >= goal
            return ()

        schedule = Schedule(
            episodes=1500,
            experiences_per_episode=EPISODE,
            max_decisions_per_episode=10 * EPISODE,
            batch_size=BATCH,
            warmup_experiences=EPISODE,
            updates_per_experience=1,
            validate_every=1500,
            checkpoint_every=1500,
        )
        return train(self.learner, schedule, lambda: None, end_of_episode, stop), stop

    def snapshot(self) -> Callable[[], checkpoint.Checkpoint]:
        """What a checkpoint saves, with a replay buffer that is full; the training can go on, an update for each experience."""
        replay = self.learner.replay
        replay.added = replay.capacity
        self.counters.experiences = replay.capacity // 2
        self.counters.updates = self.counters.experiences - EPISODE
        return self.learner.snapshot()

    def close(self) -> None:
        self.learner.env.close()


def bench_training(rounds: int) -> Iterator[Row]:
    """The whole loop, a gradient step for every decision: the adaptive hold without the filter, which SB3 has not.

    Decisions of different policies last differently long, so each row says how long theirs were.
    """
    for buffer, hold in (("uniform", "uniform"), ("steady_only", "adaptive")):
        settings = configuration.compose("train", (f"buffer={buffer}",))
        make = partial(gymnasium.make, "uarm_rl/UArmSuction-v0", overrides=(f"buffer={buffer}",))
        with (
            closing(OurTraining(settings, InlineEnv)) as inline,
            closing(OurTraining(settings, SubprocessEnv)) as beside,
            closing(ControlSteps(make())) as env,
        ):
            reference = reference_agent(env)
            reference.learn(2 * EPISODE)
            rates = alternate(
                rounds,
                inline=(partial(inline, 2), 2 * EPISODE),
                beside=(partial(beside, 2), 2 * EPISODE),
                SB3=(partial(reference.learn, 2 * EPISODE, reset_num_timesteps=False), 2 * EPISODE),
            )
            theirs = env.control_steps / env.decisions
        ours = inline.counters.control_steps / inline.counters.decisions
        steps = "" if hold == "uniform" else f" ({ours:.1f} control steps each, SB3 {theirs:.1f})"
        one, both = {k: rates[k] for k in ("inline", "SB3")}, {k: rates[k] for k in ("beside", "SB3")}
        yield from compare(f"training, {hold}, one core{steps}", "decisions/s", one, "> 1.2")
        yield from compare(
            f"training, {hold}, both cores{steps}", "decisions/s", both, "> 1.7" if hold == "adaptive" else "> 1.4"
        )


class ControlSteps(gymnasium.Wrapper):
    """Counts how long the decisions of another trainer last."""

    control_steps = decisions = 0

    def step(self, action):
        result = super().step(action)
        self.control_steps += result[4]["control_steps"]
        self.decisions += 1
        return result


def bench_side_by_side(rounds: int, episodes: int) -> Iterator[Row]:
    """Whole trainings in processes of their own, alone and two at a time."""

    def run(seeds: list[int]) -> None:
        command = [sys.executable, __file__, "--train-only", str(episodes)]
        processes = [subprocess.Popen([*command, str(seed)], stdout=subprocess.PIPE, text=True) for seed in seeds]
        times = [float(process.communicate()[0]) for process in processes]
        took.append(len(seeds) * episodes * EPISODE / max(times))

    rates: dict[str, list[float]] = {"two": [], "one": []}
    for _ in range(rounds):
        for name, seeds in (("one", [0]), ("two", [0, 1])):
            took: list[float] = []
            run(seeds)
            rates[name] += took
    medians = {name: statistics.median(values) for name, values in rates.items()}
    yield from compare("two runs side by side", "experiences/s", medians, "> 1.6")


def bench_stacked(rounds: int) -> Iterator[Row]:
    """Runs in one process against the same one after the other, which simulate beside too; on a GPU against one there."""
    for device, runs in (("cpu", 4), ("cuda", 16)):
        name = f"{runs} runs in one process, {device}"
        if device == "cuda" and not torch.cuda.is_available():
            yield Row(name, "experiences/s", math.nan, math.nan, "skipped: torch finds no GPU", math.nan, "")
            continue
        with ExitStack() as stack:
            settings = configuration.compose("train")
            many = [stack.enter_context(closing(OurTraining(settings, SubprocessEnv, seed))) for seed in range(runs)]

            def side_by_side(some: list[OurTraining], device: str = device) -> None:
                trainings, stops = zip(*(one.training(1) for one in some), strict=True)
                together(trainings, stops, batch_size=BATCH, device=device, batched=device != "cpu", failed=refuse)

            def in_turn(many: list[OurTraining] = many, side_by_side=side_by_side) -> None:
                for one in many:
                    side_by_side([one])

            rates = alternate(
                rounds,
                side_by_side=(partial(side_by_side, many), runs * EPISODE),
                one_after_the_other=(in_turn, runs * EPISODE),
            )
        yield from compare(name, "experiences/s", rates)


def refuse(number: int, error: Exception) -> None:
    raise error


def bench_evaluation(rounds: int) -> Iterator[Row]:
    settings = configuration.compose("train")
    where = layouts.load_named("test", 0)
    reward = configuration.build("reward", settings["reward"])

    def run(workers: int) -> None:
        make = partial(configuration.build_env, settings, time_limit_s=settings["time_limit_s"])
        episodes = evaluate(make, Restless(), where, processes=workers)
        rows = [measure(number, episode, reward, control_hz=20) for number, episode in enumerate(episodes)]
        assert len(rows) == 100

    rates = alternate(max(1, rounds // 3), two_cores=(partial(run, 2), 100), one_core=(partial(run, 1), 100))
    yield from compare("100 positions, start of the workers included", "positions/s", rates, "> 0.95")


class Restless:
    """The baseline without its patience: it never succeeds, so every episode takes its 10 seconds."""

    def __init__(self) -> None:
        self._policy = InverseKinematicsPolicy(0.15, hover_m=0.05, aligned_m=0.0)

    def act(self, seen: np.ndarray) -> np.ndarray:
        return self._policy.act(seen)


def bench_start(rounds: int) -> Iterator[Row]:
    def start(*words: str) -> Callable[[], None]:
        return lambda: subprocess.run([*words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False, cwd=HERE)

    command = str(Path(sys.executable).with_name("uarm-rl"))
    rates = alternate(
        rounds,
        help=(start(command, "--help"), 1),
        report=(start(command, "report", "results_dir=nowhere"), 1),
        python=(start(sys.executable, "-c", "pass"), 1),
    )
    for name in ("help", "report"):
        title = "uarm-rl --help" if name == "help" else "uarm-rl report, up to its first file"
        target = "< 0.4 s" if name == "help" else "no torch, no pybullet"
        yield Row(title, "s", 1 / rates[name], 1 / rates["python"], "python -c pass", rates[name] / rates["python"], target)


def bench_launchers(rounds: int) -> Iterator[Row]:
    """What a run costs beside its training, by who starts it: four runs of nothing, in processes of their own or one by one."""
    program = str(Path(sys.executable).with_name("uarm-rl"))
    nothing = (
        "episodes=1",
        "experiences_per_episode=1",
        "max_decisions_per_episode=1",
        "validate_every=1",
        "time_limit_s=0.05",
    )
    launchers = {
        "joblib": ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2"),
        "submitit_local": ("hydra/launcher=submitit_local",),
        "ray": ("hydra/launcher=ray", "hydra.launcher.ray.init.num_cpus=2"),
        "one_by_one": (),
    }
    there = {name: words for name, words in launchers.items() if words == () or find_spec(LAUNCHERS[name].module)}

    def start(*words: str) -> None:
        with tempfile.TemporaryDirectory(dir=HERE, prefix=".tmp-") as folder:
            line = (program, "train", "-m", "seed=0,1,2,3", "simulate_beside=false", *nothing, *words, f"results_dir={folder}")
            subprocess.run(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True, cwd=folder)

    rates = alternate(rounds, **{name: (partial(start, *words), 4) for name, words in there.items()})
    for name in [name for name in rates if name != "one_by_one"]:
        yield Row(
            f"a run of nothing, by {name}",
            "s",
            1 / rates[name],
            1 / rates["one_by_one"],
            "one by one",
            rates[name] / rates["one_by_one"],
            "",
        )


def bench_growth(episodes: int) -> Iterator[Row]:
    """Training rate and resident memory as a run grows; the ratio compares with the first third."""
    with closing(OurTraining(configuration.compose("train"), InlineEnv)) as more:
        rates, memory = [], []
        for _ in range(9):
            rates.append(rate(partial(more, episodes // 9), episodes // 9 * EPISODE))
            memory.append(resident_mb())
    for name, part in (("middle", slice(3, 6)), ("end", slice(6, 9))):
        ours, start = statistics.median(rates[part]), statistics.median(rates[:3])
        title = f"training rate at the {name} of {episodes * EPISODE:,} experiences"
        yield Row(title, "1/s", ours, start, "start", ours / start, "flat")
    yield Row("resident memory at the end", "MB", memory[-1], memory[0], "start", memory[-1] / memory[0], "flat, < 600 MB")


def bench_checkpoints(rounds: int) -> Iterator[Row]:
    """What the snapshots and the checkpoint of 25 episodes cost at the end of a run, where the replay buffer is full."""
    settings = configuration.compose("train", ("buffer=uniform",))  # the shorter episodes: the larger share
    every = settings["checkpoint_every"]
    with closing(OurTraining(settings, InlineEnv)) as training, tempfile.TemporaryDirectory(dir=HERE, prefix=".tmp-") as folder:
        snapshot = training.snapshot()
        rates = alternate(
            rounds,
            save=(lambda: checkpoint.write(Path(folder), snapshot()), 1),
            snapshot=(training.snapshot, 1),
            episode=(partial(training, 1), 1),
        )
    spent_s, trained_s = 1 / rates["save"] + every / rates["snapshot"], every / rates["episode"]
    yield Row(f"saving {every} episodes, buffer full", "s", spent_s, trained_s, "training them", spent_s / trained_s, "< 0.02")


def profile(updates: int) -> None:
    """Print where the time of an update goes, by operation, and write it to ``benchmarks/profile.csv``."""
    agent, replay = our_agent(), our_replay()
    for _ in range(50):
        agent.update(replay.sample(BATCH))
    begin = time.perf_counter()
    for _ in range(updates):
        agent.update(replay.sample(BATCH))
    whole_us = (time.perf_counter() - begin) / updates * 1e6
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profiler:
        for _ in range(updates):
            agent.update(replay.sample(BATCH))
    events = sorted(profiler.key_averages(), key=lambda event: -event.self_cpu_time_total)
    rows = [(event.key, event.count / updates, event.self_cpu_time_total / updates) for event in events]
    rows = [row for row in rows if row[2] >= 0.005 * whole_us]
    rows.append(("everything else, Python included", 0, whole_us - sum(us for _, _, us in rows)))
    with open(HERE / "profile.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("operation", "calls_per_update", "us_per_update", "share"))
        for name, calls, us in rows:
            print(f"{name:40} {calls:6.0f} calls {us:8.0f} us {us / whole_us:6.1%}")
            writer.writerow((name, f"{calls:.0f}", f"{us:.0f}", f"{us / whole_us:.3f}"))
    print(f"{'one update, not profiled':40} {'':12} {whole_us:8.0f} us")


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def print_row(row: Row) -> None:
    numbers = f"{row.ours:10.4g} {row.unit:12} {row.reference:10.4g} {row.reference_name:20}"
    print(f"{row.name:58} {numbers} {row.ratio:6.2f} x   {row.target}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="only the rows of this function, bench_training say; writes no CSV")
    parser.add_argument("--quick", action="store_true", help="two rounds each, to see that it runs")
    parser.add_argument("--profile", action="store_true", help="only where the time of an update goes, by operation")
    parser.add_argument("--train-only", nargs=2, type=int, metavar=("EPISODES", "SEED"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.train_only:
        episodes, seed = arguments.train_only
        with closing(OurTraining(configuration.compose("train"), InlineEnv, seed)) as more:
            print(episodes / rate(partial(more, episodes), episodes))
        return
    if arguments.profile:
        profile(20 if arguments.quick else 500)
        return
    rounds, length, growth = (2, 1, 9) if arguments.quick else (9, 10, 90)
    benches = {
        "bench_update": partial(bench_update, rounds),
        "bench_simulation": partial(bench_simulation, rounds),
        "bench_engines": partial(bench_engines, rounds),
        "bench_training": partial(bench_training, max(2, rounds // 2)),
        "bench_side_by_side": partial(bench_side_by_side, max(1, rounds // 3), length),
        "bench_stacked": partial(bench_stacked, max(1, rounds // 3)),
        "bench_evaluation": partial(bench_evaluation, rounds),
        "bench_start": partial(bench_start, rounds),
        "bench_launchers": partial(bench_launchers, max(1, rounds // 3)),
        "bench_checkpoints": partial(bench_checkpoints, rounds),
        "bench_growth": partial(bench_growth, growth),
    }
    if arguments.only:
        for row in benches[arguments.only]():
            print_row(row)
        return
    rows = []
    for bench in benches.values():
        for row in bench():
            rows.append(row)
            print_row(row)
    with open(HERE / "bench.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        writer.writerows([f"{value:.4g}" if isinstance(value, float) else value for value in row] for row in rows)


if __name__ == "__main__":
    assert uarm_rl.task.env  # its import registers the environment
    main()
