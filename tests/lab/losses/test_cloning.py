"""BCLoss and IQLLoss against plain restatements of their equations.

"Offline Reinforcement Learning with Implicit Q-Learning" (Kostrikov et al. 2021,
https://arxiv.org/abs/2110.06169).
"""

from __future__ import annotations

import copy

import pytest
import torch
from objectives.losses import Networks, make_batch, update_targets
from objectives.plain import BOX, Plain, compare, following, prepare
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical, Normal
from torchrl.modules import ProbabilisticActor

from torchrl_osr.lab.losses import BCLoss, IQLLoss

BETA, TAU = 600.0, 0.8  # weights of advantages meet their limit


@pytest.mark.parametrize("number", [2, 3])
def test_iql_equals_the_restatement(check, number) -> None:
    networks, batch = Networks(number=number), make_batch("iql", 20)
    plain, value = Plain(networks, actor="gaussian"), copy.deepcopy(networks.value)

    def restated() -> dict[str, Tensor]:
        s, a = batch["observation"], batch["action"]
        lowest = plain.values(s, a, plain.targets).amin(0).detach()
        u = lowest - value.module(s).squeeze(-1)
        weight = torch.clamp(torch.exp(BETA * u.detach()), max=100)
        log_prob = plain.policy(s).log_prob(a).sum(-1)
        bootstrap = value.module(following(batch)).squeeze(-1).detach()
        return {
            "loss_actor": -(weight * log_prob).mean(),
            "loss_qvalue": plain.td_loss(batch, bootstrap),
            "loss_value": (torch.where(u < 0, 1 - TAU, TAU) * u.square()).mean(),
        }

    trained = {
        "loss_actor actor": plain.actor,
        "loss_qvalue qvalue": plain.critics,
        "loss_value value": value,
    }
    parts = networks.gaussian, networks.critics, networks.value
    options = {"temperature": BETA, "expectile": TAU}
    loss = prepare(update_targets(IQLLoss(*parts, **options).double()))
    compare(check, "IQL", loss, batch, restated, trained, 1e-10)


@pytest.mark.parametrize("kind", ["actor", "delta", "module"])
def test_cloning_equals_the_restatement(check, kind) -> None:
    networks, batch = Networks(**BOX), make_batch("bc", 10)
    actor, plain = copy.deepcopy(getattr(networks, kind)), Plain(networks, kind)
    s, a = batch["observation"], batch["action"]
    if kind == "actor":
        expected = -plain.log_prob(plain.policy(s), a).mean()
    else:
        # TorchRL moves a TanhDelta's parameter by the center.
        x = plain.actor[0].module(s) + plain.center if kind == "delta" else None
        x = plain.actor.module[0](s) if x is None else x
        action = plain.center + plain.half * torch.tanh(x)
        expected = (action - a).square().sum(-1).mean()
    slopes = torch.autograd.grad(expected, [*plain.actor.parameters()])
    loss = BCLoss(actor).double()
    value = loss(batch)["loss_actor"]
    value.backward()
    found = [value.detach(), *(each.grad for each in loss.parameters())]
    wanted = [expected.detach(), *slopes]
    check("Behaviour cloning", found, wanted, tolerance=1e-10)


@pytest.mark.parametrize("kind", ["normal", "categorical"])
def test_cloning_with_torchs_own_distributions(kind) -> None:
    torch.manual_seed(0)
    s, layer = torch.randn(10, 3), nn.Linear(3, 2)
    batch = TensorDict({"observation": s}, [10])
    if kind == "normal":  # a density for each dimension
        keys, density, options = ["loc"], Normal, {"scale": 0.5}
        batch["action"] = a = torch.randn(10, 2)
        expected = -Normal(layer(s), 0.5).log_prob(a).sum(-1).mean()
    else:
        keys, density, options = ["logits"], Categorical, {}
        batch["action"] = a = torch.arange(10) % 2
        expected = nn.functional.cross_entropy(layer(s), a)
    actor = ProbabilisticActor(
        TensorDictModule(layer, ["observation"], keys), in_keys=keys,
        distribution_class=density, distribution_kwargs=options,
    )  # fmt: skip
    torch.testing.assert_close(BCLoss(actor)(batch)["loss_actor"], expected)
