"""Other learners: Stable-Baselines3's (Raffin et al. 2021), and how their models become policy files of ours.

``sb3_training.py`` trains them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Final

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC, TD3, HerReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from torch import nn

from uarm_rl import checks
from uarm_rl.learn.train import Schedule
from uarm_rl.task import observation
from uarm_rl.task.observation import CUP, CUP_TO_OBJECT
from uarm_rl.task.policy import ActorPolicy, Numbers, PolicyCard

Env = gymnasium.Env[Any, Any]


def from_sb3(
    model: Any, card: PolicyCard, *, offset: Numbers = observation.OFFSET, scale: Numbers = observation.SCALE
) -> ActorPolicy:
    """The greedy policy of a model of Stable-Baselines3 as one of ours, which ``save`` writes to a policy file.

    ``model`` is a TD3, DDPG or SAC with ``MlpPolicy`` and ReLU, of any ``net_arch``, on actions in [-1, 1]; SAC acts by its
    mean. ``offset`` and ``scale``, shape (observation_size,), are what its observations were scaled with before it saw them, as
    ``(raw - offset) / scale``: zeros and ones if it saw them raw, the mean and deviation of a ``VecNormalize``. Its actions are
    the model's to 1e-6. Later training does not change it. A model of ``Goals`` may have ``MultiInputPolicy``. Raises
    :class:`ValueError` with a sentence for any other model.
    """
    actor = getattr(model, "actor", None)
    parts: list[nn.Module] = []
    if isinstance(model, TD3) and actor is not None:
        *parts, squash = actor.mu
        if not isinstance(squash, nn.Tanh):
            parts = []
    elif isinstance(model, SAC) and actor is not None and not actor.use_sde:
        parts = [*actor.latent_pi, actor.mu]
    kinds = [nn.ReLU if number % 2 else nn.Linear for number in range(len(parts))]
    if not len(parts) % 2 or not all(isinstance(part, kind) for part, kind in zip(parts, kinds, strict=True)):
        raise ValueError(
            f"only a TD3, DDPG or SAC with MlpPolicy and ReLU, without gSDE, becomes a policy here, got {type(model).__name__}"
        )
    space = model.action_space
    if not ((space.low == -1.0).all() and (space.high == 1.0).all()):
        raise ValueError(f"its actions must be in [-1, 1], got {space}")
    layers = [(_array(part.weight).T, _array(part.bias)) for part in parts if isinstance(part, nn.Linear)]
    if isinstance(model.observation_space, gymnasium.spaces.Dict):
        layers[0] = Goals.matrix().T @ layers[0][0], layers[0][1]
    exact = [(np.ascontiguousarray(weight, np.float32), bias.astype(np.float32)) for weight, bias in layers]
    return ActorPolicy(exact, offset=np.asarray(offset, np.float32), scale=np.asarray(scale, np.float32), card=card)


def _array(tensor: torch.Tensor) -> NDArray[np.float64]:
    return tensor.detach().cpu().numpy().astype(np.float64)


class Goals(gymnasium.Wrapper[Any, Any, Any, Any]):
    """The task as one of reaching goals, for hindsight: where the cup is, where it should be, and the rest of what is seen.

    ``env`` gives the 20 numbers scaled. Goals are positions, scaled as the cup's. The reward is 0 within ``tolerance_m`` of the
    goal, else -1, since it must be told for a goal that was another at the time; how long the cup stayed there, what it moved
    and the progress cannot be. Nor is there an object at a goal that is made up afterwards.
    """

    _REST: Final = [*range(12), *range(15, 19)]  # without the vector to the object, and without the flag

    def __init__(self, env: gymnasium.Env[Any, Any], tolerance_m: float) -> None:
        super().__init__(env)
        self._tolerance_m = tolerance_m
        sizes = {"achieved_goal": 3, "desired_goal": 3, "observation": len(self._REST)}
        boxes: dict[str, gymnasium.Space[Any]] = {
            name: gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32) for name, size in sizes.items()
        }
        self.observation_space = gymnasium.spaces.Dict(boxes)

    @classmethod
    def matrix(cls) -> NDArray[np.float64]:
        """From the 20 numbers, scaled, to what the networks are given: both goals and the rest, in the order of their names."""
        every = np.eye(observation.SIZE)
        finer = (observation.SCALE[CUP_TO_OBJECT] / observation.SCALE[CUP])[:, np.newaxis]
        return np.concatenate([every[CUP], every[CUP] + finer * every[CUP_TO_OBJECT], every[cls._REST]])

    def _split(self, seen: Any) -> dict[str, Any]:
        parts = np.split((self.matrix() @ seen).astype(np.float32), [3, 6])
        return dict(zip(("achieved_goal", "desired_goal", "observation"), parts, strict=True))

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """The reward of goals, shape (..., 3), as the library's buffer asks for it."""
        distance_m = np.linalg.norm((achieved_goal - desired_goal) * observation.SCALE[CUP], axis=-1)
        return -(distance_m > self._tolerance_m).astype(np.float32)

    def reset(self, **how: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        seen, info = self.env.reset(**how)
        return self._split(seen), info

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        seen, _, terminated, truncated, info = self.env.step(action)
        parts = self._split(seen)
        reward = float(self.compute_reward(parts["achieved_goal"], parts["desired_goal"], info))
        return parts, reward, terminated, truncated, info


class _Learner(ABC):
    """A model's settings, and how it is made: the choices of the group ``agent`` whose names begin with ``sb3_``."""

    def __init__(self, *, hidden: Sequence[int], gamma: float, tau: float, learning_rate: float) -> None:
        self._policy: dict[str, Any] = {"net_arch": checks.integers("agent.hidden", hidden, low=1, high=10_000)}
        self._common: dict[str, Any] = {
            "gamma": checks.number("agent.gamma", gamma, low=0.0, high=1.0),
            "tau": checks.number("agent.tau", tau, low=0.0, high=1.0, open_low=True),
            "learning_rate": checks.number("agent.learning_rate", learning_rate, low=0.0, high=1.0, open_low=True),
        }

    @abstractmethod
    def model(self, env: Env, schedule: Schedule, *, seed: int, capacity: int, tolerance_m: float) -> OffPolicyAlgorithm:
        """The library's model, untrained."""

    def _arguments(self, seed: int, capacity: int, schedule: Schedule) -> dict[str, Any]:
        total = schedule.episodes * schedule.experiences_per_episode
        return {
            **self._common,
            "policy_kwargs": self._policy,
            "buffer_size": min(capacity, total),
            "learning_starts": schedule.warmup_experiences,
            "batch_size": schedule.batch_size,
            "train_freq": 1,
            "gradient_steps": schedule.updates_per_experience,
            "seed": seed,
            "device": "cpu",
        }


class TwinDelayed(_Learner):
    """TD3 (Fujimoto, van Hoof and Meger 2018), with Gaussian exploration as there."""

    def __init__(
        self,
        *,
        hidden: Sequence[int],
        gamma: float,
        tau: float,
        learning_rate: float,
        policy_delay: int,
        target_policy_noise: float,
        target_noise_clip: float,
        exploration_noise: float,
        action_size: int,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(hidden=hidden, gamma=gamma, tau=tau, learning_rate=learning_rate)
        self._own: dict[str, Any] = {
            "policy_delay": checks.integer("agent.policy_delay", policy_delay, low=1, high=1000),
            "target_policy_noise": checks.number("agent.target_policy_noise", target_policy_noise, low=0.0, high=10.0),
            "target_noise_clip": checks.number("agent.target_noise_clip", target_noise_clip, low=0.0, high=10.0),
        }
        self._noise = np.full(action_size, checks.number("agent.exploration_noise", exploration_noise, low=0.0, high=10.0))

    def model(self, env: Env, schedule: Schedule, *, seed: int, capacity: int, tolerance_m: float) -> OffPolicyAlgorithm:
        noise = NormalActionNoise(np.zeros_like(self._noise), self._noise)
        return TD3("MlpPolicy", env, action_noise=noise, **self._own, **self._arguments(seed, capacity, schedule))


class SoftActorCritic(_Learner):
    """SAC (Haarnoja et al. 2018), whose entropy's weight is learned."""

    def __init__(
        self,
        *,
        hidden: Sequence[int],
        gamma: float,
        tau: float,
        learning_rate: float,
        action_size: int,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(hidden=hidden, gamma=gamma, tau=tau, learning_rate=learning_rate)

    def model(self, env: Env, schedule: Schedule, *, seed: int, capacity: int, tolerance_m: float) -> OffPolicyAlgorithm:
        return SAC("MlpPolicy", env, **self._arguments(seed, capacity, schedule))


class Hindsight(SoftActorCritic):
    """SAC with hindsight experience replay (Andrychowicz et al. 2017): of each transition, ``n_sampled_goal`` more whose goal
    is where the cup came to later in the same episode. It learns from the goals' own reward, see :class:`Goals`.
    """

    def __init__(
        self,
        *,
        hidden: Sequence[int],
        gamma: float,
        tau: float,
        learning_rate: float,
        n_sampled_goal: int,
        action_size: int,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(hidden=hidden, gamma=gamma, tau=tau, learning_rate=learning_rate, action_size=action_size)
        self._sampled = checks.integer("agent.n_sampled_goal", n_sampled_goal, low=1, high=100)

    def model(self, env: Env, schedule: Schedule, *, seed: int, capacity: int, tolerance_m: float) -> OffPolicyAlgorithm:
        return SAC(
            "MultiInputPolicy",
            Goals(env, tolerance_m),
            replay_buffer_class=HerReplayBuffer,
            replay_buffer_kwargs={"n_sampled_goal": self._sampled, "goal_selection_strategy": "future"},
            **self._arguments(seed, capacity, schedule),
        )
