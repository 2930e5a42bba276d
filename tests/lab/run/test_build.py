"""What a configuration says of networks and loss is what is trained."""

from __future__ import annotations

import itertools

import gymnasium
import numpy as np
import pytest
import torch
from composed import composed, configured, options
from gymnasium.spaces import Box
from hydra.utils import get_class
from objectives.losses import make_batch
from torchrl.objectives import SoftUpdate

from torchrl_osr.lab.run.build import make_learner, try_out
from torchrl_osr.lab.run.config import checked


def learner_of(*overrides: str):
    """The networks and loss of a composed configuration, for make_batch's sizes."""
    given = "network.num_cells=[8]", "optim.gamma=0.5", "env.observation_size=3"
    config = checked(composed("train", *given, "env.action_size=2", *overrides))
    if not any("discrete" in each for each in overrides):
        config.env.action_low, config.env.action_high = [-1.0, -1.0], [1.0, 1.0]
    return config, make_learner(config)


@pytest.fixture
def batch():
    batch = make_batch("osr", 10)
    return batch.apply(lambda x: x.float() if x.is_floating_point() else x)


@pytest.mark.parametrize("name", options("loss"))
def test_every_loss_is_built_and_trains_its_networks(name, batch) -> None:
    config, learner = learner_of(f"loss={name}")
    actor, model, loss, _ = learner
    assert type(loss) is get_class(config.loss["_target_"])
    if hasattr(loss, "qvalue_network"):
        ten = name == "rorl" or name.endswith("_10")
        assert loss.num_qvalue_nets == (10 if ten else 2)
        assert loss.value_estimator.gamma == 0.5
        SoftUpdate(loss, tau=0.1)
    assert model is None or "osr" in name
    if name == "osr":
        held = {each.data_ptr() for each in loss.state_dict().values()}
        assert {each.data_ptr() for each in model.parameters()} <= held
    if name.startswith("discrete"):
        batch["action"] = torch.eye(2)[torch.arange(10) % 2]
    losses = [value for key, value in loss(batch).items() if key.startswith("loss_")]
    sum(losses).backward()
    # The actor is the loss's own: what is evaluated is what was trained.
    for parameter in actor.parameters():
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().max() > 0


@pytest.mark.parametrize(
    ("name", "recovery"),
    [("bc", "osr"), ("iql", "osr"), ("rebrac", "noisy_bc"), ("osr_v", "noisy_bc")],
)
def test_recovery_is_added_to_a_loss_without_it(name, recovery, batch) -> None:
    _, added = learner_of(f"loss={name}", f"recovery={recovery}")
    assert (added.model is not None) == (recovery == "osr" or name == "osr_v")
    if hasattr(added.loss, "qvalue_network"):
        SoftUpdate(added.loss, tau=0.1)
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
        (["recovery=osr"], "a recovery term of its own"),
        (["loss=rebrac", "dynamics=ensemble"], "choose dynamics=none"),
        (["loss=sdc", "dynamics=none"], "choose dynamics=ensemble"),
        (["loss=rambo", "dynamics.real_ratio=1.0"], "set it to 0"),
        (["loss=mopo", "dynamics.real_ratio=0.001"], "real_ratio=0.001: 0 of"),
        (["loss=rim", "optim.gamma=1"], "needs optim.gamma below 1"),
        (["loss=rim", "dynamics.num_elites=1"], "needs num_elites above 1"),
        (["loss=td3_bc", "trainer.steps=1"], "policy_delay is above trainer.steps"),
        (["loss=rim", "dynamics.unknown=halts"], "dynamics.unknown must be one of"),
        (["loss=mopo", "dynamics.num_elites=9"], "num_elites=9 must be between 1"),
        (["env.id=CartPole-v1"], "discrete actions.*loss=discrete_osr"),
        (["env.id=Pendulum-v1", "loss=discrete_osr"], "continuous actions.*loss=osr"),
        (["env.id=Pendulum-v1", "env.action_low=[-1.0]"], "but Pendulum-v1 has"),
    ],
)
def test_options_that_do_not_fit_each_other_are_refused(overrides, message) -> None:
    with pytest.raises(ValueError, match=message):
        make_learner(configured(*overrides))


def rows(nan_at: int, size: int = 5):
    """Return a step of an environment: its rows have ``size`` parts."""
    count = itertools.count(1)

    def step(action):
        state = np.full(2, np.nan if next(count) == nan_at else 0, np.float32)
        return (state, 0.0, False, False, {})[:size]

    return step


@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize(
    ("entries", "step", "what"),
    [
        *((3, rows(0), "step 1 .* of shape"), (2, {}.pop, "step 1 .*KeyError")),
        *((2, rows(0, size=4), "step 1 .*`info`"), (2, rows(nan_at=7), "step 7 .*nan")),
    ],
)
def test_a_broken_environment_is_found_by_some_steps(entries, step, what):
    class Broken(gymnasium.Env):
        observation_space, action_space = Box(-1, 1, (2,)), Box(-1, 1, (1,))

        def reset(self, *, seed=None, options=None):
            self.step = step
            return np.zeros(entries, np.float32), {}

    gymnasium.register("Broken-v0", Broken, max_episode_steps=9)
    with pytest.raises(RuntimeError, match=f"^Broken-v0 cannot be played: .*{what}"):
        try_out("Broken-v0")
    del gymnasium.registry["Broken-v0"]
