"""uarm-rl: train a uArm Swift Pro to reach and suck objects, in simulation and on the desk.

From Python::

    import gymnasium
    import uarm_rl

    env = gymnasium.make("uarm_rl/UArmSuction-v0")  # or uarm_rl.make_env("buffer=uniform")
    policy = uarm_rl.load_policy("results/adaptive-penalty/seed0")
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(policy.act(observation))

Importing this package loads no engine, no torch and no Hydra. Where to read on: ``task/env.py`` is the task,
``learn/train.py`` the training loop, ``cli.py`` the command line.
"""

from __future__ import annotations

import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from uarm_rl.task.env import UArmSuctionEnv
    from uarm_rl.task.policy import ActorPolicy

__version__ = "0.1.0"


def make_env(*overrides: str, render_mode: str | None = None) -> UArmSuctionEnv:
    """The suction task in simulation, a ``gymnasium.Env``; ``overrides`` as on the command line of ``uarm-rl train``.

    Observations have shape (20,), float32, metres and radians (``uarm_rl.task.observation.NAMES``), and more numbers where the
    overrides ask for them; actions shape (3,), in [-1, 1], times ``max_delta_rad``. Raises :class:`ValueError` for a value out
    of range, ``uarm_rl.checks.UsageError`` for an override that does not exist, and :class:`ModuleNotFoundError` where the
    engine is not installed.
    """
    from uarm_rl.configuration import make_env

    return make_env(tuple(overrides), render_mode)


def load_policy(path: str | Path) -> ActorPolicy:
    """The policy in a run's folder, or in a file; ``act(observation)``, shape (20,), gives an action of shape (3,).

    ``card`` says how it is to be run. Raises :class:`OSError` if there is none, and ``uarm_rl.task.policy.PolicyFileError``
    for a file that is damaged or none.
    """
    from uarm_rl.files import POLICY
    from uarm_rl.task.policy import ActorPolicy

    path = Path(path)
    return ActorPolicy.load(path / POLICY if path.is_dir() else path)


def _register(gymnasium: Any) -> None:
    gymnasium.register(id="uarm_rl/UArmSuction-v0", entry_point="uarm_rl.configuration:make_env")


class _WhenImported(MetaPathFinder):
    """Registers the environment when Gymnasium is imported later than this package, which is too light to import it."""

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                _register(module)

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


if "gymnasium" in sys.modules:
    _register(sys.modules["gymnasium"])
else:
    sys.meta_path.insert(0, _WhenImported())
