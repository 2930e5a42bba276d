"""The perturbations that an adversary finds, against plain loops."""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, call, make_batch, make_loss
from objectives.plain import Plain
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import kl_divergence
from torchrl.modules import TanhNormal

from torchrl_osr.lab.losses.adversary import Adversary

OBJECTIVES, METHODS = ["action_diff", "min_Q"], ["sample", "gradient"]
KEYS = ["observation"]

both_objectives = pytest.mark.parametrize("objective", OBJECTIVES)
both_methods = pytest.mark.parametrize("method", METHODS)


class Real:
    """Networks as functions, and states; draws are from a generator of their own."""

    def __init__(self) -> None:
        self.networks, self.states = Networks(), make_batch("bc", 6).select(*KEYS)
        self.plain = Plain(self.networks)

    def policy(self, states: TensorDict) -> TanhNormal:
        return self.networks.actor.get_dist(states.select(*KEYS))

    def qvalue(self, states: TensorDict, action: Tensor) -> Tensor:
        return self.plain.values(states["observation"], action)

    def perturb(self, adversary: Adversary, seed: int | None = 3) -> Tensor:
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        functions = self.policy, self.qvalue
        return adversary.perturb(self.states, KEYS, *functions, generator)[KEYS[0]]

    def draw(self, adversary: Adversary) -> Tensor:
        generator, shape = torch.Generator(), (adversary.num_samples, 6, 3)
        generator.manual_seed(3)
        uniform = torch.rand(shape, generator=generator, dtype=torch.float64)
        return adversary.epsilon * (2 * uniform - 1)

    def scores(self, objective: str, deltas: Tensor) -> Tensor:
        """Return the objective by torch.distributions, ``[M, R]``."""
        state, rows = self.states["observation"], []
        for delta in deltas:
            p, q = self.plain.policy(state), self.plain.policy(state + delta)
            if objective == "min_Q":
                rows.append(-self.plain.values(state, torch.tanh(q.loc)).mean(0))
            else:
                rows.append((kl_divergence(p, q) + kl_divergence(q, p)).sum(-1))
        return torch.stack(rows)


@both_objectives
def test_sampling_equals_a_plain_loop_over_the_same_draws(check, objective) -> None:
    real, adversary = Real(), Adversary(objective, epsilon=0.5, num_samples=7)
    deltas = real.draw(adversary)
    if objective == "min_Q":
        deltas = torch.cat([torch.zeros_like(deltas[:1]), deltas])
    found = real.scores(objective, deltas)
    expected = real.states["observation"].clone()
    for row in range(6):
        best = max(range(len(deltas)), key=lambda i: found[i, row].item())
        expected[row] += deltas[best, row]
    check("Adversary", [real.perturb(adversary)], [expected], tolerance=1e-13)


@both_objectives
@pytest.mark.parametrize("num_samples", [1, 4])
def test_gradient_steps_are_the_released_attacks(check, objective, num_samples) -> None:
    """A new Adam for each step, on the mean over rows, then back into the box."""
    real = Real()
    adversary = Adversary(objective, "gradient", 0.3, num_samples, 10, 0.25)
    deltas = real.draw(adversary)
    for _ in range(adversary.num_steps):
        deltas = deltas.clone().requires_grad_()
        optimizer = torch.optim.Adam([deltas], lr=adversary.step_size * 0.3)
        score = real.scores(objective, deltas).mean()
        (deltas.grad,) = torch.autograd.grad(-score, [deltas])
        optimizer.step()
        deltas = deltas.detach().clamp(-0.3, 0.3)
    best = real.scores(objective, deltas).argmax(0)
    expected = real.states["observation"] + deltas[best, torch.arange(6)]
    # Adam adds 1e-8 to the size of a gradient before it divides by it.
    check("Adversary", [real.perturb(adversary)], [expected], tolerance=1e-4)


@both_objectives
@both_methods
def test_a_loss_is_given_the_worst_states_of_its_networks(objective, method) -> None:
    adversary = Adversary(objective, method, epsilon=0.1, num_samples=3, num_steps=2)
    networks, batch = Networks(), make_batch("osr", 6)
    loss, real = make_loss("osr", networks), Real()
    before, real.states = batch.clone(), batch.select(*KEYS)
    torch.manual_seed(3)
    found = adversary(loss, batch)
    torch.manual_seed(3)
    written = found["perturbed", "observation"]
    torch.testing.assert_close(written, real.perturb(adversary, seed=None))
    assert (found.exclude("perturbed") == batch.exclude("perturbed")).all()
    assert (batch == before).all()
    assert not written.requires_grad
    assert all(parameter.grad is None for parameter in loss.parameters())
    assert all(value.isfinite() for value in call(loss, found).values())
    loss.set_keys(perturbed=("worst", "state"))
    assert ("worst", "state", "observation") in adversary(loss, batch).keys(True)
