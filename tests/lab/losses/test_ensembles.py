"""EDACLoss and RORLLoss against plain restatements, critic by critic, draw by draw.

"Uncertainty-Based Offline Reinforcement Learning with Diversified Q-Ensemble" (An et
al. 2021, https://arxiv.org/abs/2110.01548); "RORL: Robust Offline Reinforcement
Learning via Conservative Smoothing" (Yang et al. 2022,
https://arxiv.org/abs/2206.02829), with the released code's reading.
"""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, make_batch, make_loss, update_targets
from objectives.plain import BOX, SOFT, Plain, compare, prepare
from torch import Tensor, nn
from torch.distributions import kl_divergence

from torchrl_osr.lab.losses import EDACLoss, RORLLoss
from torchrl_osr.lab.losses.ensembles import gradient_diversity


def diversity(plain: Plain, state: Tensor, action: Tensor) -> Tensor:
    """Return the similarity of the critics' action gradients, all pairs, ``[R]``."""
    leaf, units = action.clone().requires_grad_(), []
    for critic in plain.critics:
        value = plain.values(state, leaf, [critic]).sum()
        (gradient,) = torch.autograd.grad(value, leaf, create_graph=True)
        units.append(gradient / gradient.norm(dim=-1, keepdim=True))
    number = len(units)
    pairs = [(i, j) for i in range(number) for j in range(number) if i != j]
    return sum((units[i] * units[j]).sum(-1) for i, j in pairs) / (number - 1)


@pytest.mark.parametrize("number", [2, 4])
@pytest.mark.parametrize("weight", [0.75, 0.0])
def test_edac_equals_the_restatement(check, number, weight) -> None:
    networks, batch = Networks(number=number, **BOX), make_batch("edac", 10)
    plain, similarity = Plain(networks), []

    def restated() -> dict[str, Tensor]:
        found = plain.policy_losses(batch["observation"].unsqueeze(0))
        td = plain.td_loss(batch, plain.soft_value(batch, entropy=True))
        pair = batch["observation"], batch["action"]
        similarity.append(diversity(plain, *pair).mean())
        return found | {"loss_qvalue": td + weight * similarity[0]}

    options = SOFT | {"diversity_weight": weight}
    loss = EDACLoss(networks.actor, networks.critics, **options).double()
    update_targets(loss)
    label = "EDAC" if weight else "SAC-N"
    out = compare(check, label, prepare(loss), batch, restated, plain.networks)
    torch.testing.assert_close(out["diversity"], similarity[0].detach())


def test_critics_may_have_dropout() -> None:
    networks = Networks()
    for each in networks.critics:
        each.module.insert(1, nn.Dropout(0.5))
    loss = EDACLoss(networks.actor, networks.critics, diversity_weight=1.0).double()
    update_targets(loss)
    loss.set_vmap_randomness("different")
    assert all(each.isfinite() for each in loss(make_batch("edac", 10)).values())


def test_diversity_by_hand_and_of_a_dead_critic() -> None:
    # Three critics at 0, 90 and 180 degrees have the pairs 0, 0, -1 twice each.
    gradients = torch.tensor([[1.0, 0.0], [0.0, 3.0], [-2.0, 0.0]]).unsqueeze(1)
    assert gradient_diversity(gradients).tolist() == [-1]
    gradients = torch.zeros(2, 1, 3, requires_grad=True)
    gradient_diversity(gradients).sum().backward()
    assert gradients.grad.isfinite().all()


OPTIONS = {
    "num_samples": 4, "policy_smooth_reg": 0.7, "policy_smooth_eps": 0.3,
    "q_smooth_reg": 0.6, "q_smooth_eps": 0.2, "q_smooth_tau": 0.3,
    "q_ood_reg": 0.9, "q_ood_eps": 0.4, "q_ood_uncertainty_reg": 1.5,
    "q_ood_uncertainty_reg_min": 0.5, "q_ood_uncertainty_decay": 0.3,
}  # fmt: skip
PARTS = {
    "all": {},
    "policy alone": {"q_smooth_reg": 0.0, "q_ood_reg": 0.0},
    "values alone": {"policy_smooth_reg": 0.0, "q_ood_reg": 0.0},
    "uncertainty alone": {"policy_smooth_reg": 0.0, "q_smooth_reg": 0.0},
    "none": {"policy_smooth_reg": 0.0, "q_smooth_reg": 0.0, "q_ood_reg": 0.0},
}


