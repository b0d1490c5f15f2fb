"""Exploration noise, added to the action by the training loop, never by the policy."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks


class Noise(Protocol):
    """Exploration noise; ``state`` and ``generator`` are saved in checkpoints."""

    state: NDArray[np.float64]
    generator: np.random.Generator

    def reset(self) -> None:
        """Begin a new episode."""
        ...

    def __call__(self, progress: float) -> NDArray[np.float64]:
        """Noise for one action, shape (action_size,); ``progress`` runs from 0 to 1 over the training."""
        ...


class OrnsteinUhlenbeck:
    """Noise that remembers: ``x <- (1 - theta) x + sqrt(1 - (1 - theta)^2) N(0, 1)``, times an amplitude.

    The process has unit variance, so ``amplitude`` is the standard deviation of the noise. It falls linearly from
    ``initial_amplitude`` to ``final_amplitude`` over the first ``decay_fraction`` of the training ("gradually
    reduced as the training proceeds", section 4.1 of the paper).
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
        self._initial = checks.number("noise.initial_amplitude", initial_amplitude, low=0.0)
        self._final = checks.number("noise.final_amplitude", final_amplitude, low=0.0)
        self._decay = checks.number("noise.decay_fraction", decay_fraction, low=0.0, high=1.0, open_low=True)
        self.generator = generator
        self.state: NDArray[np.float64] = np.zeros(action_size)

    def reset(self) -> None:
        # Start from the stationary distribution: the first actions of an episode explore as the later ones do.
        self.state = self.generator.standard_normal(len(self.state))

    def __call__(self, progress: float) -> NDArray[np.float64]:
        self.state = self._keep * self.state + self._innovation * self.generator.standard_normal(len(self.state))
        return self.amplitude(progress) * self.state

    def amplitude(self, progress: float) -> float:
        """Standard deviation of the noise at ``progress``."""
        return self._initial + (self._final - self._initial) * min(1.0, progress / self._decay)


class Gaussian(OrnsteinUhlenbeck):
    """Noise without memory: Ornstein-Uhlenbeck with theta = 1, the same falling amplitude."""

    def __init__(
        self,
        *,
        initial_amplitude: float,
        final_amplitude: float,
        decay_fraction: float,
        action_size: int,
        generator: np.random.Generator,
    ) -> None:
        super().__init__(
            theta=1.0,
            initial_amplitude=initial_amplitude,
            final_amplitude=final_amplitude,
            decay_fraction=decay_fraction,
            action_size=action_size,
            generator=generator,
        )
