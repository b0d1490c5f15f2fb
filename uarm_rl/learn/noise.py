"""Exploration noise, added to the action by the training loop, never by the policy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks


class OrnsteinUhlenbeck:
    """Noise that remembers: ``x <- (1 - theta) x + sqrt(1 - (1 - theta)^2) N(0, 1)``, times an amplitude.

    The process has unit variance, so ``amplitude`` is the standard deviation of the noise. It falls linearly from
    ``initial_amplitude`` to ``final_amplitude`` over the first ``decay_fraction`` of the training ("gradually
    reduced as the training proceeds", section 4.1 of the paper). With ``theta`` of 1 it has no memory: Gaussian noise.
    """

    def __init__(
        self,
        *,
        theta: float,
        initial_amplitude: float,
        final_amplitude: float,
        decay_fraction: float,
        action_size: int,
        generator: np.random.Generator,
    ) -> None:
        self._keep = 1.0 - checks.number("noise.theta", theta, low=0.0, high=1.0, open_low=True)
        self._innovation = (1.0 - self._keep**2) ** 0.5
        self._initial = checks.number("noise.initial_amplitude", initial_amplitude, low=0.0, high=10.0)
        self._final = checks.number("noise.final_amplitude", final_amplitude, low=0.0, high=10.0)
        self._decay = checks.number("noise.decay_fraction", decay_fraction, low=0.0, high=1.0, open_low=True)
        self._generator = generator
        self._value: NDArray[np.float64] = np.zeros(action_size)

    def reset(self) -> None:
        """Begin a new episode."""
        # Start from the stationary distribution: the first actions of an episode explore as the later ones do.
        self._value = self._generator.standard_normal(len(self._value))

    def __call__(self, progress: float) -> NDArray[np.float64]:
        """Noise for one action, shape (action_size,); ``progress`` runs from 0 to 1 over the training."""
        self._value = self._keep * self._value + self._innovation * self._generator.standard_normal(len(self._value))
        return self.amplitude(progress) * self._value

    def state(self) -> dict[str, Any]:
        """What a resume needs; JSON."""
        return {"state": self._value.tolist(), "generator": self._generator.bit_generator.state}

    def restore(self, state: dict[str, Any]) -> None:
        """Take over the state of noise of the same kind and size; :class:`ValueError` if it does not fit."""
        value = np.array(state["state"], np.float64)
        if value.shape != self._value.shape or not np.isfinite(value).all():
            raise ValueError("the state of its noise is none")
        self._generator.bit_generator.state = checks.generator_state("noise.generator", state["generator"])
        self._value = value

    def amplitude(self, progress: float) -> float:
        """Standard deviation of the noise at ``progress``."""
        return self._initial + (self._final - self._initial) * min(1.0, progress / self._decay)
