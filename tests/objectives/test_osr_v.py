"""OSRVLoss against a plain restatement of its equations."""

from __future__ import annotations

import copy

import pytest
import torch
from objectives.losses import Networks, density, make_batch, update_targets
from objectives.plain import BOX, SOFT, Plain, compare, following, prepare
from torch import Tensor

from torchrl_osr import OSRVLoss

WEIGHT, TEMPERATURE = 2.5, 1.7


def restated(networks: Networks, batch, number: int, values: str, target: str):
    """Return the losses as a function, and the networks that they train."""
    plain, model = Plain(networks), copy.deepcopy(networks.model)
    states = torch.stack([batch["observation"], batch["perturbed", "observation"]])
    s_next = following(batch)
    valid = ~batch["next", "done"].squeeze(-1)

    def gap(critic, draws) -> Tensor:
        """Equation (8) for a critic: the mean over both sets of states, ``[R]``."""
        total = 0.0
        for i, state in enumerate(states):
            logits, mean, wanted = [], 0.0, 0.0
            for k in range(number):
                with torch.no_grad():
                    action, log_prob = plain.act(plain.policy(state), draws["pi"][k, i])
                    other = batch["action"]
                    if target != "data":
                        gaussian = density(model, state, s_next)
                        other, _ = plain.act(gaussian, draws["model"][k, i])
                value = plain.values(state, action, [critic])[0]
                mean = mean + value / number
                wanted = wanted + plain.values(state, other, [critic])[0] / number
                if values == "logsumexp":
                    # Importance weights 1 / p, whatever the temperature.
                    logits.append(value / TEMPERATURE - log_prob)
                    low = plain.center - plain.half
                    uniform = low + 2 * plain.half * draws["uniform"][k, i]
                    value = plain.values(state, uniform, [critic])[0]
                    box = -torch.log(2 * plain.half).sum()
                    logits.append(value / TEMPERATURE - box)
            if logits:
                mean = TEMPERATURE * sum(logit.exp() for logit in logits).log()
            total = total + (mean - wanted) / 2
        return total

    def losses() -> dict[str, Tensor]:
        # The draws, in the order in which the loss makes them.
        shape, like = (number, 2, *batch["action"].shape), {"dtype": torch.float64}
        found = plain.policy_losses(states)
        draws = {"pi": torch.randn(shape, **like)}
        if target != "data":
            draws["model"] = torch.randn(shape, **like)
        if values == "logsumexp":
            draws["uniform"] = torch.rand(shape, **like)
        value = plain.soft_value(batch, entropy=False)
        gaps = sum(gap(critic, draws)[valid].mean() for critic in plain.critics)
        return found | {"loss_qvalue": plain.td_loss(batch, value) + WEIGHT * gaps}

    return losses, plain.networks


@pytest.mark.parametrize("target", ["inverse_dynamics", "data"])
@pytest.mark.parametrize("values", ["mean", "logsumexp"])
@pytest.mark.parametrize("number", [1, 3])
def test_losses_and_gradients_equal_the_restatement(
    check, values, target, number
) -> None:
    networks, batch = Networks(**BOX), make_batch("osr-v", 10)
    options = {"policy_values": values, "recovery_target": target, "num_random": number}
    expected = restated(networks, batch, number, values, target)
    options |= SOFT | {"recovery_weight": WEIGHT, "temperature": TEMPERATURE}
    loss = OSRVLoss(networks.actor, networks.critics, networks.model, **options)
    loss = update_targets(loss.double())
    label = "OSR-v" + " on the data's actions" * (target == "data")
    compare(check, label, prepare(loss), batch, *expected)
