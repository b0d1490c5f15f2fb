"""What a stored transition says of the future: how many rewards it adds up, and how much the state behind them counts."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks

Array = NDArray[np.float32]

PER: Final = ("decision", "control_step")


class Transition(NamedTuple):
    """What is stored: the critic's target for it is ``reward + discount * Q(next_observation, ...)``."""

    observation: Array  # (observation_size,)
    action: Array  # (action_size,)
    reward: float
    next_observation: Array  # (observation_size,)
    discount: float  # 0 after a termination: nothing is expected then


class Returns:
    """Discounts decisions, and turns them into transitions over up to ``n_steps`` of them.

    *Discount.* ``gamma`` counts per decision, as in the paper, where a longer hold sees further: 0.9 for 13 control steps is
    0.992 for one. Per control step every hold sees equally far: a decision of k of them counts ``gamma^k``, a second
    ``gamma^control_hz``. Such are the targets of a semi-Markov decision process (Bradtke and Duff 1995; Sutton, Precup and
    Singh 1999, section 3). A decision's reward tells of the state at its end: it is one reward, and undiscounted.

    *n-step targets* (Watkins 1989; Sutton 1988): the next n rewards, each discounted by the decisions before it, then the state
    behind them. As in D4PG and Rainbow, they are not corrected for a policy that has changed since. Fewer than n are added up
    where the chain of decisions is cut: at the end of an episode, before a new object, and before a decision that was not
    admitted or whose world exploded. What may not enter the buffer does not enter by a target either, and the state that was
    reached before it can be bootstrapped from. After a termination there is nothing to add.

    Between two episodes nothing is held back, so there is no state to be saved. Raises :class:`ValueError` with a sentence for
    values out of range.
    """

    def __init__(self, *, gamma: float, gamma_per: str, n_steps: int) -> None:
        self.gamma = checks.number("agent.gamma", gamma, low=0.0, high=1.0)
        self._per = checks.one_of("agent.gamma_per", gamma_per, PER)
        self._n_steps = checks.integer("agent.n_steps", n_steps, low=1, high=1000)
        self._open: list[tuple[Transition, int]] = []  # and over how many decisions it goes

    def discount(self, control_steps: int) -> float:
        """What the state after a decision of so many control steps counts."""
        return self.gamma if self._per == "decision" else self.gamma**control_steps

    @property
    def held_back(self) -> int:
        """How many decisions wait for the rewards of later ones."""
        return len({decisions for _, decisions in self._open})

    def add(self, decision: Transition, *within: Transition) -> list[Transition]:
        """Take in a decision, and what else is to be stored of it: transitions that end with it. Returns what is complete."""
        self._open = [(_longer(one, decision), decisions + 1) for one, decisions in self._open]
        self._open += [(one, 1) for one in (decision, *within)]
        done = [one for one, decisions in self._open if decisions == self._n_steps or one.discount == 0.0]
        self._open = [(one, decisions) for one, decisions in self._open if decisions < self._n_steps and one.discount > 0.0]
        return done

    def cut(self) -> list[Transition]:
        """No later decision belongs to those before. Returns what was held back, as long as it has become."""
        done, self._open = [one for one, _ in self._open], []
        return done


def _longer(one: Transition, decision: Transition) -> Transition:
    return one._replace(
        reward=one.reward + one.discount * decision.reward,
        next_observation=decision.next_observation,
        discount=one.discount * decision.discount,
    )
