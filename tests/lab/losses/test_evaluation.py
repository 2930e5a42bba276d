"""Fitted Q evaluation: the published formula, restated in float64."""

from __future__ import annotations

import torch
from objectives.losses import make_batch, make_loss, make_networks
from torch import nn

GAMMA, BOUND = 0.9, 0.3


def test_each_critic_has_its_own_target_of_the_given_action():
    batch = make_batch("fqe", 10)
    batch["bootstrap"] = torch.rand(10, 2, dtype=torch.float64)
    loss = make_loss("fqe", networks := make_networks("fqe"), value_bounds=(-1, BOUND))
    loss.make_value_estimator(gamma=GAMMA)
    after, total = batch["next"], 0.0
    for number, critic in enumerate(networks.critics):
        network: nn.Module = critic.module
        with torch.no_grad():
            following = network(after["observation"], after["action"])
        goes_on = ~after["terminated"]
        target = (after["reward"] + GAMMA * goes_on * following).clamp(-1, BOUND)
        error = network(batch["observation"], batch["action"]) - target
        weighted = batch["bootstrap"][:, number, None] * error.square()
        total = total + weighted.mean()
    found = loss(batch)["loss_qvalue"]
    torch.testing.assert_close(found, total)
    found.backward()
    assert all(each.grad is not None for each in loss.parameters())