def restated(plain: Plain, batch, options, weight: float) -> dict[str, Tensor]:
    """Return the losses; ``weight`` is that of the uncertainty."""
    s, a, number = batch["observation"], batch["action"], options["num_samples"]

    def around(epsilon: float) -> list[Tensor]:
        box = torch.empty(number, s.shape[-1], dtype=s.dtype)
        return [s + delta for delta in box.uniform_(-epsilon, epsilon)]

    losses = plain.policy_losses(s.unsqueeze(0))
    if options["policy_smooth_reg"]:
        pi, found = plain.policy(s), []
        for state in around(options["policy_smooth_eps"]):
            other = plain.policy(state)
            both = kl_divergence(pi, other) + kl_divergence(other, pi)
            found.append(both.sum(-1))
        smoothness = torch.stack([max(row) for row in zip(*found, strict=True)]).mean()
        losses["loss_actor"] += options["policy_smooth_reg"] * smoothness
    total = plain.td_loss(batch, plain.soft_value(batch, entropy=True))
    if options["q_smooth_reg"]:
        clean, found = plain.values(s, a), []
        for state in around(options["q_smooth_eps"]):
            change = plain.values(state, a) - clean
            tau = options["q_smooth_tau"]
            share = torch.where(change > 0, 1 - tau, tau)
            found.append((share * change.square()).mean(0))
        smoothness = torch.stack([max(row) for row in zip(*found, strict=True)]).mean()
        total = total + options["q_smooth_reg"] * smoothness
    if options["q_ood_reg"]:
        states = torch.stack(around(options["q_ood_eps"]))
        with torch.no_grad():
            noise = torch.randn(*states.shape[:-1], 2, dtype=s.dtype)
            actions, _ = plain.act(plain.policy(states), noise)
        values = plain.values(states, actions)
        pulled = (values - weight * values.std(0, correction=1)).detach()
        total = total + options["q_ood_reg"] * nn.functional.mse_loss(values, pulled)
    return losses | {"loss_qvalue": total}


@pytest.mark.parametrize("part", PARTS)
def test_rorl_equals_the_restatement(check, part) -> None:
    networks, batch = Networks(number=3), make_batch("rorl", 10)
    plain, options = Plain(networks), OPTIONS | PARTS[part]
    loss = RORLLoss(networks.actor, networks.critics, **(SOFT | options)).double()
    update_targets(loss)
    loss.decay_uncertainty()
    expected = lambda: restated(plain, batch, options, weight=1.2)  # noqa: E731
    out = compare(check, "RORL", prepare(loss), batch, expected, plain.networks, 1e-10)
    assert loss.out_keys == [*out.keys()]


def test_weight_of_the_uncertainty_falls_to_its_floor_and_is_saved() -> None:
    options = OPTIONS | {"q_ood_uncertainty_reg": 1.0}
    loss, seen = make_loss("rorl", **options), []
    for _ in range(4):
        seen.append(loss.uncertainty_weight.item())
        loss.decay_uncertainty()
    assert seen == pytest.approx([1.0, 0.7, 0.5, 0.5])
    other = make_loss("rorl", **options)
    other.load_state_dict(loss.state_dict())
    assert other.num_updates == 4
    # A million small steps, of which each is lost in float32.
    options = {"q_ood_uncertainty_reg": 4.0, "q_ood_uncertainty_decay": 1e-7}
    networks = Networks()
    single = RORLLoss(networks.actor, networks.critics, **options)
    single.num_updates += 10**6 - 1
    single.decay_uncertainty()
    assert single.uncertainty_weight.item() == pytest.approx(3.9)
