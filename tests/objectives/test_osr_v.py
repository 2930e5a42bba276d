"""OSRVLoss against a plain restatement of its equations."""

from __future__ import annotations

import copy

import pytest
import torch
from objectives.losses import Networks, density, make_batch, make_loss
from objectives.plain import BOX, SOFT, Plain, compare, following, prepare
from torch import Tensor

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
                    sampled = [plain.act(plain.policy(state), draws["pi"][i][k])]
                    if values != "mean":
                        low = plain.center - plain.half
                        uniform = low + 2 * plain.half * draws["uniform"][i][k]
                        box = -torch.log(2 * plain.half).sum()
                        sampled.append((uniform, box))
                    if values == "cql":
                        pi = plain.policy(s_next)
                        sampled.append(plain.act(pi, draws["next"][i][k]))
                    other = batch["action"]
                    if target != "data":
                        gaussian = density(model, state, s_next)
                        other, _ = plain.act(gaussian, draws["model"][k, i])
                    if values == "cql":
                        counts = valid.unsqueeze(-1) & (i == 1)
                        other = torch.where(counts, other, batch["action"])
                wanted = wanted + plain.values(state, other, [critic])[0] / number
                for action, log_prob in sampled:
                    value = plain.values(state, action, [critic])[0]
                    mean = mean + value / number
                    # Importance weights 1 / p, whatever the temperature.
                    logits.append(value / TEMPERATURE - log_prob)
            if values != "mean":
                mean = TEMPERATURE * sum(logit.exp() for logit in logits).log()
            total = total + (mean - wanted) / 2
        return total

    def losses() -> dict[str, Tensor]:
        # The draws, in the order in which the loss makes them.
        shape, like = (number, 2, *batch["action"].shape), {"dtype": torch.float64}
        found = plain.policy_losses(states)
        draws = {name: [] for name in ("uniform", "pi", "next")}
        if values == "cql":
            for first, second in (("pi", "next"), ("next", "pi")):
                draws["uniform"].append(torch.rand(number, *shape[2:], **like))
                pair = torch.randn(shape, **like).unbind(1)
                draws[first].append(pair[0])
                draws[second].append(pair[1])
        else:
            draws["pi"] = torch.randn(shape, **like).unbind(1)
        if target != "data":
            one = (1, 1) if values == "cql" else shape[:2]
            draws["model"] = torch.randn(*one, *shape[2:], **like).expand(shape)
        value = plain.soft_value(batch, entropy=False)
        gaps = [gap(critic, draws) for critic in plain.critics]
        if values != "cql":
            gaps = [each[valid] for each in gaps]
        gaps = sum(each.mean() for each in gaps)
        return found | {"loss_qvalue": plain.td_loss(batch, value) + WEIGHT * gaps}

    return losses, plain.networks


@pytest.mark.parametrize("target", ["inverse_dynamics", "data"])
@pytest.mark.parametrize("values", ["mean", "cql"])
@pytest.mark.parametrize("number", [1, 3])
def test_losses_and_gradients_equal_the_restatement(check, values, target, number):
    networks, batch = Networks(**BOX), make_batch("osr-v", 10)
    options = {"policy_values": values, "recovery_target": target, "num_random": number}
    expected = restated(networks, batch, number, values, target)
    options |= SOFT | {"recovery_weight": WEIGHT, "temperature": TEMPERATURE}
    loss = prepare(make_loss("osr-v", networks, **options))
    compare(check, "OSR-v", loss, batch, *expected)
