"""EDACLoss against a plain restatement of its equations, critic by critic.

"Uncertainty-Based Offline Reinforcement Learning with Diversified Q-Ensemble" (An et
al. 2021, https://arxiv.org/abs/2110.01548).
"""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, make_batch, update_targets
from objectives.plain import BOX, SOFT, Plain, compare, prepare
from torch import Tensor

from torchrl_osr.lab.losses import EDACLoss
from torchrl_osr.lab.losses.edac import gradient_diversity


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
def test_losses_and_gradients_equal_the_restatement(check, number, weight) -> None:
    networks, batch = Networks(number=number, **BOX), make_batch("edac", 10)
    plain, similarity = Plain(networks), []

    def restated() -> dict[str, Tensor]:
        found = plain.policy_losses(batch["observation"].unsqueeze(0))
        td = plain.td_loss(batch, plain.soft_value(batch, entropy=True))
        similarity.append(
            diversity(plain, batch["observation"], batch["action"]).mean()
        )
        return found | {"loss_qvalue": td + weight * similarity[0]}

    options = SOFT | {"diversity_weight": weight}
    loss = EDACLoss(networks.actor, networks.critics, **options).double()
    update_targets(loss)
    label = "EDAC" if weight else "SAC-N"
    out = compare(check, label, prepare(loss), batch, restated, plain.networks)
    torch.testing.assert_close(out["diversity"], similarity[0].detach())


# Three critics at 0, 90 and 180 degrees have the pairs 0, 0, -1 twice each.
@pytest.mark.parametrize(
    ("gradients", "expected"),
    [
        ([[2.0, 0.0], [-1.0, 0.0]], -2.0),
        ([[1.0, 0.0], [0.0, 3.0], [-2.0, 0.0]], -1.0),
        ([[1.0, 1.0], [1.0, 1.0], [1.0, 1.0]], 3.0),
    ],
)
def test_diversity_by_hand(gradients, expected) -> None:
    value = gradient_diversity(torch.tensor(gradients).unsqueeze(1))
    torch.testing.assert_close(value, torch.tensor([expected]))


def test_diversity_of_a_dead_critic_is_finite() -> None:
    gradients = torch.zeros(2, 1, 3, requires_grad=True)
    gradient_diversity(gradients).sum().backward()
    assert gradients.grad.isfinite().all()
