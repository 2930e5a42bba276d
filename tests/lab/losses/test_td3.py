"""Target policy smoothing and bounds, which the losses with TD3's target share."""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, call, make_batch, make_loss, update_targets

from torchrl_osr.lab.losses import TD3BCLoss


def test_smoothed_actions_stay_within_the_bounds_of_each_dimension() -> None:
    networks, batch = Networks(low=-2.0, high=2.0), make_batch("td3-bc", 200)
    options = {"low": [-2.0, -0.5], "high": [2.0, 0.25], "policy_noise": 2.0}
    loss = TD3BCLoss(networks.module, networks.critics, noise_clip=9.0, **options)
    update_targets(loss.double())
    action, _ = loss.smoothed(loss.unpack(batch))
    assert action.amax(0).tolist() == [2.0, 0.25]
    assert action.amin(0).tolist() == [-2.0, -0.5]
    # Without noise the target's action is the actor's own, however far it goes.
    loss.policy_noise = 0.0
    action, _ = loss.smoothed(loss.unpack(batch))
    wanted = networks.module.module(loss.unpack(batch).s_next["observation"])
    torch.testing.assert_close(action[:, 0], wanted[:, 0])


def test_bounds_are_those_of_a_delta_actor() -> None:
    networks = Networks(high=torch.tensor([1.0, 3.0]))
    assert TD3BCLoss(networks.delta, networks.critics).action_high.tolist() == [1, 3]
    with pytest.raises(ValueError, match=r"high=1.0, but its actor high=\[1.0, 3.0\]"):
        TD3BCLoss(networks.delta, networks.critics, high=1.0)


def test_magnitude_of_no_values_is_one() -> None:
    loss, batch = make_loss("td3-bc"), make_batch("td3-bc", 4)
    assert loss.magnitude(loss.unpack(batch), torch.zeros(4)) == 1
    batch["collector", "mask"] = torch.tensor([True, False, False, True])
    values = torch.tensor([1.0, 9.0, 9.0, -3.0])
    assert loss.magnitude(loss.unpack(batch), values) == 2
    assert call(loss, batch)["loss_actor"].isfinite()
