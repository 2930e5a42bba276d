"""Actions and values are those of the networks, in the environment's units."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from omegaconf import OmegaConf
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import ObservationNorm
from torchrl.modules import MLP, NormalParamExtractor, ValueOperator
from untrained_run import make_run

from torchrl_osr import CQLLoss, load_policy
from torchrl_osr.lab.envs import critics_of
from torchrl_osr.lab.losses import TD3BCLoss
from torchrl_osr.lab.run.policy_of_run import load_run_policy
from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
from torchrl_osr.policy import Policy, policy_from_loss

KINDS = ("osr", "td3_bc", "discrete")
LINEAR = {"num_cells": [], "activation": "ReLU", "layer_norm": False}


def linear_policy() -> Policy:
    """One number in, one out, all weights known."""
    record = {
        "distribution": "TanhDelta",
        "observation_size": 1,
        "action_size": 1,
        "low": [-1.0],
        "high": [5.0],
        "actor": LINEAR,
        "critics": LINEAR | {"number": 2},
        "source": {},
    }
    numbers = {
        "loc": [2.0],
        "scale": [4.0],
        "actor.0.weight": [[0.5]],
        "actor.0.bias": [0.1],
        "critics.0.0.weight": [[3.0, 1.0]],
        "critics.0.0.bias": [0.0],
        "critics.1.0.weight": [[-3.0, 1.0]],
        "critics.1.0.bias": [1.0],
    }
    return Policy(record, {name: torch.tensor(each) for name, each in numbers.items()})


def test_against_hand_calculation():
    policy = linear_policy()
    # (10 - 2) / 4 = 2 is what the networks see; -1 and 5 are 2 -+ 3.
    action = 2 + 3 * math.tanh(0.5 * 2 + 0.1)
    assert policy.act(np.array([10.0])) == pytest.approx([action])
    # min(3 * 2 + a, -3 * 2 + a + 1), with a between -1 and 1.
    assert policy.value(np.array([10.0])) == pytest.approx(-5 + math.tanh(1.1))
    given = policy.value(np.array([[10.0], [-6.0]]), np.array([[5.0], [2.0]]))
    assert given == pytest.approx([-4.0, -6.0])


@pytest.mark.parametrize("loss", ["osr", "td3_bc", "iql", "rebrac recovery=osr"])
def test_a_run_acts_as_in_its_evaluation(tmp_path, loss):
    folder = tmp_path / "run"
    evaluated, networks = make_run(folder, *f"loss={loss}".split())
    policy, rows = load_run_policy(folder), 2 + 3 * torch.randn(6, 11)
    actions = evaluated(rows)
    torch.testing.assert_close(policy.act(rows), actions, atol=2e-6, rtol=0)
    states = TensorDict({"observation": (rows - 2) / 3}, [6])
    values = critics_of(networks)(states, actions).amin(0)
    torch.testing.assert_close(policy.value(rows, actions), values)
    source = policy.record["source"]
    assert source["step"] == 900
    assert source["env_id"] == "Hopper-v5"
    assert source["data"]["source"] == "medium-replay"
    best = load_run_policy(folder / "checkpoint/policy/best.torchrl")
    assert best.record["source"]["step"] == 10


def test_a_run_without_critics_acts_and_has_no_values(tmp_path):
    folder, bounds = tmp_path / "run", "[-1.0,-1.0,-1.0]"
    evaluated, _ = make_run(folder, "loss=bc", f"env.action_low={bounds}")
    policy, rows = load_run_policy(folder), 2 + 3 * torch.randn(6, 11)
    torch.testing.assert_close(policy.act(rows), evaluated(rows), atol=2e-6, rtol=0)
    with pytest.raises(ValueError, match="no critics"):
        policy.value(rows)
    with pytest.raises(ValueError, match="no critics"):
        policy.export(tmp_path / "value.pt2", "value")


def test_bounds_of_the_runs_environment(tmp_path):
    folder = tmp_path / "run"
    evaluated, _ = make_run(folder)
    config = OmegaConf.load(folder / "config.yaml")
    low, high = [-2.0, 0.0, 1.0], [2.0, 3.0, 5.0]
    config.env.update({"action_low": low, "action_high": high})
    OmegaConf.save(config, folder / "config.yaml")
    rows = torch.randn(6, 11)
    low, high = torch.tensor(low), torch.tensor(high)
    wanted = low + (evaluated(rows) + 1) / 2 * (high - low)
    torch.testing.assert_close(load_run_policy(folder).act(rows), wanted)


@pytest.mark.parametrize("kind", KINDS)
def test_what_comes_in_comes_out(make_policy, kind):
    policy = make_policy(kind)
    size = () if policy.discrete else (2,)
    rows = np.linspace(-3, 3, 12).reshape(4, 3)
    many = policy.act(rows)
    assert many.shape == (4, *size)
    assert many.dtype == (np.int64 if policy.discrete else np.float32)
    frozen = rows[::-1].astype(np.float32)
    frozen.flags.writeable = False
    assert np.array_equal(policy.act(frozen), many[::-1])
    one = policy.act(rows[1])
    assert one.shape == size
    assert one == pytest.approx(many[1], abs=1e-6)
    tensors = policy.act(torch.from_numpy(rows).reshape(2, 2, 3))
    assert isinstance(tensors, torch.Tensor)
    assert tensors.shape == (2, 2, *size)
    assert not tensors.requires_grad
    assert tensors.reshape(4, *size).numpy() == pytest.approx(many, abs=1e-6)
    assert policy.act(np.zeros((0, 3))).shape == (0, *size)
    assert policy.act(np.arange(3)).shape == size
    for action in (None, many):
        assert policy.value(rows, action).shape == (4,)
    assert policy.value(rows[1]) == pytest.approx(policy.value(rows)[1], abs=1e-5)
    module = TensorDictModule(policy, ["observation"], ["action"])
    out = module(TensorDict({"observation": torch.from_numpy(rows).float()}, [4]))
    assert np.array_equal(out["action"].numpy(), many)


@settings(max_examples=50, deadline=None)
@given(
    observation=arrays(np.float32, (4, 1), elements=st.floats(-1e6, 1e6, width=32)),
    low=st.floats(-1e6, 1e6, width=32),
    width=st.floats(1.0, 1e6, width=32),
    seed=st.none() | st.integers(0, 2**32),
)
def test_actions_are_within_their_bounds(observation, low, width, seed):
    template = linear_policy()
    record = template.record | {"low": [low], "high": [low + width]}
    policy = Policy(record, template.state_dict())
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    action = policy.act(observation, generator=generator)
    assert np.float32(low) <= action.min()
    assert action.max() <= np.float32(low + width)
    policy.value(observation, action)  # an action of its own is never refused


def test_a_transform_that_standardises_the_other_way_round_is_refused(make_loss):
    norm = ObservationNorm(loc=1.0, scale=4.0, in_keys=["observation"])
    with pytest.raises(ValueError, match="standard_normal=True"):
        policy_from_loss(make_loss("osr"), observation_norm=norm)


def test_drawn_actions_have_the_distribution_of_the_actor(make_loss, norm):
    observation, draws = torch.tensor([0.3, -2.5, 1.0]), 20_000
    state = TensorDict({"observation": (observation - norm.loc) / norm.scale})

    def drawn(kind, **bounds):
        loss = make_loss(kind)
        policy = policy_from_loss(loss, norm, **bounds)
        generator = torch.Generator().manual_seed(3)
        rows = observation.expand(draws, 3)
        action = policy.act(rows, generator=generator)
        again = policy.act(rows, generator=generator.manual_seed(3))
        assert torch.equal(action, again)
        with loss.actor_network_params.to_module(loss.actor_network):
            return action, loss.actor_network.get_dist(state)

    action, theirs = drawn("osr", low=-2.0, high=2.0)
    normal = torch.atanh((action / 2).clamp(-1 + 1e-6, 1 - 1e-6))
    error = 5 * theirs.scale / math.sqrt(draws)
    assert ((normal.mean(0) - theirs.loc).abs() < error).all()
    assert ((normal.std(0) - theirs.scale).abs() < error).all()
    action, theirs = drawn("discrete")
    shares = torch.bincount(action, minlength=2) / draws
    assert (shares - theirs.probs).abs().max() < 5 * 0.5 / math.sqrt(draws)
    action, theirs = drawn("td3_bc")
    assert action.unique(dim=0).shape == (1, 2)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (np.zeros(4), r"shape \(4,\), expected \(3,\) or \(batch, 3\)"),
        (np.zeros((5, 2)), r"shape \(5, 2\), expected \(3,\) or"),
        (np.float64(1.0), r"shape \(\), expected"),
        (np.array([0.0, np.nan, 0.0]), "NaN or infinite"),
        (torch.tensor([[0.0, 0.0, math.inf]]), "NaN or infinite"),
        (np.array([0.0, 0.0, 1e300]), "NaN or infinite"),
    ],
)
def test_observations_that_are_refused(make_policy, observation, message):
    policy = make_policy("osr")
    for method in (policy.act, policy.value):
        with pytest.raises(ValueError, match=f"^the observation has .*{message}"):
            method(observation)


@pytest.mark.parametrize(
    ("kind", "action", "message"),
    [
        ("osr", np.zeros(3), r"action has shape \(3,\), expected \(2,\) or"),
        ("osr", np.ones((1, 2)), r"\(1, 2\), expected \(4, 2\) for an observation of"),
        ("osr", np.full((4, 2), np.nan), "the action has entries that are NaN"),
        ("osr", np.full((4, 2), 1.6), r"bounds \[-2.0, 0.5\] and \[4.0, 1.5\]"),
        ("discrete", np.zeros(4), r"is torch.float64, expected integers"),
        ("discrete", np.zeros(3, np.int64), r"\(3,\), expected \(4,\)"),
        ("discrete", np.array([0, 1, 2, 0]), "out of its bounds 0 and 1"),
        ("discrete", np.array([0, 1, -1, 0]), "out of its bounds 0 and 1"),
    ],
)
def test_actions_that_are_not_valued(make_policy, kind, action, message):
    with pytest.raises(ValueError, match=message):
        make_policy(kind).value(np.zeros((4, 3)), action)


def test_networks_that_a_policy_would_not_copy_whole():
    def actor(*layers: nn.Module, mapping="biased_softplus_1.0", **bounds):
        network = nn.Sequential(*layers, MLP(3, 4), NormalParamExtractor(mapping))
        actor = tanh_gaussian_actor(3, 2, **bounds)
        actor.module[0].module = network
        return actor

    critics = critic_ensemble(3, 2)
    policy_from_loss(CQLLoss(actor(), critics))
    swapped = ValueOperator(MLP(5, 1), in_keys=["action", "observation"])
    for networks, message in [
        ((actor(nn.LayerNorm(3)), critics), "compute something else"),
        ((actor(mapping="exp"), critics), "compute something else"),
        ((actor(low=-2.0, high=2.0), critics), "compute something else"),
        ((actor(), swapped), "compute something else"),
        ((actor(MLP(3, 3)), critics), "one torchrl.modules.MLP.* has 2"),
    ]:
        loss = CQLLoss(*networks)
        with pytest.raises(ValueError, match=message):
            policy_from_loss(loss)
    plain = TensorDictModule(MLP(3, 2), ["observation"], ["action"])
    with pytest.raises(ValueError, match="this one has no distribution"):
        policy_from_loss(TD3BCLoss(plain, critics))


BLOCKED = """
import sys
simulators = ["gymnasium", "mujoco"]
train = ["hydra", "omegaconf", "yaml", "filelock", "tqdm", "matplotlib", "pandas"]
for name in simulators + train:
    sys.modules[name] = None
