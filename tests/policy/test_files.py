"""A saved policy comes back whole, or the file is refused with its name."""

from __future__ import annotations

import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors import safe_open

from torchrl_osr import load_policy
from torchrl_osr._files import checksummed
from torchrl_osr.policy.tensor_file import RECORD, read_tensors, write_tensors

SHARED = [HealthCheck.function_scoped_fixture]


@pytest.mark.parametrize("kind", ["osr", "td3_bc", "discrete"])
@pytest.mark.parametrize("layer_norm", [False, True])
def test_a_saved_policy_comes_back(tmp_path, make_policy, kind, layer_norm):
    options = {} if kind == "discrete" else {"layer_norm": layer_norm}
    policy = make_policy(kind, num_qvalue_nets=3, **options)
    policy.save(tmp_path / "policy.safetensors")
    again, rows = (
        load_policy(tmp_path / "policy.safetensors"),
        torch.randn(9, 3).numpy(),
    )
    assert np.array_equal(policy.act(rows), again.act(rows))
    assert np.array_equal(policy.value(rows), again.value(rows))
    generators = [torch.Generator().manual_seed(5) for _ in range(2)]
    drawn = (
        each.act(rows, generator=g)
        for each, g in zip((policy, again), generators, strict=True)
    )
    assert np.array_equal(*drawn)
    assert {name.name for name in tmp_path.iterdir()} == {"policy.safetensors"}


def test_the_record_is_readable_json(tmp_path, make_policy):
    path = tmp_path / "policy.safetensors"
    make_policy("osr").save(path)
    with safe_open(path, "np") as file:
        record = json.loads(file.metadata()[RECORD])
        assert file.get_tensor("actor.0.weight").shape == (8, 3)
    assert record["format"] == 1
    assert record["low"] == [-2.0, 0.5]
    assert record["source"] == {"loss": "OSRLoss", "env_id": "Task-v0", "step": 7}
    assert record["versions"]["torch"] == torch.__version__
    again = load_policy(path)
    again.save(tmp_path / "again.safetensors")
    assert load_policy(tmp_path / "again.safetensors").record["low"] == [-2.0, 0.5]


@pytest.fixture(scope="module")
def saved(tmp_path_factory, make_policy) -> bytes:
    path = tmp_path_factory.mktemp("saved") / "policy.safetensors"
    make_policy("osr").save(path)
    return path.read_bytes()


def refusal(folder: Path, content: bytes) -> str:
    path = folder / "policy.safetensors"
    path.write_bytes(content)
    with pytest.raises(
        ValueError, match=r"policy\.safetensors cannot be read"
    ) as error:
        load_policy(path)
    return str(error.value)


@settings(max_examples=150, deadline=None, suppress_health_check=SHARED)
@given(st.data())
def test_no_damaged_file_is_used(tmp_path, saved, data):
    content = bytearray(saved)
    if data.draw(st.booleans(), "cut"):
        del content[data.draw(st.integers(0, len(content) - 1), "end") :]
    else:
        most = data.draw(st.sampled_from([8, len(content) - 1]), "within")
        place = data.draw(st.integers(0, most), "place")
        content[place] ^= data.draw(st.integers(1, 255), "bits")
    refusal(tmp_path, bytes(content))


def crafted(tmp_path: Path, saved: bytes, **changes) -> bytes:
    """The file with another record and right checksums, as an attacker makes it."""
    original, path = tmp_path / "original", tmp_path / "crafted"
    original.write_bytes(saved)
    tensors, record = read_tensors(original)
    tensors |= changes.pop("tensors", {})
    del record["checksum"], record["tensors_sha256"]
    write_tensors(path, tensors, record | changes)
    return path.read_bytes()


def mlp(*cells: int, activation: str = "ReLU") -> dict:
    return {"num_cells": list(cells), "activation": activation, "layer_norm": False}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observation_size": 10**15}, "observation_size must be from 1 to"),
        ({"observation_size": True}, "observation_size must be from 1 to"),
        ({"observation_size": 4}, r"weight has shape \(8, 3\), expected \(8, 4\)"),
        ({"action_size": "2"}, "action_size must be from 1 to"),
        ({"low": [-1.0]}, "low and high must have 2 entries"),
        ({"low": ["a", "b"]}, "str"),
        ({"low": [9.0, 9.0]}, "must be below"),
        ({"high": [1e300, 1.5]}, "must be below|overflow"),
        ({"distribution": "os.system"}, "distribution must be one of"),
        ({"actor": None}, "NoneType"),
        ({"actor": mlp(10**9)}, "num_cells must be from 1 to"),
        ({"actor": mlp(*[2**20] * 64)}, "has shape"),
        ({"actor": mlp(*[8] * 65)}, "must list up to 64"),
        ({"actor": mlp(8, 4, activation="Module")}, "activation must be one of"),
        ({"critics": {}}, "no 'number' in it"),
        ({"critics": {"number": 10**9}}, "number of critics must be from 0 to 1000"),
        ({"source": None}, "NoneType"),
        ({"tensors": {"scale": torch.zeros(3)}}, "scale.* must be above 0"),
        ({"tensors": {"loc": torch.full((3,), torch.nan)}}, "loc must be .* finite"),
        ({"tensors": {"loc": torch.zeros(3).double()}}, "loc must be float32"),
        ({"tensors": {"more": torch.zeros(3)}}, r"more has shape \(3,\), expected"),
    ],
)
def test_what_a_hostile_record_asks_for(tmp_path, saved, changes, message):
    content = crafted(tmp_path, saved, **changes)
    assert re.search(message, refusal(tmp_path, content))


def test_other_files_are_refused(tmp_path, saved):
    newer = {RECORD: json.dumps(checksummed({"format": 2}))}
    deep = {RECORD: "[" * 100_000}
    tensors = {"loc": torch.zeros(3)}
    for content, message in [
        (
            safetensors.torch.save(tensors, newer),
            "format 2, .* reads format 1",
        ),
        (safetensors.torch.save(tensors, deep), "its record is no JSON"),
        (safetensors.torch.save(tensors), "without the record of a policy"),
        (
            (2**40).to_bytes(8, "little") + saved[8:],
            "more than 1,048,576 bytes",
        ),
        (pickle.dumps({"loc": 1}), "no safetensors file"),
        (b"", "header"),
    ]:
        assert re.search(message, refusal(tmp_path, content))
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path / "nothing.safetensors")
    with pytest.raises(FileNotFoundError, match="no run and no checkpoint at"):
        load_policy(tmp_path / "nothing")


def test_the_name_says_what_it_is(tmp_path, make_policy):
    with pytest.raises(ValueError, match=r"end in \.safetensors, got .*policy\.pt"):
        make_policy("osr").save(tmp_path / "policy.pt")
    with pytest.raises(OSError, match="cannot write the file"):
        make_policy("osr").save(tmp_path / "nowhere" / "policy.safetensors")
