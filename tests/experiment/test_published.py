"""Settings that the authors of a method have told, for each of their data sets."""

from __future__ import annotations

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from torchrl_osr import ReBRACLoss, RORLLoss
from torchrl_osr.experiment import schema

CONF = Path(__file__).parents[2] / "conf"
FILES = sorted((CONF / "published").rglob("*.yaml"))
LOSSES = {"rebrac": ReBRACLoss, "rorl": RORLLoss}
ENVS = {"hopper", "walker2d", "halfcheetah"}
DATA = {"random", "medium", "medium-replay", "medium-expert", "expert"}


def loss_of(*overrides: str):
    schema.register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("train", overrides=list(overrides)).loss


def test_there_is_one_for_each_method_robot_and_quality() -> None:
    found = {path.relative_to(CONF / "published").as_posix() for path in FILES}
    assert found == {
        f"{loss}/{env}-{data}.yaml" for loss in LOSSES for env in ENVS for data in DATA
    }


@pytest.mark.parametrize(
    "path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}"
)
def test_they_are_options_of_the_loss_within_their_ranges(path, make_networks) -> None:
    options = OmegaConf.to_container(OmegaConf.load(path))
    networks = make_networks()
    LOSSES[path.parent.name](networks.actor, networks.critics, **options)
    assert options


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
            ["loss=rorl", "env=halfcheetah", "data=medium"],
            {"num_samples": 10, "q_ood_reg": 0.0},
        ),
    ],
)
def test_they_are_taken_by_robot_and_data(overrides, wanted) -> None:
    loss = loss_of(*overrides)
    assert {key: loss[key] for key in wanted} == wanted
