"""DiscreteOSRLoss against a plain restatement, action by action, and by hand."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from objectives.losses import Networks, assert_same_bits, make_batch, make_loss, record
from objectives.plain import ALPHA, GAMMA, TARGET_SCALE, compare, following, prepare
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Categorical, kl_divergence
from torch.distributions import OneHotCategorical as TorchOneHotCategorical
from torchrl.modules import OneHotCategorical

ACTIONS, TEMPERATURE, WEIGHT, TARGET_ENTROPY = 4, 1.7, 2.5, 0.98 * math.log(4)
OPTIONS = {"min_q_weight": WEIGHT, "temperature": TEMPERATURE}


def restated(networks: Networks, batch: TensorDict, recovery_weight: float):
    """Return the losses as a function, and the networks that they train."""
    actor, critics, model = copy.deepcopy(
        (networks.chooser, networks.choice_critics, networks.choice_model)
    )
    targets = copy.deepcopy(critics)
    for parameter in (each for target in targets for each in target.parameters()):
        parameter.data.mul_(TARGET_SCALE)
    log_alpha = torch.tensor(math.log(ALPHA), dtype=torch.float64).requires_grad_()
    s, index = batch["observation"], batch["action"].argmax(-1)
    s_next, reward = following(batch), batch["next", "reward"].squeeze(-1)
    done, ended = (batch["next", key].squeeze(-1) for key in ("done", "terminated"))
    sets = [s, batch["perturbed", "observation"]]
    states = torch.stack(sets if recovery_weight else sets[:1])

    def policy(state: Tensor) -> Categorical:
        return Categorical(logits=actor[0](state))

    def expectation(pi: Categorical, values: Tensor) -> Tensor:
        return sum(pi.probs[..., a] * values[..., a] for a in range(ACTIONS))

    def lowest(ensemble, state: Tensor) -> Tensor:
        return torch.stack([each.module(state) for each in ensemble]).amin(0)

    def losses() -> dict[str, Tensor]:
        pi, alpha = policy(states), log_alpha.detach().exp()
        entropy = -expectation(pi, pi.logits).detach()
        scores = alpha * pi.logits - lowest(critics, states)
        bootstrap = expectation(policy(s_next), lowest(targets, s_next)).detach()
        target, td, gap = reward + GAMMA * ~ended * bootstrap, 0.0, 0.0
        for critic in critics:
            values = critic.module(s)
            pred = torch.stack([row[i] for row, i in zip(values, index, strict=True)])
            td = td + (pred - target) ** 2
            gap = gap + TEMPERATURE * (values / TEMPERATURE).exp().sum(-1).log() - pred
        found = {
            "loss_actor": expectation(pi, scores).mean(),
            "loss_alpha": (-log_alpha * (TARGET_ENTROPY - entropy)).mean(),
            "loss_qvalue": td.mean(),
            "loss_cql": WEIGHT * gap.mean(),
        }
        if recovery_weight:
            logits = model[0](states, s_next.expand_as(states)).detach()
            each = kl_divergence(Categorical(logits=logits), pi).mean(0)[~done].mean()
            found["loss_actor"] = found["loss_actor"] + recovery_weight * each
        return found

    return losses, {
        "loss_actor actor": actor,
        "loss_qvalue loss_cql qvalue": critics,
        "loss_alpha log_alpha": log_alpha,
    }


@pytest.mark.parametrize("number", [1, 3])
@pytest.mark.parametrize("recovery_weight", [0.75, 0.0])
def test_losses_and_gradients_equal_the_restatement(check, recovery_weight, number):
    networks, batch = Networks(number=number), make_batch("discrete", 10)
    expected = restated(networks, batch, recovery_weight)
    options = OPTIONS | {"recovery_weight": recovery_weight}
    loss = prepare(make_loss("discrete", networks, **options))
    compare(check, "Discrete OSR", loss, batch, *expected)


FORMS = {
    "int64 [B]": (Categorical, lambda one_hot: one_hot.argmax(-1)),
    "int32 [B, 1]": (Categorical, lambda one_hot: one_hot.argmax(-1, True).int()),
    "bool [B, n]": (OneHotCategorical, lambda one_hot: one_hot.bool()),
    "uint8 [B, n]": (TorchOneHotCategorical, lambda one_hot: one_hot.byte()),
    "float [B, n]": (OneHotCategorical, lambda one_hot: one_hot.float()),
}
IMPOSSIBLE = [
    (OneHotCategorical, torch.zeros(2, 5, 3)),
    (OneHotCategorical, torch.zeros(2, 5).long()),
    (Categorical, torch.zeros(2, 5, 4).bool()),
    (Categorical, torch.zeros(2, 5)),
]


@pytest.mark.parametrize("name", ["discrete", "choice-model"])
def test_actions_of_any_form_give_the_same_numbers_and_others_are_named(name) -> None:
    batch = make_batch(name, 2, 5)
    wanted = record(make_loss(name), batch)
    for head, cast in FORMS.values():
        other = batch.clone().set("action", cast(batch["action"]))
        assert_same_bits(record(make_loss(name, Networks(head=head)), other), wanted)
    for head, action in IMPOSSIBLE:
        with pytest.raises(ValueError, match=rf"'action' has .* {head.__name__} have"):
            make_loss(name, Networks(head=head))(batch.clone().set("action", action))


def test_an_action_that_is_never_taken_leaves_all_finite() -> None:
    networks = Networks()
    for network in (networks.chooser, networks.choice_model):
        network[0].module[-1].bias.data[2] = -math.inf
    for value in record(make_loss("discrete", networks), make_batch("discrete", 10)):
        assert value.isfinite().all()
