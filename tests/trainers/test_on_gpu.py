"""CUDA graphs on a GPU: the run that they are captured from, faster.

Graphs that are recorded on a CPU stand in for them elsewhere, see test_captured.py.
"""

from __future__ import annotations

import pytest
import torch

from torchrl_osr.trainers.captured import WARM_UP

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
    # What tensordict and torch.compile say of themselves when they trace.
    pytest.mark.filterwarnings("ignore:Using lock_:UserWarning"),
    pytest.mark.filterwarnings("ignore:.*autograd.function:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning"),
]
NAMES = ("OSR", "OSR-v", "CQL", "OSR-10", "EDAC", "adversarial", "inverse dynamics")


def trained(runs, folder, name="OSR", **options):
    options = {"total_steps": 50, "log_interval": 10, "eval_interval": 25} | options
    trainer = runs.make(folder, name, device="cuda", **options)
    trainer.train()
    return trainer


def assert_close(runs, mine, theirs) -> None:
    for ours, wanted in zip(runs.state(mine), runs.state(theirs), strict=True):
        torch.testing.assert_close(ours, wanted, rtol=1e-3, atol=1e-4)


def assert_captured(trainer, caplog) -> None:
    assert trainer.captured._graph is not None
    assert not [each for each in caplog.records if each.levelname == "WARNING"]


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_graph_and_eager_steps_are_the_same(tmp_path, runs, name, layer_norm, caplog):
    """Also the states of the generators, which only the host has."""
    if name == "inverse dynamics" and layer_norm:
        pytest.skip("it has no critics")
    options = {"loss_options": {"layer_norm": layer_norm}}
    eager = trained(runs, tmp_path / "eager", name, **options)
    graph = trained(runs, tmp_path / "graph", name, cudagraph=True, **options)
    assert_captured(graph, caplog)
    assert_close(runs, graph, eager)
    for ours, wanted in zip(runs.state(graph), runs.state(eager), strict=True):
        if ours.dtype == torch.uint8:
            assert torch.equal(ours, wanted)


@pytest.mark.parametrize("before", [False, True])
def test_run_continues_under_a_graph(tmp_path, runs, before, caplog):
    undisturbed = trained(runs, tmp_path / "undisturbed", cudagraph=True)
    trained(runs, tmp_path / "run", total_steps=25, cudagraph=before)
    resumed = trained(runs, tmp_path / "run", cudagraph=True)
    assert_captured(resumed, caplog)
    assert resumed.step == 50
    assert_close(runs, resumed, undisturbed)


def test_update_that_reads_a_number_goes_on_without_a_graph(tmp_path, runs, caplog):
    eager = trained(runs, tmp_path / "eager")
    trainer = runs.make(tmp_path / "run", device="cuda", total_steps=50, cudagraph=True)
    original = trainer.loss_module.forward

    def forward(batch):
        losses = original(batch)
        losses["loss_actor"].item()
        return losses

    trainer.loss_module.forward = forward
    trainer.train()
    assert trainer.captured._graph is None
    assert any("cannot be captured" in each.message for each in caplog.records)
    assert_close(runs, trainer, eager)


@pytest.mark.parametrize("name", ["OSR", "OSR-v"])
def test_compiled_update_can_be_captured(tmp_path, runs, name, caplog):
    """It draws other numbers than one that is not compiled: it is held to itself."""
    options = {"compile": True, "total_steps": 20}
    plain = trained(runs, tmp_path / "plain", name, **options)
    graph = trained(runs, tmp_path / "graph", name, cudagraph=True, **options)
    assert_captured(graph, caplog)
    assert graph.captured._calls == 20 > WARM_UP
    assert_close(runs, graph, plain)
