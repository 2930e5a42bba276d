"""An exported graph computes what the policy does, for any number of rows."""

from __future__ import annotations

import json
import sys
from importlib.metadata import version

import numpy as np
import onnxruntime
import pytest
import torch

from torchrl_osr._files import RECORD


def inputs(policy, rows: int, output: str) -> dict[str, torch.Tensor]:
    observation = policy.loc + 3 * policy.scale * torch.randn(rows, 3)
    action = policy.act(observation.flip(0))
    both = {"observation": observation, "action": action}
    return both if output == "value" else {"observation": observation}


def wanted(policy, given: dict[str, torch.Tensor]) -> torch.Tensor:
    return (policy.act if len(given) == 1 else policy.value)(*given.values())


# ONNX needs seconds for each. docs/deploy.md has the action of OSR's actor.
@pytest.mark.parametrize(("kind", "output"), [("osr", "value"), ("discrete", "action")])
def test_onnx(tmp_path, make_policy, kind, output):
    options = {} if kind == "discrete" else {"layer_norm": True}
    policy, path = make_policy(kind, **options), tmp_path / "policy.onnx"
    policy.export(path, output)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    for rows in (1, 2, 256):
        given = inputs(policy, rows, output)
        arrays = {name: each.numpy() for name, each in given.items()}
        (got,) = session.run([output], arrays)
        expected = wanted(policy, given).numpy()
        assert got.dtype == expected.dtype
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)
    assert session.get_inputs()[0].shape == ["batch", 3]
    record = json.loads(session.get_modelmeta().custom_metadata_map[RECORD])
    assert record["source"]["env_id"] == "Task-v0"
    assert [each.name for each in tmp_path.iterdir()] == ["policy.onnx"]


@pytest.mark.parametrize("kind", ["osr", "td3_bc", "discrete"])
@pytest.mark.parametrize("output", ["action", "value"])
def test_torch_export(tmp_path, make_policy, kind, output):
    policy, path = make_policy(kind), tmp_path / "policy.pt2"
    policy.export(path, output)
    files = {RECORD: ""}
    graph = torch.export.load(path, extra_files=files).module()
    for rows in (1, 256):
        given = inputs(policy, rows, output)
        torch.testing.assert_close(graph(**given), wanted(policy, given))
    assert json.loads(files[RECORD])["versions"]["torch"] == version("torch")
    left_out = "critics" if output == "action" else "actor"
    assert not [name for name in graph.state_dict() if left_out in name]


def test_what_cannot_be_exported(tmp_path, make_policy, monkeypatch):
    policy = make_policy("osr")
    with pytest.raises(ValueError, match="suffix of the path must be one of .*pt2"):
        policy.export(tmp_path / "policy.pt")
    with pytest.raises(ValueError, match="output must be one of"):
        policy.export(tmp_path / "policy.onnx", "state")
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(ImportError, match=r"pip install 'torchrl-osr\[export\]'"):
        policy.export(tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())
