"""The models of the dynamics and their losses, each against its equation."""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, make_batch
from tensordict import TensorDict
from torch import nn
from uneven_dynamics import compare_models, linear_dynamics, plain_gaussian

from torchrl_osr.lab.data.transitions import has_next_state
from torchrl_osr.lab.dynamics import DynamicsEnsemble, DynamicsLoss, TransitionVAELoss


def rows_of(state, action, change, reward) -> TensorDict:
    no = torch.zeros(len(state), 1, dtype=torch.bool)
    after = {"observation": state + change, "reward": reward, "terminated": no}
    batch = {"observation": state, "action": action, "next": after}
    return TensorDict(batch, [len(state)])


def test_elites_are_the_best_on_held_out_rows() -> None:
    model = linear_dynamics((1, 1), {}, (4, 2))
    # Predicted change; the truth is 1 and the reward 0.
    model.layers[0].bias[:, 0, 0] = torch.tensor([5.0, 1.1, -3.0, 0.8])
    ones, zeros = torch.ones(3, 1), torch.zeros(3, 1)
    model.calibrate_(rows_of(zeros, zeros, ones, zeros))
    assert model.elites.tolist() == [1, 3]
    # Their mean is .95, and both are .15 from it.
    apart = model.disagreement(model.predict(zeros, zeros)[0])
    assert apart.max().item() == pytest.approx(0.15)


def test_rows_without_a_next_state_and_constant_entries() -> None:
    state = torch.randn(50, 2)
    state[:, 1] = 3.0
    data = rows_of(state, state[:, :1], torch.zeros(50, 2), torch.ones(50, 1))
    data["next", "terminated"][:2] = True
    data["next", "observation"][1] += 1.0
    assert has_next_state(data)[:3].tolist() == [False, True, True]
    model = DynamicsEnsemble(2, 1, num_networks=1, num_elites=1)
    model.standardize_(data[2:])
    assert model.input_scale[1] == 1
    assert model.target_scale.tolist() == [1, 1, 1]
    assert model.target_loc.tolist() == [0, 0, 1]


def make_model(num_cells=(6, 5)) -> DynamicsEnsemble:
    torch.manual_seed(0)
    model = DynamicsEnsemble(3, 2, num_networks=2, num_elites=1, num_cells=num_cells)
    for each in model.parameters():
        nn.init.normal_(each, std=0.5)
    return model.double()


def plain_loss(model: DynamicsEnsemble, batch) -> torch.Tensor:
    """Gaussian by Gaussian: (y - m)^2 / v + log v, each network on its own rows."""
    low, high = model.lowest_log_variance, model.highest_log_variance
    half = len(batch) // 2
    total = 0.01 * (high.sum() - low.sum())
    for number in range(2):
        rows = batch[number * half : (number + 1) * half]
        counted, value = 0, 0.0
        for row in rows:
            after = row["next"]
            change = after["observation"] - row["observation"]
            if after["terminated"] and not change.any():
                continue
            inputs = row["observation"], row["action"]
            mean, variance = plain_gaussian(model, number, *inputs)
            truth = torch.cat([change, after["reward"]])
            truth = (truth - model.target_loc) / model.target_scale
            value += ((truth - mean) ** 2 / variance + torch.log(variance)).mean()
            counted += 1
        total = total + value / counted
    return total


@pytest.mark.parametrize("num_cells", [(), (6, 5)])
def test_loss_equals_the_plain_likelihood(check, num_cells) -> None:
    batch = make_batch("osr", 10)
    ended = batch["next", "terminated"].squeeze(-1)  # a row of each network
    batch["next", "observation"][ended] = batch["observation"][ended]
    model, plain = make_model(num_cells), make_model(num_cells)
    for each in (model, plain):
        each.standardize_(batch)
    loss = DynamicsLoss(model)
    value = sum(loss(batch).values())
    wanted = plain_loss(plain, batch)
    compare_models(check, "Dynamics ensemble", (value, model), (wanted, plain))


def test_weights_alone_decay_and_by_their_layer() -> None:
    model, decays = make_model(), {}
    for group in model.parameter_groups():
        for each in group["params"]:
            decays[each] = group.get("weight_decay", 0.0)
    assert decays.keys() == set(model.parameters())
    first, second, last = (layer.weight for layer in model.layers)
    wanted = {first: 2.5e-5, second: 5e-5, last: 1e-4}
    assert {each: decay for each, decay in decays.items() if decay} == wanted


def test_loss_of_the_autoencoder_equals_the_plain_objective(transitions, check) -> None:
    batch = transitions(10, dtype=torch.float64)
    batch["next", "observation"][1] = batch["observation"][1]  # terminated: no next
    model, plain = Networks().vae, Networks().vae
    model.standardize_(batch)
    loss = TransitionVAELoss(model)
    torch.manual_seed(3)
    value = loss(batch)["loss_vae"]
    torch.manual_seed(3)
    noise = torch.randn(10, 6, dtype=torch.float64)
    total, kept = 0.0, [row for row in range(10) if row != 1]
    change = (batch["next", "observation"] - batch["observation"])[kept]
    targets = (change - change.mean(0)) / change.std(0, correction=0)
    for row, target in zip(kept, targets, strict=True):
        state = batch["observation"][row]
        first, last = plain.encoder[0], plain.encoder[2]
        hidden = (first.weight @ torch.cat([state, target]) + first.bias).relu()
        mean, log_scale = (last.weight @ hidden + last.bias).split(6)
        latent = mean + log_scale.exp() * noise[row]
        first, last = plain.decoder[0], plain.decoder[2]
        hidden = (first.weight @ torch.cat([state, latent]) + first.bias).relu()
        out = last.weight @ hidden + last.bias
        variance = (2 * log_scale).exp()
        divergence = (variance + mean**2 - 1 - 2 * log_scale).sum() / 2
        total = total + ((out - target) ** 2).mean() + 0.5 * divergence / 6
    wanted = total / len(kept)
    compare_models(check, "Transition VAE", (value, model), (wanted, plain))


@pytest.mark.parametrize("name", ["dynamics", "vae"])
def test_models_learn_single_steps_and_divide_the_batch(name) -> None:
    single = make_batch("osr", 10)
    several = single.clone().set("next", single["next"].roll(1, 0))
    several["steps_to_next_obs"] = torch.full((10, 1), 5)
    kinds = {"dynamics": DynamicsLoss, "vae": TransitionVAELoss}
    loss = kinds[name](getattr(Networks(), name))
    with pytest.raises(ValueError, match="5 steps.* reads the state one step ahead"):
        loss(several)
    found = []
    for batch in (single, several.set("one_step", single["next"])):
        torch.manual_seed(0)
        found.append(sum(loss(batch).values()))
    assert torch.equal(*found)
    if name == "dynamics":
        with pytest.raises(ValueError, match="9 rows cannot be divided among 2"):
            loss(make_batch("osr", 9))
