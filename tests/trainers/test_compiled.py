"""Compiled losses: traced once, whole, and the same run as without."""

from __future__ import annotations

import pytest
import torch
from torch._dynamo.testing import CompileCounter

# What tensordict 0.14.3 and torch.compile say of themselves when they trace.
pytestmark = [
    pytest.mark.filterwarnings("ignore:Using lock_:UserWarning"),
    pytest.mark.filterwarnings("ignore:.*autograd.function:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning"),
]


def test_loss_is_traced_once_and_whole(tmp_path, runs, monkeypatch):
    # A loop over critics with normalised layers, which no test of the losses traces.
    loss_options = {"layer_norm": True, "deactivate_vmap": True}
    options = {"total_steps": 5, "loss_options": loss_options}
    plain = runs.make(tmp_path / "plain", "OSR", **options)
    plain.train()
    wanted = runs.state(plain)
    graphs, original = CompileCounter(), torch.nn.Module.compile
    torch._dynamo.reset()
    monkeypatch.setattr(
        torch.nn.Module,
        "compile",
        lambda module: original(module, backend=graphs, fullgraph=True),
    )
    trainer = runs.make(tmp_path / "compiled", "OSR", compile=True, **options)
    assert graphs.frame_count == 0
    trainer.train()
    assert graphs.frame_count == 1
    for mine, theirs in zip(runs.state(trainer), wanted, strict=True):
        torch.testing.assert_close(mine, theirs)
