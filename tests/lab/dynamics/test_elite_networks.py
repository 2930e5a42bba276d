"""Elites by themselves predict what they did in their ensemble."""

from __future__ import annotations

import pytest
import torch

from torchrl_osr.lab.dynamics import DynamicsEnsemble, EliteNetworks

LOC, SCALE = torch.tensor([1.0, -2.0, 300.0]), torch.tensor([2.0, 0.5, 40.0])
LOW, HIGH = torch.tensor([-2.0, 0.5]), torch.tensor([4.0, 1.5])


def ensemble(*elites: int, num_cells: tuple[int, ...] = (8, 8)) -> DynamicsEnsemble:
    torch.manual_seed(0)
    model = DynamicsEnsemble(
        3, 2, num_networks=4, num_elites=len(elites), num_cells=num_cells
    )
    model.elites.copy_(torch.tensor(elites))
    for name in ("input_loc", "target_loc"):
        getattr(model, name).normal_()
    for name in ("input_scale", "target_scale"):
        getattr(model, name).uniform_(0.5, 2.0)
    return model


def test_they_predict_the_means_in_the_environments_units() -> None:
    model = ensemble(1, 3)
    networks = EliteNetworks(model, LOC, SCALE, LOW, HIGH)
    seen, unit = torch.randn(5, 3), 2 * torch.rand(5, 2) - 1
    mean = model.predict(seen, unit).mean[[1, 3]]
    wanted = torch.cat([mean[..., :3] * SCALE, mean[..., 3:]], -1)
    state, action = seen * SCALE + LOC, LOW + (unit + 1) / 2 * (HIGH - LOW)
    found = networks(state.expand(2, -1, -1), action.expand(2, -1, -1))
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)
    assert (networks.num_networks, networks.action_dim) == (2, 2)
    # In the model's own units nothing is rescaled; the model is left as it was.
    same = EliteNetworks(model)(seen.expand(2, -1, -1), unit.expand(2, -1, -1))
    torch.testing.assert_close(same, mean, rtol=1e-5, atol=1e-5)
    assert all(each.requires_grad for each in model.parameters())


def test_joined_they_are_each_as_before() -> None:
    parts = [EliteNetworks(ensemble(0)), EliteNetworks(ensemble(2, 3), LOC, SCALE)]
    joined = EliteNetworks.join(parts)
    state, action = torch.randn(3, 5, 3), torch.randn(3, 5, 2)
    wanted = [parts[0](state[:1], action[:1]), parts[1](state[1:], action[1:])]
    torch.testing.assert_close(joined(state, action), torch.cat(wanted))
    assert [each.num_networks for each in (*parts, joined)] == [1, 2, 3]
    other = EliteNetworks(ensemble(0, num_cells=(4,)))
    with pytest.raises(ValueError, match="if their layers are alike, got 2 kinds"):
        EliteNetworks.join([parts[0], other])
