"""Which stored transitions a mini-batch is made of, and how much each counts."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks

Places = NDArray[np.int64]
Numbers = NDArray[np.float64]


class Sampling(Protocol):
    """A rule for what is drawn. Places are those of the ring's rows."""

    def added(self, place: int) -> None:
        """A new transition lies at ``place``."""
        ...

    def draw(
        self, stored: int, size: int, progress: float, generator: np.random.Generator
    ) -> tuple[Places, NDArray[np.float32] | None]:
        """``size`` of the first ``stored`` places, and what each counts in the gradient, shape (size, 1); ``None``: alike.

        ``progress`` runs from 0 to 1 over the training.
        """
        ...

    def learned(self, places: Places, errors: Numbers) -> None:
        """An update has used these places; ``errors``, shape (size,), are its temporal differences."""
        ...

    def arrays(self, stored: int) -> dict[str, Numbers]:
        """What a resume needs, arrays by name, copied."""
        ...

    def state(self) -> dict[str, Any]:
        """And the rest; JSON."""
        ...

    def restore(self, stored: int, arrays: dict[str, Any], state: dict[str, Any]) -> None:
        """Take over what ``arrays`` and ``state`` of the same kind gave; :class:`ValueError` if they do not fit."""
        ...


class Uniform:
    """Every transition alike, with replacement."""

    def added(self, place: int) -> None:
        pass

    def draw(self, stored: int, size: int, progress: float, generator: np.random.Generator) -> tuple[Places, None]:
        return generator.integers(stored, size=size), None

    def learned(self, places: Places, errors: Numbers) -> None:
        pass

    def arrays(self, stored: int) -> dict[str, Numbers]:
        return {}

    def state(self) -> dict[str, Any]:
        return {}

    def restore(self, stored: int, arrays: dict[str, Any], state: dict[str, Any]) -> None:
        if arrays or state:
            raise ValueError("it was sampled by priority")


class Prioritized:
    """Prioritized experience replay, the proportional variant (Schaul, Quan, Antonoglou and Silver, ICLR 2016, Algorithm 1).

    A transition is drawn in proportion to ``(|error| + epsilon)^alpha`` with the temporal difference of the last update that
    used it; a new one has the largest of all before, so that it is soon seen. One is drawn from each of as many equal ranges of
    the sum as the batch has rows (appendix B.2.1). Its error counts ``(stored * probability)^-beta``, over the largest of
    the batch; ``beta`` rises linearly from ``initial_beta`` to 1 at the end of the training.
    """

    def __init__(self, *, alpha: float, initial_beta: float, epsilon: float) -> None:
        self._alpha = checks.number("sampling.alpha", alpha, low=0.0, high=1.0)
        self._initial_beta = checks.number("sampling.initial_beta", initial_beta, low=0.0, high=1.0)
        self._epsilon = checks.number("sampling.epsilon", epsilon, low=0.0, high=1.0, open_low=True)
        self._tree = SumTree()
        self._largest = 1.0
        self._new: list[int] = []  # places that the tree does not know yet

    def added(self, place: int) -> None:
        self._new.append(place)

    def _settle(self) -> None:
        if self._new:
            self._tree.put(np.array(self._new), np.full(len(self._new), self._largest))
            self._new = []

    def draw(
        self, stored: int, size: int, progress: float, generator: np.random.Generator
    ) -> tuple[Places, NDArray[np.float32]]:
        self._settle()
        total = self._tree.total
        places = self._tree.find((np.arange(size) + generator.random(size)) * (total / size))
        beta = self._initial_beta + (1.0 - self._initial_beta) * min(1.0, progress)
        weights = (stored * self._tree.values(stored)[places] / total) ** -beta
        return places, (weights / weights.max())[:, np.newaxis].astype(np.float32)

    def learned(self, places: Places, errors: Numbers) -> None:
        self._settle()
        priorities = (np.abs(errors) + self._epsilon) ** self._alpha
        self._tree.put(places, priorities)
        self._largest = max(self._largest, float(priorities.max()))

    def arrays(self, stored: int) -> dict[str, Numbers]:
        self._settle()
        return {"priorities": self._tree.values(stored).copy()}

    def state(self) -> dict[str, Any]:
        return {"largest_priority": self._largest}

    def restore(self, stored: int, arrays: dict[str, Any], state: dict[str, Any]) -> None:
        priorities = arrays["priorities"]
        largest = checks.number("replay.largest_priority", state["largest_priority"], low=0.0, open_low=True)
        if priorities.shape != (stored,) or priorities.dtype != np.float64 or not (priorities > 0.0).all():
            raise ValueError(f"its priorities are not {stored} numbers above 0")
        self._largest, self._tree, self._new = largest, SumTree(), []
        if stored:
            self._tree.put(np.arange(stored), priorities)


class SumTree:
    """Numbers at places, and their sums over halves, quarters and so on: drawing one in proportion takes a step a level.

    It grows with its places. A sum is always that of its two parts, so that the tree depends on its numbers alone, not on
    the order in which they came.
    """

    def __init__(self) -> None:
        self._sums: Numbers = np.zeros(2)  # the root at 1, the parts of n at 2 n and 2 n + 1, the numbers in the second half

    @property
    def _width(self) -> int:
        return len(self._sums) // 2

    @property
    def total(self) -> float:
        """The sum of all numbers."""
        return float(self._sums[1])

    def values(self, count: int) -> Numbers:
        """The numbers at the first places, shape (count,): a view."""
        return self._sums[self._width : self._width + count]

    def put(self, places: Places, values: Numbers) -> None:
        """Write ``values`` to ``places``, at least one; the last one counts where a place is named twice."""
        if places.max() >= self._width:
            self._grow(int(places.max()) + 1)
        nodes = places + self._width
        self._sums[nodes] = values
        while nodes[0] > 1:
            nodes = nodes >> 1
            self._sums[nodes] = self._sums[2 * nodes] + self._sums[2 * nodes + 1]

    def _grow(self, places: int) -> None:
        values = self.values(self._width)
        width = 1 << (places - 1).bit_length()
        self._sums = np.zeros(2 * width)
        self._sums[width : width + len(values)] = values
        while width > 1:
            level = self._sums[width : 2 * width]
            self._sums[width // 2 : width] = level[::2] + level[1::2]
            width //= 2

    def find(self, masses: Numbers) -> Places:
        """For each of ``masses``, from 0 to ``total``, the place at which the sum of the numbers from the first on exceeds it.

        Never a place with the number 0, however the sums are rounded.
        """
        nodes, masses = np.ones(len(masses), np.int64), masses.copy()
        while nodes[0] < self._width:
            left, right = self._sums[2 * nodes], self._sums[2 * nodes + 1]
            beyond = (masses >= left) & (right > 0.0)
            masses -= np.where(beyond, left, 0.0)
            nodes = 2 * nodes + beyond
        return nodes - self._width
