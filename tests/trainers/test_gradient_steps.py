"""What the trainer does about its host, and a word when that is no longer needed."""

from __future__ import annotations

import importlib.util
import sys

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_osr.trainers.gradient_steps import pandas_settled


# tensordict 0.14.3 is slow here; when this fails, pandas_settled can go.
def test_every_module_call_of_tensordict_looks_for_pandas(monkeypatch) -> None:
    module = TensorDictModule(torch.nn.Linear(2, 2), ["a"], ["b"])
    asked, original = [], importlib.util.find_spec

    def find_spec(name, package=None):
        asked.append(name)
        return original(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", find_spec)
    for _ in range(3):
        module(TensorDict({"a": torch.zeros(1, 2)}, [1]))
    assert asked == ["pandas"] * 3


@pytest.mark.parametrize("installed", [False, True])
def test_pandas_is_not_searched_for_inside_and_as_before_outside(
    monkeypatch, installed
) -> None:
    module = type(sys)("pandas")
    module.__spec__ = importlib.util.spec_from_loader("pandas", loader=None)
    monkeypatch.delitem(sys.modules, "pandas", raising=False)

    def import_module(name):
        if not installed:
            raise ImportError
        sys.modules[name] = module

    monkeypatch.setattr(
        "torchrl_osr.trainers.gradient_steps.import_module", import_module
    )
    with pandas_settled():
        # Straight from sys.modules, without a look at the disk.
        assert "pandas" in sys.modules
        found = importlib.util.find_spec("pandas")
        assert (found is module.__spec__) == installed
    assert ("pandas" in sys.modules) == installed
    sys.modules.pop("pandas", None)
