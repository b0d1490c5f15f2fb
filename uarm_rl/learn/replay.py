"""The ring that stores transitions. It is dumb: what may enter is decided elsewhere (``admission``)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks

Array = NDArray[np.float32]


class Batch(NamedTuple):
    """A mini-batch: views into one array, valid until the next ``sample``."""

    observation: Array  # (n, observation_size)
    action: Array  # (n, action_size)
    reward: Array  # (n, 1)
    next_observation: Array  # (n, observation_size)
    terminated: Array  # (n, 1), 0 or 1


class ReplayBuffer:
    """First in, first out; sampling is uniform with replacement.

    One float32 row holds one whole transition, so that a sample is a single gather.
    """

    def __init__(self, capacity: int, *, observation_size: int, action_size: int, generator: np.random.Generator) -> None:
        checks.integer("buffer.capacity", capacity, low=1, high=10_000_000)
        ends = np.cumsum([observation_size, action_size, 1, observation_size, 1]).tolist()
        self._fields = [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]
        self.rows = np.zeros((capacity, ends[-1]), np.float32)
        self.added = 0  # transitions ever added; the cursor is its remainder
        self.generator = generator
        self._sample = np.empty((0, ends[-1]), np.float32)

    @property
    def capacity(self) -> int:
        return len(self.rows)

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def add(self, observation: Array, action: Array, reward: float, next_observation: Array, terminated: bool) -> None:
        """Store one transition in the place of the oldest."""
        row = self.rows[self.added % self.capacity]
        for field, value in zip(self._fields, (observation, action, reward, next_observation, terminated), strict=True):
            row[field] = value
        self.added += 1

    def sample(self, batch_size: int) -> Batch:
        """``batch_size`` transitions, drawn uniformly with replacement. Raises ``ValueError`` while empty."""
        if not len(self):
            raise ValueError("the replay buffer is empty; store a transition before sampling")
        if len(self._sample) != batch_size:
            self._sample = np.empty((batch_size, self.rows.shape[1]), np.float32)
        indices = self.generator.integers(len(self), size=batch_size)
        np.take(self.rows, indices, axis=0, out=self._sample, mode="clip")  # "clip" writes into out without a copy
        return Batch(*(self._sample[:, field] for field in self._fields))
