"""Settings that the authors of a method have told, for each of their data sets."""

from __future__ import annotations

import pytest
from composed import composed

from torchrl_osr.lab.losses import ReBRACLoss, RORLLoss
from torchrl_osr.lab.run.published import published_settings

LOSSES = {"rebrac": ReBRACLoss, "rorl": RORLLoss}
ENVS = {"hopper", "walker2d", "halfcheetah"}
DATA = {"random", "medium", "medium-replay", "medium-expert", "expert"}


def test_there_is_one_for_each_method_robot_and_quality() -> None:
    names = {f"{env}-{data}" for env in ENVS for data in DATA}
    found = {loss: {*table} for loss, table in published_settings().items()}
    assert found == dict.fromkeys(LOSSES, names)


@pytest.mark.parametrize("loss", LOSSES)
def test_they_are_options_of_the_loss_within_their_ranges(loss, make_networks) -> None:
    networks = make_networks()
    for options in published_settings()[loss].values():
        assert options
        LOSSES[loss](networks.actor, networks.critics, **options)


# (beta_1, beta_2) of ReBRAC's table 8, and RORL's epsilon and first lambda.
@pytest.mark.parametrize(
    ("overrides", "wanted"),
    [
        (["loss=rebrac"], {"actor_bc_coef": 0.05, "critic_bc_coef": 0.5}),
        (
            ["loss=rebrac", "env=walker2d", "data=expert"],
            {"actor_bc_coef": 0.01, "critic_bc_coef": 0.5},
        ),
        (
            ["loss=rebrac", "data=minari"],
            {"actor_bc_coef": 0.01, "critic_bc_coef": 0.01},
        ),
        (
            ["loss=rebrac", "loss.actor_bc_coef=7.0", "preset=paper"],
            {"actor_bc_coef": 7.0, "critic_bc_coef": 0.5},
        ),
        (
            ["loss=rorl", "env=walker2d", "data=random"],
            {"policy_smooth_eps": 0.005, "q_ood_uncertainty_reg": 5.0},
        ),
        (
            ["loss=rorl", "env=walker2d", "data=medium"],
            {"q_ood_uncertainty_reg": 1.0, "q_ood_uncertainty_decay": 5e-7},
        ),
        (
            ["loss=rorl", "env=halfcheetah", "data=medium"],
            {"num_samples": 10, "q_ood_reg": 0.0},
        ),
    ],
)
def test_they_are_taken_by_robot_and_data(overrides, wanted) -> None:
    loss = composed("train", *overrides).loss
    assert {key: loss[key] for key in wanted} == wanted
