"""ConditionalVAELoss against BCQ's objective written out, and what the model draws."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_osr.lab.dynamics import ConditionalVAE, ConditionalVAELoss

KINDS = {
    "action": (2, {"condition_key": ("next", "observation"), "target_key": "action"}),
    "change": (
        3,
        {
            "condition_key": "observation",
            "target_key": ("next", "observation"),
            "change": True,
        },
    ),
}


def make_model(kind: str, **options) -> ConditionalVAE:
    torch.manual_seed(0)
    size, keys = KINDS[kind]
    model = ConditionalVAE(3, size, num_cells=[6], latent_dim=2, **keys, **options)
    for each in model.parameters():
        nn.init.normal_(each, std=0.5)
    return model.double()


@pytest.mark.parametrize("kind", KINDS)
def test_loss_and_gradients_equal_the_plain_objective(make_batch, check, kind) -> None:
    batch = make_batch(10, twin=False)
    batch["next", "observation"][1] = batch["observation"][1]  # terminated: no next
    model, plain = make_model(kind), make_model(kind)
    if kind == "change":
        for each in (model, plain):
            each.standardize_(batch)
    loss = ConditionalVAELoss(model, latent_weight=0.3)
    torch.manual_seed(3)
    value = loss(batch)["loss_vae"]
    torch.manual_seed(3)
    noise = torch.randn(10, 2, dtype=torch.float64)
    total, kept = 0.0, [row for row in range(10) if row != 1]
    change = (batch["next", "observation"] - batch["observation"])[kept]
    for row in kept:
        state, after = batch["observation"][row], batch["next", "observation"][row]
        condition, target = after, batch["action"][row]
        if kind == "change":
            spread = change.std(0, correction=0)
            condition, target = state, (after - state - change.mean(0)) / spread
        first, last = plain.encoder[0], plain.encoder[2]
        hidden = (first.weight @ torch.cat([condition, target]) + first.bias).relu()
        mean, log_scale = (last.weight @ hidden + last.bias).split(2)
        latent = mean + log_scale.exp() * noise[row]
        first, last = plain.decoder[0], plain.decoder[2]
        hidden = (first.weight @ torch.cat([condition, latent]) + first.bias).relu()
        out = last.weight @ hidden + last.bias
        out = out if kind == "change" else torch.tanh(out)
        variance = (2 * log_scale).exp()
        divergence = (variance + mean**2 - 1 - 2 * log_scale).sum() / 2
        total = total + ((out - target) ** 2).mean() + 0.3 * divergence / 2
    wanted = total / len(kept)
    check(
        "Conditional VAE",
        [value.detach(), *torch.autograd.grad(value, list(model.parameters()))],
        [wanted.detach(), *torch.autograd.grad(wanted, list(plain.parameters()))],
        tolerance=1e-10,
    )


def test_it_learns_which_actions_lead_to_a_state() -> None:
    """Of two actions that lead to a state, both are drawn, and nothing in between."""
    torch.manual_seed(0)
    model = ConditionalVAE(1, 1, num_cells=[32], **KINDS["action"][1])
    state = torch.rand(256, 1) * 2 - 1
    sign = torch.randint(2, (256, 1)) * 2.0 - 1
    batch = TensorDict(
        {
            "observation": state,
            "action": sign * (0.5 + 0.3 * state),
            "next": {
                "observation": state,
                "terminated": torch.zeros(256, 1, dtype=torch.bool),
            },
        },
        [256],
    )
    loss = ConditionalVAELoss(model, latent_weight=0.05)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    for _ in range(400):
        optimizer.zero_grad()
        loss(batch)["loss_vae"].backward()
        optimizer.step()
    drawn = model(batch.clone())["action"]
    assert 0.3 < (drawn > 0).float().mean() < 0.7
    close = (drawn.abs() - (0.5 + 0.3 * state)).abs() < 0.15
    assert close.float().mean() > 0.8


def test_the_network_names_what_is_read_and_of_single_steps(make_batch) -> None:
    batch = make_batch(10, twin=False)
    nested = batch.exclude("observation", "action", ("next", "observation"))
    nested["agent", "obs"], nested["agent", "action"] = (
        batch["observation"], batch["action"],
    )  # fmt: skip
    nested["next", "agent", "obs"] = batch["next", "observation"]
    keys = {
        "condition_key": ("next", "agent", "obs"),
        "target_key": ("agent", "action"),
    }
    losses = []
    for given, rows in (({}, batch), (keys, nested)):
        torch.manual_seed(0)
        defaults = {"condition_key": ("next", "observation"), "target_key": "action"}
        model = ConditionalVAE(3, 2, num_cells=[6], **(defaults | given)).double()
        loss = ConditionalVAELoss(model)
        losses.append(loss(rows.select(*loss.in_keys))["loss_vae"])
    assert losses[0] == losses[1]
    nested["steps_to_next_obs"] = torch.full((10, 1), 5)
    with pytest.raises(ValueError, match="up to 5.*the autoencoder reads"):
        loss(nested)


def test_a_change_needs_a_condition_of_its_size() -> None:
    with pytest.raises(ValueError, match="condition of the target's size, 3, got 2"):
        ConditionalVAE(2, 3, **KINDS["change"][1])


def test_latents_are_drawn_within_the_bound() -> None:
    model = make_model("action", latent_bound=0.0)
    drawn = model.sample(torch.ones(5, 3, dtype=torch.float64))
    assert (drawn == drawn[0]).all()