import numpy, torchrl_osr
print(torchrl_osr.load_policy("policy.safetensors").act(numpy.zeros(3)).shape)
for name in train:
    del sys.modules[name]
from torchrl_osr.lab.run.policy_of_run import load_run_policy
print(load_run_policy("run").act(numpy.zeros(11)).shape)
"""


def test_a_file_needs_no_hydra_and_a_run_no_environment(tmp_path, make_policy):
    make_run(tmp_path / "run")
    make_policy("osr").save(tmp_path / "policy.safetensors")
    command = [sys.executable, "-c", BLOCKED]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    done = subprocess.run(command, cwd=tmp_path, check=False, **streams)
    assert done.stdout == "(2,)\n(3,)\n"


def test_packages_that_are_missing_are_named(tmp_path, make_policy, monkeypatch):
    path = tmp_path / "policy.safetensors"
    make_policy("osr").save(path)
    for package, file, extra in [
        ("torchrl_osr.lab.run.trained_run", tmp_path, "train"),
        ("safetensors", path, "export"),
    ]:
        monkeypatch.setitem(sys.modules, package, None)
        monkeypatch.delitem(
            sys.modules, "torchrl_osr.lab.run.policy_of_run", raising=False
        )
        with pytest.raises(ImportError, match=rf"install torchrl-osr\[{extra}\]"):
            load_policy(file)


def test_observations_of_mujoco_are_taken_as_a_module_too(make_policy):
    policy = make_policy("osr")
    module = TensorDictModule(policy, ["observation"], ["action"])
    rows = torch.randn(4, 3, dtype=torch.float64)
    action = module(TensorDict({"observation": rows}, [4]))["action"]
    assert torch.equal(action, policy.act(rows.float()))
