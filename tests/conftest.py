"""Small things that several tests build: a fast configuration, the environment, a command line."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, redirect_stderr, redirect_stdout
from importlib.util import find_spec
from pathlib import Path

import hypothesis
import pytest

from uarm_rl import cli, configuration
from uarm_rl.sim.simulated_arm import SimulatedArm
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.policy import PolicyCard

if find_spec("mujoco"):  # before a test imports it: how MuJoCo draws is settled then
    import uarm_rl.sim.mujoco_arm

#: The same examples every time, however long they take: a suite that fails tomorrow without a change is no help.
hypothesis.settings.register_profile("same", derandomize=True, deadline=None)
hypothesis.settings.load_profile("same")

#: A training of seconds: small networks, short episodes, short validation.
FAST = (
    "episodes=4",
    "experiences_per_episode=25",
    "max_decisions_per_episode=100",
    "warmup_experiences=25",
    "batch_size=16",
    "agent.hidden=[32,32]",
    "validate_every=2",
    "checkpoint_every=2",
    "time_limit_s=0.5",
)

#: What an agent is told but for the widths of its layers.
AGENT = {
    "gamma": 0.9,
    "gamma_per": "decision",
    "n_steps": 1,
    "tau": 0.01,
    "actor_lr": 1e-4,
    "critic_lr": 1e-3,
    "final_layer_init": 0.1,
    "annealing": 0.0,
    "huber": None,
    "action_l2": 0.0,
}
#: What a policy for the arm says of itself.
CARD = PolicyCard(
    max_delta_rad=0.15,
    control_hz=20,
    hold={"name": "until_steady", "steady_threshold_rad": 0.001, "min_control_steps": 2, "max_control_steps": 40},
    servo={"name": "stepper", "feed": 15.0},
    tolerance_m=0.005,
    dwell_s=0.5,
    buffer="adaptive",
    reward="penalty",
    episodes=1,
    seed=0,
)

#: What is tested in one engine or in every is skipped where it is not installed.
needs_pybullet, needs_mujoco = (
    pytest.mark.skipif(find_spec(name) is None, reason=f"{name} is not installed") for name in ("pybullet", "mujoco")
)
ENGINES = [pytest.param("pybullet", marks=needs_pybullet), pytest.param("mujoco", marks=needs_mujoco)]

MakeEnv = Callable[..., UArmSuctionEnv]


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    """The name of each engine, one after the other."""
    name: str = request.param
    return name


def make_arm(engine: str, *overrides: str) -> SimulatedArm:
    """The simulated arm of an engine, from command-line overrides."""
    settings = configuration.compose("train", (f"sim={engine}", *overrides))
    servo = configuration.build("servo", settings["servo"])
    cup = configuration.build("cup", settings["cup"])
    arm: SimulatedArm = configuration.build("sim", settings["sim"], servo=servo, cup=cup, control_hz=settings["control_hz"])
    return arm


@pytest.fixture
def make_env() -> Iterator[MakeEnv]:
    """Build environments from command-line overrides; they are closed after the test."""
    made: list[UArmSuctionEnv] = []

    def make(*overrides: str, **arguments: object) -> UArmSuctionEnv:
        settings = configuration.compose("train", overrides)
        arguments = {"time_limit_s": settings["time_limit_s"]} | arguments
        made.append(configuration.build_env(settings, **arguments))
        return made[-1]

    yield make
    for env in made:
        with closing(env):
            pass


@pytest.fixture
def without(tmp_path: Path) -> Callable[[str], dict[str, str]]:
    """The environment of a process, and of those that it starts, in which a package cannot be imported."""

    def hide(package: str) -> dict[str, str]:
        folder = tmp_path / f"without-{package}"
        folder.mkdir()
        (folder / "sitecustomize.py").write_text(f"import sys; sys.modules[{package!r}] = None\n")
        return {"PYTHONPATH": str(folder)}

    return hide


def uarm_rl(
    *words: str, cwd: Path, environment: dict[str, str] | None = None, fresh: bool = False, timeout_s: float = 120
) -> subprocess.CompletedProcess[str]:
    """Run the command line in the folder ``cwd``: as a user would, in a process of its own, if it is to be ``fresh`` or has an
    environment; else in this one, where Python and torch have started already, and without processes that would start them."""
    if fresh or environment:
        return subprocess.run(
            [sys.executable, "-m", "uarm_rl", *words],
            cwd=cwd,
            env=os.environ | (environment or {}),
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )
    if words[:1] == ("evaluate",) and not any(word.startswith(("workers=", "-")) for word in words):
        words += ("workers=1",)
    code, out, err = 0, io.StringIO(), io.StringIO()
    with chdir(cwd), redirect_stdout(out), redirect_stderr(err):
        try:
            cli.main(words)
        except SystemExit as stop:
            code = stop.code or 0
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


@contextmanager
def chdir(folder: Path) -> Iterator[None]:
    """As ``contextlib.chdir`` of Python 3.11."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
