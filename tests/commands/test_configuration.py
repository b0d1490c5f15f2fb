"""Configuration: every file composes and builds, and says what its keys mean."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import torch

from uarm_rl import configuration
from uarm_rl.sim.engines import installed

CONF = Path(str(resources.files("uarm_rl.conf")))
CHOICES = [(path.parent.name, path.stem) for path in sorted(CONF.glob("*/*.yaml"))]
ENGINES = {"pybullet": "pybullet", "fine": "pybullet", "mujoco": "mujoco", "auto": installed()}

RUNTIME = {
    "noise": {"action_size": 3, "generator": np.random.default_rng(0)},
    "agent": {"action_size": 3, "generator": torch.Generator()},
    "sim": {"servo": configuration.build("servo", configuration.compose("train")["servo"]), "control_hz": 20},
}

DEVICES = [("camera", "openmv"), ("camera", "webcam")]  # not there to be opened


def names_in(group: str) -> set[str]:
    return {cli_settings(group, choice)["name"] for of, choice in CHOICES if of == group}


def cli_settings(group: str, choice: str) -> dict[str, object]:
    if group in ("hold", "admission", "sampling"):
        return configuration.compose("train", (f"{group}@buffer.{group}={choice}",))["buffer"][group]
    if group in ("camera", "detector"):
        needed = ("camera.path=picture.png",) if choice == "file" else ()
        return configuration.compose("run-real", (f"{group}={choice}", *needed))[group]
    return configuration.compose("train", (f"{group}={choice}",))[group]


@pytest.mark.parametrize("group", configuration.OPEN_SETS)
def test_groups_and_classes_hold_the_same_names(group):
    assert names_in(group) == set(configuration.OPEN_SETS[group])


@pytest.mark.parametrize(
    ("group", "choice"), [pair for pair in CHOICES if pair[0] in configuration.OPEN_SETS and pair not in DEVICES]
)
def test_every_choice_builds(group, choice):
    if group == "sim":
        pytest.importorskip(ENGINES[choice], reason=f"{ENGINES[choice]} is not installed")
    one = configuration.build(group, cli_settings(group, choice), **RUNTIME.get(group, {}))
    assert one is not None or choice == "rigid"  # a cup without bellows
    if group == "sim":
        one.close()


@pytest.mark.parametrize("choice", [choice for group, choice in CHOICES if group in ("experiment", "buffer", "sim")])
@pytest.mark.filterwarnings("ignore")
def test_every_experiment_buffer_and_sim_makes_an_environment(choice):
    group = next(group for group, name in CHOICES if name == choice and group in ("experiment", "buffer", "sim"))
    pytest.importorskip(ENGINES.get(choice, "pybullet"), reason="its engine is not installed")
    settings = configuration.compose("train", (f"{group}={choice}",))
    env = configuration.build_env(settings, time_limit_s=settings["time_limit_s"])
    env.reset(seed=0)
    assert env.step(np.zeros(env.action_space.shape, np.float32))[4]["control_steps"] >= 1
    env.close()


def test_the_papers_four_methods():
    methods = {name: configuration.compose("train", (f"experiment={name}",)) for name in "ABCD"}
    buffers = {name: settings["buffer"]["name"] for name, settings in methods.items()}
    assert buffers == {"A": "adaptive", "B": "uniform", "C": "adaptive", "D": "uniform"}
    assert {name: settings["reward"]["sigma"] < 0 for name, settings in methods.items()} == {
        "A": False,
        "B": False,
        "C": True,
        "D": True,
    }
    for settings in methods.values():
        assert (settings["episodes"], settings["experiences_per_episode"], settings["batch_size"]) == (1500, 200, 128)
        assert (settings["agent"]["gamma"], settings["agent"]["hidden"]) == (0.9, [400, 300])
        assert (settings["agent"]["actor_lr"], settings["agent"]["critic_lr"]) == (1e-4, 1e-3)
        assert settings["name"] == f"{settings['buffer']['name']}-{settings['reward']['name']}"


def test_plain_and_penalty_differ_in_sigma_alone():
    plain, penalty = cli_settings("reward", "plain"), cli_settings("reward", "penalty")
    assert {key for key in plain if plain[key] != penalty[key]} == {"name", "sigma"}


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda path: str(path.relative_to(CONF)))
def test_every_key_is_commented(path):
    hidden = ("defaults:", "hydra:", "name:")
    for line in path.read_text().splitlines():
        if line and not line.startswith((" ", "#", *hidden)):
            assert "  # " in line, f"{path.name}: {line}"


def test_no_configuration_names_a_class():
    assert not any("_target_" in path.read_text() for path in CONF.rglob("*.yaml"))
