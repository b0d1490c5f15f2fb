"""Deep deterministic policy gradient (Lillicrap et al. 2016), as section 3.5 of the paper uses it.

The networks are small, so the time of an update is its ten 128 x 400 x 300 matrix products plus overhead; ``network``
keeps that small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from torch import Tensor

from uarm_rl import checks
from uarm_rl.learn.network import Network
from uarm_rl.learn.replay import Batch
from uarm_rl.learn.returns import Returns
from uarm_rl.task.observation import PaperObservation
from uarm_rl.task.policy import ActorPolicy, PolicyCard

#: An output of the actor beyond this counts as saturated: the slope of its tanh is below 0.02.
_SATURATED: Final = 0.99


class DivergenceError(ArithmeticError):
    """A number of the training is not finite; the message names it."""


def _forms(tensors: dict[str, Tensor]) -> dict[str, tuple[torch.Size, torch.dtype]]:
    return {name: (tensor.shape, tensor.dtype) for name, tensor in tensors.items()}


class DDPG:
    """Actor, critic and their targets. Knows nothing of buffers, noise or logs.

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
        action_size: int,
        generator: torch.Generator,
        observation: PaperObservation | None = None,
    ) -> None:
        self.observation = observation or PaperObservation()
        hidden = checks.integers("agent.hidden", hidden, low=1, high=10_000)
        self.errors = np.empty((0, 1), np.float32)
        self.returns = Returns(gamma=gamma, gamma_per=gamma_per, n_steps=n_steps)
        self.tau = checks.number("agent.tau", tau, low=0.0, high=1.0, open_low=True)
        final = checks.number("agent.final_layer_init", final_layer_init, low=0.0, high=1e3, open_low=True)
        self._annealing = checks.number("agent.annealing", annealing, low=0.0, high=1.0)
        actor_sizes = [self.observation.size, *hidden, action_size]
        critic_sizes = [self.observation.size + action_size, *hidden, 1]
        split = Network.size(actor_sizes)
        self.parameters = torch.empty(split + Network.size(critic_sizes))
        self._gradient = torch.zeros_like(self.parameters)
        self.actor = Network(actor_sizes, self.parameters[:split], self._gradient[:split])
        self.critic = Network(critic_sizes, self.parameters[split:], self._gradient[split:])
        self.actor.initialise(generator, final)
        self.critic.initialise(generator, final)
        self.target_parameters = self.parameters.clone()
        self.target_actor = Network(actor_sizes, self.target_parameters[:split])
        self.target_critic = Network(critic_sizes, self.target_parameters[split:])
        self._optimizers = {
            "actor": self._adam(
                slice(None, split), checks.number("agent.actor_lr", actor_lr, low=0.0, high=1.0, open_low=True)
            ),
            "critic": self._adam(
                slice(split, None), checks.number("agent.critic_lr", critic_lr, low=0.0, high=1.0, open_low=True)
            ),
        }

    def _adam(self, part: slice, learning_rate: float) -> torch.optim.Adam:
        parameters = self.parameters[part]
        parameters.grad = self._gradient[part]
        optimizer = torch.optim.Adam([{"params": parameters, "initial_lr": learning_rate}], lr=learning_rate, fused=True)
        optimizer.state[parameters] = {  # as Adam itself would begin; made here so that it can be saved at any time
            "step": torch.zeros(()),
            "exp_avg": torch.zeros_like(parameters),
            "exp_avg_sq": torch.zeros_like(parameters),
        }
        return optimizer

    def policy(self, card: PolicyCard) -> ActorPolicy:
        """The actor as a policy that follows every later update (its weights are views of this agent's)."""
        layers = [(weight.numpy(), bias.numpy()) for weight, bias in self.actor.layers]
        return ActorPolicy(layers, offset=self.observation.offset, scale=self.observation.scale, card=card)

    def update(self, batch: Batch, progress: float = 0.0) -> dict[str, float]:
        """One gradient step of critic and actor, one soft step of the targets. ``progress`` runs from 0 to 1 over the training.

        Returns the two losses, the range of Q(s, mu(s)) over the batch, and ``saturation``, the share of the actor's
        outputs so close to -1 or 1 that hardly any gradient comes back through the tanh.

        Raises :class:`DivergenceError` when a loss is not finite, as it is in the update after a weight became so.
        """
        # The moments of weights that no longer learn fade into denormal numbers, which are slow. Elsewhere in this
        # process (in the physics) they keep their meaning, so that it computes what it computes in a process of its own.
        torch.set_flush_denormal(True)
        if self._annealing:
            for optimizer in self._optimizers.values():
                (group,) = optimizer.param_groups
                group["lr"] = group["initial_lr"] * min(1.0, (1.0 - progress) / self._annealing)
        try:
            with torch.no_grad():
                return self._update(batch)
        finally:
            torch.set_flush_denormal(False)

    def _update(self, batch: Batch) -> dict[str, float]:
        offset, scale = self.observation.offset, self.observation.scale
        observations, next_observations = ((raw - offset) / scale for raw in (batch.observation, batch.next_observation))
        both = torch.from_numpy(np.concatenate((observations, batch.action), axis=1))
        reward, discount = torch.from_numpy(batch.reward), torch.from_numpy(batch.discount)
        size = len(reward)

        # Critic: L = mean (y - Q(s, a))^2 with y = r + discount Q'(s', mu'(s')).
        x = torch.from_numpy(next_observations)
        next_action = self.target_actor.forward(x).tanh_()
        next_q = self.target_critic.forward(torch.cat((x, next_action), 1))
        error = self.critic.forward(both) - (reward + discount * next_q)
        weighted = error if batch.weight is None else error * torch.from_numpy(batch.weight)
        self.critic.backward(weighted * (2.0 / size))
        self.errors = error.numpy()
        self._optimizers["critic"].step()

        # Actor: ascend Q(s, mu(s)), the deterministic policy gradient (eq. 3).
        x = torch.from_numpy(observations)
        action = self.actor.forward(x).tanh_()
        q = self.critic.forward(torch.cat((x, action), 1))
        into_action = self.critic.input_gradient(torch.full((size, 1), -1.0 / size), self.observation.size)
        self.actor.backward(into_action * (1.0 - action * action))
        self._optimizers["actor"].step()

        self.target_parameters.lerp_(self.parameters, self.tau)
        lowest, highest = q.aminmax()
        metrics = {
            "critic_loss": error.square().mean().item(),
            "actor_loss": -q.mean().item(),
            "q_min": lowest.item(),
            "q_max": highest.item(),
            "saturation": action.abs().gt_(_SATURATED).mean().item(),
        }
        if not all(math.isfinite(metric) for metric in metrics.values()):
            raise DivergenceError(f"training diverged: {self._not_finite(batch)} no longer finite; the last checkpoint is good")
        return metrics

    def _not_finite(self, batch: Batch) -> str:
        """Names of what holds numbers that are not finite, causes before their consequences."""
        fields = {
            f"the batch's {name}": torch.from_numpy(field) for name, field in batch._asdict().items() if field is not None
        }
        held = fields | {"the gradient": self._gradient} | self.tensors()
        return ", ".join(name for name, tensor in held.items() if not tensor.isfinite().all()) or "the loss"

    def tensors(self) -> dict[str, Tensor]:
        """Everything an exact resume needs, by name: parameters, targets, both optimisers' moments and steps."""
        tensors = {"parameters": self.parameters, "target_parameters": self.target_parameters}
        for name, optimizer in self._optimizers.items():
            (state,) = optimizer.state.values()
            tensors |= {f"{name}_{key}": value for key, value in state.items()}
        return tensors

    def load_tensors(self, tensors: dict[str, Tensor]) -> None:
        """Take over what ``tensors()`` of another agent of the same shape gave; ``ValueError`` if it does not fit."""
        own = self.tensors()
        if _forms(own) != _forms(tensors):
            raise ValueError("the checkpoint holds networks of another shape than agent.hidden describes")
        for name, value in tensors.items():
            own[name].copy_(value)
