"""The learner: its written-out gradients against autograd, its targets, its steps, its memory."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional

from tests.conftest import AGENT
from uarm_rl.learn.ddpg import DDPG, DivergenceError
from uarm_rl.learn.replay import Batch
from uarm_rl.task import observation

SETTINGS = AGENT | {"actor_lr": 1e-3}


def agent(seed: int = 0, **changes: object) -> DDPG:
    generator = torch.Generator().manual_seed(seed)
    return DDPG(**{"hidden": [40, 30], **SETTINGS, **changes}, action_size=3, generator=generator)


def batch(size: int = 64, seed: int = 0, discount: float | None = None) -> Batch:
    generator = np.random.default_rng(seed)
    spread = (size, observation.SIZE)
    ends = 0.9 * generator.integers(0, 2, (size, 1)) if discount is None else np.full((size, 1), discount)
    return Batch(
        *(
            array.astype(np.float32)
            for array in (
                generator.normal(0, 0.2, spread),
                generator.uniform(-1, 1, (size, 3)),
                generator.normal(0, 1, (size, 1)),
                generator.normal(0, 0.2, spread),
                ends,
            )
        )
    )


class Reference:
    """DDPG as a textbook writes it: autograd, one tensor a layer, unfused Adam."""

    def __init__(self, like: DDPG, huber: float | None = None, action_l2: float = 0.0) -> None:
        self.huber, self.action_l2 = huber, action_l2
        self.networks = {
            name: [tensor.clone() for layer in network.layers for tensor in layer]
            for name, network in {
                "actor": like.actor,
                "critic": like.critic,
                "target_actor": like.target_actor,
                "target_critic": like.target_critic,
            }.items()
        }
        self.optimizers = {}
        for name in ("actor", "critic"):
            for tensor in self.networks[name]:
                tensor.requires_grad_(True)
            self.optimizers[name] = torch.optim.Adam(self.networks[name], lr=1e-3, fused=False, foreach=False)

    def run(self, name: str, x: torch.Tensor) -> torch.Tensor:
        tensors = self.networks[name]
        for weight, bias in zip(tensors[:-2:2], tensors[1:-2:2], strict=True):
            x = functional.relu(x @ weight + bias)
        return x @ tensors[-2] + tensors[-1]

    def q(self, name: str, x: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return self.run(name, torch.cat((x, action), 1))

    def update(self, sample: Batch, tau: float = 0.01) -> dict[str, float]:
        scaled = [(field - observation.OFFSET) / observation.SCALE for field in (sample.observation, sample.next_observation)]
        x, next_x = (torch.from_numpy(field) for field in scaled)
        action, reward, discount = (torch.from_numpy(field) for field in (sample.action, sample.reward, sample.discount))
        with torch.no_grad():
            next_q = self.q("target_critic", next_x, torch.tanh(self.run("target_actor", next_x)))
            y = reward + discount * next_q
        value = self.q("critic", x, action)
        critic_loss = functional.mse_loss(value, y)
        self.step("critic", 2 * functional.huber_loss(value, y, delta=self.huber) if self.huber else critic_loss)
        own_action = torch.tanh(self.run("actor", x))
        q = self.q("critic", x, own_action)
        actor_loss = -q.mean()
        self.step("actor", actor_loss + self.action_l2 * own_action.square().sum(1).mean())
        with torch.no_grad():
            for name in ("actor", "critic"):
                for target, source in zip(self.networks[f"target_{name}"], self.networks[name], strict=True):
                    target.mul_(1 - tau).add_(tau * source)
        return {
            "critic_loss": critic_loss.item(),
            "actor_loss": actor_loss.item(),
            "q_min": q.min().item(),
            "q_max": q.max().item(),
            "saturation": (own_action.abs() > 0.99).double().mean().item(),
        }

    def step(self, name: str, loss: torch.Tensor) -> None:
        self.optimizers[name].zero_grad()
        self.optimizers["critic"].zero_grad()
        loss.backward(inputs=self.networks[name])
        self.optimizers[name].step()


@pytest.mark.parametrize(("huber", "action_l2"), [(None, 0.0), (0.3, 0.2)])
@pytest.mark.parametrize("final_layer_init", [0.1, 3.0])  # the second saturates the actor
def test_updates_are_those_of_the_textbook(final_layer_init, huber, action_l2):
    ours = agent(final_layer_init=final_layer_init, huber=huber, action_l2=action_l2)
    reference = Reference(ours, huber, action_l2)
    for seed in range(20):
        assert ours.update(batch(seed=seed)) == pytest.approx(reference.update(batch(seed=seed)), rel=1e-3, abs=1e-4)
    for name, tensors in reference.networks.items():
        flat = torch.cat([tensor.flatten() for layer in getattr(ours, name).layers for tensor in layer])
        expected = torch.cat([tensor.detach().flatten() for tensor in tensors])
        assert torch.allclose(flat, expected, atol=2e-5), name


def test_steps_shorten_towards_the_end_where_that_is_asked_for():
    steady, annealed = agent(), agent(annealing=0.5)
    for progress, same in ((0.0, True), (0.5, True), (0.75, False)):
        for one in (steady, annealed):
            one.update(batch(), progress)
        assert torch.equal(steady.parameters, annealed.parameters) == same
    before = annealed.parameters.clone()
    annealed.update(batch(), 1.0)
    assert torch.equal(annealed.parameters, before)


def test_networks_begin_as_in_the_ddpg_paper():
    ours = agent(hidden=[400, 300], final_layer_init=3e-3)
    for network in (ours.actor, ours.critic):
        *hidden, last = network.layers
        for (weight, bias), bound in [*((layer, 1 / len(layer[0]) ** 0.5) for layer in hidden), (last, 3e-3)]:
            assert max(weight.abs().max(), bias.abs().max()) <= bound
            assert weight.std() == pytest.approx(bound / 3**0.5, rel=0.1)  # uniform
    assert torch.equal(ours.target_parameters, ours.parameters)


def test_nothing_is_expected_after_a_termination():
    ours = agent()
    ends, goes_on = batch(discount=0.0), batch(discount=0.9)
    with torch.no_grad():
        q = ours.critic.forward(torch.from_numpy(np.hstack([scaled(ends.observation), ends.action])))
    expected = ((q.numpy() - ends.reward) ** 2).mean()
    assert agent().update(ends)["critic_loss"] == pytest.approx(expected, rel=1e-5)
    assert agent().update(goes_on)["critic_loss"] != pytest.approx(expected, rel=1e-4)


def scaled(raw: np.ndarray) -> np.ndarray:
    return (raw - observation.OFFSET) / observation.SCALE


def test_targets_follow_slowly():
    ours = agent(tau=0.25)
    before = ours.target_parameters.clone()
    ours.update(batch())
    torch.testing.assert_close(ours.target_parameters, 0.75 * before + 0.25 * ours.parameters)


def test_the_critic_learns_a_fixed_batch_and_the_actor_climbs():
    ours = agent()
    sample = batch(discount=0.0)
    losses = [ours.update(sample) for _ in range(300)]
    assert losses[-1]["critic_loss"] < 0.2 * losses[0]["critic_loss"]
    assert losses[-1]["actor_loss"] < losses[100]["actor_loss"]


def test_updates_are_a_function_of_seed_and_batches():
    first, second, other = agent(seed=1), agent(seed=1), agent(seed=2)
    for seed in range(3):
        for one in (first, second, other):
            one.update(batch(seed=seed))
    assert torch.equal(first.parameters, second.parameters)
    assert not torch.equal(first.parameters, other.parameters)


def test_the_numpy_policy_is_the_actor_and_follows_it():
    ours = agent(hidden=[400, 300])
    policy = ours.policy({})
    for seed in range(3):
        sample = batch(seed=seed)
        with torch.no_grad():
            expected = torch.tanh(ours.actor.forward(torch.from_numpy(scaled(sample.observation)))).numpy()
        actions = np.array([policy.act(row) for row in sample.observation])
        np.testing.assert_allclose(actions, expected, atol=2e-6)
        ours.update(sample)


def test_saved_tensors_resume_exactly():
    ours = agent()
    for seed in range(5):
        ours.update(batch(seed=seed))
    saved = {name: tensor.clone() for name, tensor in ours.tensors().items()}
    resumed = agent(seed=9)
    resumed.load_tensors(saved)
    for seed in range(5, 10):
        assert ours.update(batch(seed=seed)) == resumed.update(batch(seed=seed))
    assert all(torch.equal(tensor, resumed.tensors()[name]) for name, tensor in ours.tensors().items())


def test_tensors_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="another shape"):
        agent().load_tensors(agent(hidden=[40, 31]).tensors())


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"gamma": 2}, "agent.gamma must be a number from 0 to 1, got 2"),
        ({"gamma_per": "second"}, "agent.gamma_per must be decision or control_step, got 'second'"),
        ({"n_steps": 0}, "agent.n_steps must be a whole number from 1 to 1000, got 0"),
        ({"tau": 0}, "agent.tau must be a number above 0 and at most 1, got 0"),
        ({"hidden": [0]}, "agent.hidden must be a whole number from 1 to 10000, got 0"),
        ({"actor_lr": float("nan")}, "agent.actor_lr must be a finite number above 0 and at most 1, got nan"),
    ],
)
def test_bad_values_are_refused_in_a_sentence(change, sentence):
    with pytest.raises(ValueError, match=sentence):
        agent(**change)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("place", ["observation", "action", "reward", "next_observation", "discount"])
def test_a_number_that_is_not_finite_is_named_at_once(place, bad):
    sample = batch(discount=0.9)
    getattr(sample, place)[3] = bad
    with pytest.raises(DivergenceError, match=f"the batch's {place}"):
        agent().update(sample)


@pytest.mark.parametrize(
    "place", ["parameters", "target_parameters", "actor_exp_avg", "critic_exp_avg", "actor_exp_avg_sq", "critic_exp_avg_sq"]
)
def test_a_weight_or_moment_that_is_not_finite_is_named_within_an_update(place):
    ours = agent()
    ours.update(batch())
    ours.tensors()[place].fill_(float("nan"))
    with pytest.raises(DivergenceError, match=place):
        for seed in range(2):
            ours.update(batch(seed=seed))
