"""Actions and values are those of the networks, in the environment's units."""

from __future__ import annotations

import math
from importlib.metadata import version

import numpy as np
import pytest
import safetensors.torch
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_osr import load_policy
from torchrl_osr._files import read_tensors, write_tensors
from torchrl_osr.policy import Policy

KINDS = ("osr", "td3_bc", "discrete")
LINEAR = {"num_cells": [], "activation": "ReLU", "layer_norm": False}


def linear_policy(low: float = -1.0, high: float = 5.0) -> Policy:
    """One number in, one out, all weights known."""
    record = {"distribution": "TanhDelta", "observation_size": 1, "action_size": 1}
    record |= {"actor": LINEAR, "critics": LINEAR | {"number": 2}, "source": {}}
    numbers = {"loc": [2.0], "scale": [4.0], "low": [low], "high": [high]}
    numbers |= {"actor.0.weight": [[0.5]], "actor.0.bias": [0.1]}
    for n, (weight, bias) in enumerate([(3.0, 0.0), (-3.0, 1.0)]):
        numbers[f"critics.{n}.0.weight"] = [[weight, 1.0]]
        numbers[f"critics.{n}.0.bias"] = [bias]
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


def test_a_dictionary_is_joined_in_alphabetical_order(make_policy):
    policy, rows = make_policy("osr"), np.linspace(-1, 1, 12).reshape(4, 3)
    many = {"velocity": {"b": rows[:, 2:], "a": rows[:, 1:2]}, "angle": rows[:, :1]}
    assert policy.act(many) == pytest.approx(policy.act(rows))
    one = {"velocity": torch.tensor(rows[0, 1:]), "angle": torch.tensor(rows[0, :1])}
    assert policy.value(one).item() == pytest.approx(policy.value(rows[0]), abs=1e-6)
    policy.record["source"] = {"data": {"observation_names": [*"vaw"]}}
    named = dict(zip("vaw", rows.T[..., None], strict=True))  # a log's columns
    assert policy.act(named) == pytest.approx(policy.act(rows))
    with pytest.raises(ValueError, match="numbers named .*'x'.*columns of the log"):
        policy.act({"v": 0.0, "a": 0.0, "x": 0.0})
    policy.record["source"] = {"data": "monday.csv"}
    assert policy.act(many) == pytest.approx(policy.act(rows))
    policy.record["source"] = {"data": {"observation_names": [*"vaw"]}}
    one = dict(zip("vaw", torch.tensor(rows[0]), strict=True))  # numbers
    assert policy.act(one).numpy() == pytest.approx(policy.act(rows[0]), abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_results_have_the_kind_of_the_observation(make_policy, kind):
    policy = make_policy(kind)
    size = () if policy.discrete else (2,)
    rows = np.linspace(-3, 3, 12).reshape(4, 3)
    many = policy.act(rows)
    assert many.shape == (4, *size)
    assert many.dtype == (np.int64 if policy.discrete else np.float32)
    read_only = np.broadcast_to(rows[1], (2, 3))
    assert policy.act(read_only) == pytest.approx(many[[1, 1]], abs=1e-6)
    assert policy.act(rows[1]) == pytest.approx(many[1], abs=1e-6)
    tensors = policy.act(torch.from_numpy(rows).reshape(2, 2, 3))
    assert not tensors.requires_grad
    assert tensors.reshape(4, *size).numpy() == pytest.approx(many, abs=1e-6)
    assert policy.act(np.zeros((0, 3))).shape == (0, *size)
    assert policy.act(np.arange(3)).shape == size
    for action in (None, many):
        assert policy.value(rows, action).shape == (4,)
    assert policy.value(rows[1]) == pytest.approx(policy.value(rows)[1], abs=1e-5)
    module = TensorDictModule(policy, ["observation"], ["action"])
    # Gymnasium's MuJoCo tasks have float64.
    out = module(TensorDict({"observation": torch.from_numpy(rows)}, [4]))
    assert np.array_equal(out["action"].numpy(), many)


@settings(max_examples=50)
@given(
    observation=arrays(np.float32, (4, 1), elements=st.floats(-1e6, 1e6, width=32)),
    low=st.floats(-1e6, 1e6, width=32),
    width=st.floats(1.0, 1e6, width=32),
)
def test_actions_are_within_their_bounds(observation, low, width):
    policy = linear_policy(low, low + width)
    action = policy.act(observation)
    assert policy.low <= action.min()
    assert action.max() <= policy.high
    policy.value(observation, action)  # an action of its own is never refused


@pytest.mark.parametrize(
    ("kind", "given", "message"),
    [
        ("osr", [np.zeros(4)], r"observation has shape \(4,\), expected \(3,\) or"),
        ("osr", [np.float64(1.0)], r"observation has shape \(\), expected"),
        ("osr", [np.array([0.0, np.nan, 0.0])], "NaN or infinite"),
        ("osr", [np.array([0.0, 0.0, 1e300])], "NaN or infinite"),
        ("osr", [np.zeros((4, 3)), np.zeros(3)], r"action has shape \(3,\), expected"),
        ("osr", [np.zeros((4, 3)), np.ones((1, 2))], r"shape \(4, 2\).* is \(1, 2\)"),
        ("osr", [np.zeros((4, 3)), np.full((4, 2), 1.6)], r"within \[-2\.0.*4\.0"),
        ("discrete", [np.zeros((2, 3)), np.array([0, 2])], "lie within 0 and 1"),
        ("discrete", [np.zeros((4, 3)), np.array([0, 1])], r"must have shape \(4,\)"),
        ("discrete", [np.zeros((4, 3)), np.zeros(4)], "its type torch.float64"),
    ],
)
def test_what_is_not_valued(make_policy, kind, given, message):
    policy = make_policy(kind)
    for method in [policy.value, policy.act][: 3 - len(given)]:
        with pytest.raises(ValueError, match=message):
            method(*given)


# -- files ----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_saved_policy_comes_back(tmp_path, make_policy, kind):
    policy = make_policy(kind, num_qvalue_nets=3, layer_norm=True)
    policy.save(tmp_path / "policy.safetensors")
    again = load_policy(tmp_path / "policy.safetensors")
    rows = torch.randn(9, 3).numpy()
    assert np.array_equal(policy.act(rows), again.act(rows))
    assert np.array_equal(policy.value(rows), again.value(rows))
    assert again.record == policy.record
    assert again.record["source"]["env_id"] == "Task-v0"
    assert again.record["versions"]["torch"] == version("torch")


def test_other_files_are_refused(tmp_path, make_policy):
    path = tmp_path / "policy.safetensors"
    make_policy("osr").save(path)
    tensors, record = read_tensors(path)
    for changes, message in [
        ({"observation_size": 4}, "size mismatch for actor.0.weight"),
        ({"actor": record["actor"] | {"activation": "Module"}}, "KeyError"),
        ({"distribution": "Normal"}, "distribution must be one of"),
    ]:
        write_tensors(path, tensors, record | changes)
        with pytest.raises(ValueError, match=f"no saved policy: .*{message}"):
            load_policy(path)
    safetensors.torch.save_file({"loc": torch.zeros(3)}, path)
    with pytest.raises(ValueError, match="is no file of tensors of torchrl-osr"):
        load_policy(path)
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path / "nothing.safetensors")
