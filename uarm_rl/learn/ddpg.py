"""Deep deterministic policy gradient (Lillicrap et al. 2016), as section 3.5 of the paper uses it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from uarm_rl import checks
from uarm_rl.learn.actor_critic import ActorCritic, DivergenceError, Rates, Tensors, named
from uarm_rl.learn.replay import Batch
from uarm_rl.learn.returns import Returns
from uarm_rl.task.observation import PaperObservation
from uarm_rl.task.policy import ActorPolicy, PolicyCard


def _forms(tensors: dict[str, Tensor]) -> dict[str, tuple[torch.Size, torch.dtype]]:
    return {name: (tensor.shape, tensor.dtype) for name, tensor in tensors.items()}


class DDPG(ActorCritic):
    """One agent. Knows nothing of buffers, noise or logs.

    ``observation`` says what is seen, the paper's 20 numbers if left out, and how it is scaled. ``generator`` draws the initial
    parameters; after that an update is a pure function of its batch. ``returns`` makes the transitions that it is to learn
    from; ``errors``, shape (n, 1), are the temporal differences of the last update.
    """

    def __init__(
        self,
        *,
        hidden: Sequence[int],
        gamma: float,
        gamma_per: str,
        n_steps: int,
        tau: float,
        actor_lr: float,
        critic_lr: float,
        final_layer_init: float,
        annealing: float,
        huber: float | None,
        action_l2: float,
        action_size: int,
        generator: torch.Generator,
        observation: PaperObservation | None = None,
    ) -> None:
        self.observation = observation or PaperObservation()
        hidden = checks.integers("agent.hidden", hidden, low=1, high=10_000)
        self.errors = np.empty((0, 1), np.float32)
        self.returns = Returns(gamma=gamma, gamma_per=gamma_per, n_steps=n_steps)
        self.rates = Rates(
            tau=checks.number("agent.tau", tau, low=0.0, high=1.0, open_low=True),
            actor_lr=checks.number("agent.actor_lr", actor_lr, low=0.0, high=1.0, open_low=True),
            critic_lr=checks.number("agent.critic_lr", critic_lr, low=0.0, high=1.0, open_low=True),
            annealing=checks.number("agent.annealing", annealing, low=0.0, high=1.0),
            huber=None if huber is None else checks.number("agent.huber", huber, low=0.0, high=1e6, open_low=True),
            action_l2=checks.number("agent.action_l2", action_l2, low=0.0, high=1e6),
        )
        final = checks.number("agent.final_layer_init", final_layer_init, low=0.0, high=1e3, open_low=True)
        seen = self.observation.size
        super().__init__(
            ([seen, *hidden, action_size], [seen + action_size, *hidden, 1]),
            self.rates,
            offset=torch.tensor(self.observation.offset),
            scale=torch.tensor(self.observation.scale),
        )
        for network in (self.actor, self.critic):
            network.initialise(generator, final)
        self.target_parameters.copy_(self.parameters)

    def policy(self, card: PolicyCard) -> ActorPolicy:
        """The actor as a policy that follows every later update (its weights are views of this agent's)."""
        layers = [(weight.numpy(), bias.numpy()) for weight, bias in self.actor.layers]
        return ActorPolicy(layers, offset=self.observation.offset, scale=self.observation.scale, card=card)

    def update(self, batch: Batch, progress: float = 0.0) -> dict[str, float]:
        """One gradient step of critic and actor, one soft step of the targets; the metrics by name.

        ``progress`` runs from 0 to 1 over the training.

        Raises :class:`DivergenceError` when a loss is not finite, as it is in the update after a weight became so.
        """
        given = Tensors(*(None if field is None else torch.from_numpy(field) for field in batch))  # type: ignore[arg-type]
        self.anneal(0, progress)
        errors, metrics = self.learn(given)
        self.errors = errors.numpy()
        self.check(metrics, {f"the batch's {name}": field for name, field in given._asdict().items()})
        return named(metrics)

    def check(self, numbers: Tensor, batch: Mapping[str, Tensor | None] = {}) -> None:
        """Raises :class:`DivergenceError` if one of the ``numbers`` is not finite, naming what else is not, causes first."""
        if not numbers.isfinite().all():
            held = {**batch, "the gradient": self._gradient, **self.tensors()}
            names = [name for name, tensor in held.items() if tensor is not None and not tensor.isfinite().all()]
            what = ", ".join(names) or "the loss"
            raise DivergenceError(f"training diverged: {what} no longer finite; the last checkpoint is good")

    def load_tensors(self, tensors: dict[str, Tensor]) -> None:
        """Take over what ``tensors()`` of another agent of the same shape gave; ``ValueError`` if it does not fit."""
        own = self.tensors()
        if _forms(own) != _forms(tensors):
            raise ValueError("the checkpoint holds networks of another shape than agent.hidden describes")
        for name, value in tensors.items():
            own[name].copy_(value)
