"""The ring that stores transitions. It is dumb: ``admission`` decides what may enter, ``sampling`` what is drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks
from uarm_rl.learn.returns import Transition
from uarm_rl.learn.sampling import Places, Sampling, Uniform

Array = NDArray[np.float32]


class Batch(NamedTuple):
    """A mini-batch: views into one array, valid until the next ``sample``."""

    observation: Array  # (n, observation_size)
    action: Array  # (n, action_size)
    reward: Array  # (n, 1)
    next_observation: Array  # (n, observation_size)
    discount: Array  # (n, 1), what the next state counts; 0 after a termination
    weight: Array | None = None  # (n, 1), what the transition counts in the critic's gradient; all alike if left out


class ReplayBuffer:
    """First in, first out.

    One float32 row holds one whole transition, so that a sample is a single gather.
    """

    def __init__(
        self,
        capacity: int,
        *,
        observation_size: int,
        action_size: int,
        generator: np.random.Generator,
        sampling: Sampling | None = None,
    ) -> None:
        checks.integer("buffer.capacity", capacity, low=1, high=10_000_000)
        ends = np.cumsum([observation_size, action_size, 1, observation_size, 1]).tolist()
        self.fields = [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]
        self.rows = np.zeros((capacity, ends[-1]), np.float32)
        self.added = 0  # transitions ever added; the cursor is its remainder
        self.generator = generator
        self._sampling = sampling or Uniform()
        self._drawn = np.empty(0, np.int64)  # the places of the last sample
        self._sample = np.empty((0, ends[-1]), np.float32)
        self._overwritten: list[tuple[Array, Array]] = []  # since ``snapshot``

    @property
    def capacity(self) -> int:
        return len(self.rows)

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    @property
    def observations(self) -> Array:
        """Those that are stored, shape (n, observation_size), before each decision; a view."""
        return self.rows[: len(self), self.fields[0]]

    def add(self, transition: Transition) -> None:
        """Store one transition in the place of the oldest."""
        row = self.rows[self.added % self.capacity]
        if self.added >= self.capacity:
            self._overwritten.append((row, row.copy()))
        for field, value in zip(self.fields, transition, strict=True):
            row[field] = value
        self._sampling.added(self.added % self.capacity)
        self.added += 1

    def state(self) -> dict[str, Any]:
        """What a resume needs besides the arrays of ``snapshot``; JSON."""
        return {"added": self.added, "generator": self.generator.bit_generator.state} | self._sampling.state()

    def snapshot(self) -> Callable[[], dict[str, NDArray[Any]]]:
        """A function that gives the arrays of now, by name, whatever has been added when it is called.

        ``transitions`` are the rows, shape (n, row). It puts back those that were overwritten, which alone are copied, and when
        they are; after it the additions are gone. It is good until this is called again.
        """
        stored = len(self)
        sampled = self._sampling.arrays(stored)
        overwritten: list[tuple[Array, Array]] = []
        self._overwritten = overwritten

        def arrays() -> dict[str, NDArray[Any]]:
            for row, before in reversed(overwritten):  # the oldest last: a small ring may have come around twice
                row[:] = before
            return {"transitions": self.rows[:stored], **sampled}

        return arrays

    def restore(self, arrays: Mapping[str, NDArray[Any]], state: dict[str, Any]) -> None:
        """Take over arrays and state of another buffer of the same shape; :class:`ValueError` if they do not fit."""
        others = dict(arrays)
        rows = others.pop("transitions")
        added = checks.integer("replay.added", state["added"], low=0, high=2**62)
        expected = (min(added, self.capacity), self.rows.shape[1])
        if rows.shape != expected or rows.dtype != np.float32:
            raise ValueError(f"it holds rows of shape {rows.shape}, not {expected}")
        self._sampling.restore(
            len(rows), others, {key: value for key, value in state.items() if key not in ("added", "generator")}
        )
        self.generator.bit_generator.state = checks.generator_state("replay.generator", state["generator"])
        self.rows[: len(rows)] = rows
        self.added = added

    def sample(self, batch_size: int, progress: float = 0.0) -> Batch:
        """``batch_size`` transitions. ``progress`` runs from 0 to 1 over the training. Raises ``ValueError`` while empty."""
        drawn, weight = self.draw(batch_size, progress)
        if len(self._sample) != batch_size:
            self._sample = np.empty((batch_size, self.rows.shape[1]), np.float32)
        np.take(self.rows, drawn, axis=0, out=self._sample, mode="clip")  # "clip" writes into out without a copy
        return Batch(*(self._sample[:, field] for field in self.fields))._replace(weight=weight)

    def draw(self, batch_size: int, progress: float = 0.0) -> tuple[Places, Array | None]:
        """The places of a sample alone, shape (batch_size,), and their weights, as of :class:`Batch`."""
        if not len(self):
            raise ValueError("the replay buffer is empty; store a transition before sampling")
        self._drawn, weight = self._sampling.draw(len(self), batch_size, progress, self.generator)
        return self._drawn, weight

    def learned(self, errors: Array) -> None:
        """An update has used the last sample; ``errors``, shape (batch_size, 1), are its temporal differences."""
        self._sampling.learned(self._drawn, errors[:, 0].astype(np.float64))
