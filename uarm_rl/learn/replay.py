"""The ring that stores transitions. It is dumb: what may enter is decided elsewhere (``admission``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks
from uarm_rl.learn.returns import Transition

Array = NDArray[np.float32]


class Batch(NamedTuple):
    """A mini-batch: views into one array, valid until the next ``sample``."""

    observation: Array  # (n, observation_size)
    action: Array  # (n, action_size)
    reward: Array  # (n, 1)
    next_observation: Array  # (n, observation_size)
    discount: Array  # (n, 1), what the next state counts; 0 after a termination


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
        self._overwritten: list[tuple[Array, Array]] = []  # since ``rows_of_now``

    @property
    def capacity(self) -> int:
        return len(self.rows)

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def add(self, transition: Transition) -> None:
        """Store one transition in the place of the oldest."""
        row = self.rows[self.added % self.capacity]
        if self.added >= self.capacity:
            self._overwritten.append((row, row.copy()))
        for field, value in zip(self._fields, transition, strict=True):
            row[field] = value
        self.added += 1

    def state(self) -> dict[str, Any]:
        """What a resume needs besides the stored rows; JSON."""
        return {"added": self.added, "generator": self.generator.bit_generator.state}

    def rows_of_now(self) -> Callable[[], Array]:
        """A function that gives the rows stored now, shape (n, row), whatever has been added when it is called.

        It puts back what was overwritten, which alone is copied, and when it is; after it the additions are gone. It is good
        until this is called again.
        """
        stored = len(self)
        overwritten: list[tuple[Array, Array]] = []
        self._overwritten = overwritten

        def rows() -> Array:
            for row, before in reversed(overwritten):  # the oldest last: a small ring may have come around twice
                row[:] = before
            return self.rows[:stored]

        return rows

    def restore(self, rows: Array, state: dict[str, Any]) -> None:
        """Take over rows and state of another buffer of the same shape; :class:`ValueError` if they do not fit."""
        added = checks.integer("replay.added", state["added"], low=0, high=2**62)
        expected = (min(added, self.capacity), self.rows.shape[1])
        if rows.shape != expected or rows.dtype != np.float32:
            raise ValueError(f"it holds rows of shape {rows.shape}, not {expected}")
        self.generator.bit_generator.state = checks.generator_state("replay.generator", state["generator"])
        self.rows[: len(rows)] = rows
        self.added = added

    def sample(self, batch_size: int) -> Batch:
        """``batch_size`` transitions, drawn uniformly with replacement. Raises ``ValueError`` while empty."""
        if not len(self):
            raise ValueError("the replay buffer is empty; store a transition before sampling")
        if len(self._sample) != batch_size:
            self._sample = np.empty((batch_size, self.rows.shape[1]), np.float32)
        indices = self.generator.integers(len(self), size=batch_size)
        np.take(self.rows, indices, axis=0, out=self._sample, mode="clip")  # "clip" writes into out without a copy
        return Batch(*(self._sample[:, field] for field in self._fields))
