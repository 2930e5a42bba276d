"""What a configuration says of networks and loss is what is trained."""

from __future__ import annotations

import pytest
import torch
from composed import CONF, composed
from hydra.utils import get_class
from torchrl.modules import TanhDelta, TanhNormal
from torchrl.objectives import SoftUpdate

from torchrl_osr.lab.losses import TD3BCLoss
from torchrl_osr.lab.run.build import make_learner

LOSSES = sorted(path.stem for path in (CONF / "loss").glob("*.yaml"))


def learner_of(*overrides: str):
    """The networks and loss of a composed configuration, for make_batch's sizes."""
    cfg = composed("train", "network.num_cells=[8]", "optim.gamma=0.5", *overrides)
    return cfg, make_learner(cfg, 3, 2)


@pytest.mark.parametrize("name", LOSSES)
def test_every_loss_is_built_and_trains_its_networks(name, make_batch) -> None:
    cfg, (actor, _, loss, _) = learner_of(f"loss={name}")
    assert type(loss) is get_class(cfg.loss._target_)
    if hasattr(loss, "qvalue_network"):
        ten = name == "rorl" or name.endswith("_10")
        assert loss.num_qvalue_nets == (4 if name == "scas" else 10 if ten else 2)
        assert loss.value_estimator.gamma == 0.5
        SoftUpdate(loss, tau=0.1)
    batch = make_batch(10).apply(lambda x: x.float() if x.is_floating_point() else x)
    batch["next", "action"] = batch["action"].flip(0)
    if name.startswith("discrete"):
        batch["action"] = torch.eye(2)[torch.arange(10) % 2]
    losses = [value for key, value in loss(batch).items() if key.startswith("loss_")]
    sum(losses).backward()
    # The actor is the loss's own: what is evaluated is what was trained.
    for parameter in actor.parameters():
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().max() > 0


def test_actor_is_of_the_kind_that_the_loss_trains() -> None:
    kinds = {}
    for name in ("osr", "td3_bc"):
        _, (actor, _, loss, _) = learner_of(f"loss={name}")
        kinds[name] = actor[-1].distribution_class
    assert kinds == {"osr": TanhNormal, "td3_bc": TanhDelta}
    assert type(loss) is TD3BCLoss


def test_a_loss_is_given_a_model_where_it_uses_one() -> None:
    for name, used in {"osr": True, "cql": False, "edac_10": False}.items():
        _, (_, model, loss, _) = learner_of(f"loss={name}")
        assert (model is not None) == used
        assert ("inverse_dynamics_network" in loss.__dict__) == used
        held = {each.data_ptr() for each in loss.state_dict().values()}
        assert not used or {each.data_ptr() for each in model.parameters()} <= held


@pytest.mark.parametrize(
    ("name", "recovery"),
    [("bc", "osr"), ("iql", "osr"), ("rebrac", "noisy_bc"), ("sac_10", "noisy_bc")],
)
def test_recovery_is_added_to_a_loss_without_it(name, recovery, make_batch) -> None:
    _, added = learner_of(f"loss={name}", f"recovery={recovery}")
    assert (added.model is not None) == (recovery == "osr")
    if hasattr(added.loss, "qvalue_network"):
        SoftUpdate(added.loss, tau=0.1)
    batch = make_batch(10).apply(lambda x: x.float() if x.is_floating_point() else x)
    batch["next", "action"] = batch["action"].flip(0)
    out = added.objective(batch)
    assert set(out.keys()) > set(added.loss.out_keys)
    grads = []
    for key in ("loss_actor", "loss_recovery"):
        out[key].backward(retain_graph=True)
        grads.append([each.grad.clone() for each in added.actor.parameters()])
    assert not all(torch.equal(a, b) for a, b in zip(*grads, strict=True))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["loss=osr"], r"OSRLoss has a recovery term of its own .*recovery_weight=0.5"),
        (["loss=discrete_cql"], "for real actions.*take loss=discrete_osr"),
    ],
)
def test_recovery_that_cannot_be_added_is_refused(overrides, message) -> None:
    with pytest.raises(ValueError, match=message):
        learner_of(*overrides, "recovery=osr")


def test_a_model_with_a_latent_is_built() -> None:
    _, learner = learner_of("inverse_dynamics=cvae", "loss=osr_official")
    assert "latent_loc" in learner.model.out_keys
    assert learner.loss.inverse_dynamics_network.out_keys == learner.model.out_keys
