"""CUDA graphs on a GPU: the run that they are captured from, faster."""

from __future__ import annotations

import pytest
import torch

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
    # What tensordict and torch.compile say of themselves when they trace.
    pytest.mark.filterwarnings("ignore:Using lock_:UserWarning"),
    pytest.mark.filterwarnings("ignore:Tensordict is registered in PyTree:UserWarning"),
    pytest.mark.filterwarnings("ignore:.*autograd.function:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning"),
]
NAMES = ("OSR", "OSR-v", "CQL", "OSR-10", "EDAC", "inverse dynamics")


def trained(runs, folder, name="OSR", **options):
    options = {"total_steps": 50, "log_interval": 10, "eval_interval": 25} | options
    trainer = runs.make(folder, name, device="cuda", **options)
    trainer.train()
    return trainer


def assert_close(runs, mine, theirs) -> None:
    for ours, wanted in zip(runs.state(mine), runs.state(theirs), strict=True):
        torch.testing.assert_close(ours, wanted, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_graph_and_eager_steps_are_the_same(tmp_path, runs, name):
    """Also the states of the random generators, which are whole numbers."""
    eager = trained(runs, tmp_path / "eager", name)
    assert_close(runs, trained(runs, tmp_path / "graph", name, cudagraph=True), eager)


def test_run_continues_under_a_graph(tmp_path, runs):
    undisturbed = trained(runs, tmp_path / "undisturbed", cudagraph=True)
    trained(runs, tmp_path / "run", total_steps=25, cudagraph=True)
    resumed = trained(runs, tmp_path / "run", cudagraph=True)
    assert resumed.step == 50
    assert_close(runs, resumed, undisturbed)


@pytest.mark.parametrize("name", ["OSR", "OSR-v"])
def test_compiled_update_can_be_captured(tmp_path, runs, name):
    """It draws other numbers than one that is not compiled: it is held to itself."""
    plain = trained(runs, tmp_path / "plain", name, compile=True)
    graph = trained(runs, tmp_path / "graph", name, compile=True, cudagraph=True)
    assert_close(runs, graph, plain)


def test_bad_update_stops_a_graph(tmp_path, runs):
    trainer = runs.make(tmp_path, device="cuda", total_steps=50, cudagraph=True)
    trainer.register_op(
        "process_optim_batch",
        lambda batch: batch.set(
            ("next", "reward"),
            batch["next", "reward"] * (float("nan") if trainer.step == 20 else 1.0),
        ),
    )
    with pytest.raises(FloatingPointError, match="step 20: not finite: losses"):
        trainer.train()


@pytest.mark.parametrize("options", [{"fused": True}, {"capturable": True}])
def test_optimizer_that_needs_the_host_is_refused(tmp_path, runs, options):
    trainer = runs.make(tmp_path, device="cuda")
    with pytest.raises(ValueError, match="fused=True, capturable=True"):
        type(trainer)(
            trainer.loss_module,
            torch.optim.Adam(trainer.loss_module.parameters(), **options),
            trainer.buffer,
            total_steps=1,
            folder=tmp_path,
            cudagraph=True,
        )


def test_other_optimizers_are_checked_at_every_update(tmp_path, runs):
    assert trained(runs, tmp_path / "fused").nonfinite_check.deferred
    trainer = runs.make(tmp_path / "other", device="cuda")
    other = type(trainer)(
        trainer.loss_module,
        torch.optim.SGD(trainer.loss_module.parameters(), lr=0.1),
        trainer.buffer,
        total_steps=1,
        folder=tmp_path,
    )
    assert not other.nonfinite_check.deferred
