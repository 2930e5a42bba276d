"""Updates as CUDA graphs, on graphs that are recorded on a CPU (see conftest.py)."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torchrl.modules.distributions import continuous
from torchrl.objectives import HardUpdate
from torchrl.objectives.value import TD0Estimator

from torchrl_osr import StatePerturbation
from torchrl_osr.trainers.captured import (
    WARM_UP,
    CapturedUpdate,
    make_capturable,
    networks_of,
)

NAMES = ("OSR", "OSR-v", "CQL", "OSR-10", "EDAC", "adversarial")
CASES = [(name, norm) for name in NAMES for norm in (False, True)]
CASES.append(("inverse dynamics", False))
CPU = torch.device("cpu")


def assert_same_bits(mine, theirs) -> None:
    assert all(torch.equal(a, b) for a, b in zip(mine, theirs, strict=True))


def log_of(numbers: list) -> SimpleNamespace:
    """Return a logger that notes name, value and step."""
    return SimpleNamespace(
        log_scalar=lambda name, value, step: numbers.append((name, step, value))
    )


@pytest.mark.parametrize(("name", "layer_norm"), CASES)
def test_replayed_run_is_the_plain_one(tmp_path, graphs, runs, name, layer_norm):
    """Bit by bit; and nothing in it waits for the host, or copies from it."""

    def trained(folder, **options):
        numbers = []
        trainer = runs.make(
            tmp_path / folder,
            name,
            loss_options={"layer_norm": layer_norm},
            loggers=[log_of(numbers)],
            **options,
        )
        trainer.train()
        return runs.state(trainer), numbers, trainer

    state, numbers, _ = trained("plain")
    replayed, again, trainer = trained("replayed", cudagraph=True)
    assert_same_bits(replayed, state)
    assert [row[:2] for row in again] == [row[:2] for row in numbers]
    wanted = [value for *_, value in numbers]
    assert [value for *_, value in again] == pytest.approx(wanted, rel=1e-4, abs=1e-6)
    (graph,) = graphs
    assert graph.replays == 12 - WARM_UP
    assert trainer.step == trainer.collected_frames == 12


def test_every_call_is_one_update(graphs):
    number, seen = torch.zeros(()), []

    def update():
        seen.append(number.item() if not graphs else None)
        number.add_(1)
        return TensorDict({"loss": number.clone(), "whole": number.long()})

    captured = CapturedUpdate(update, list, CPU)
    with pytest.raises(RuntimeError, match="no update yet"):
        captured.means()
    for calls, mean in ((2, 1.5), (5, 5.0), (1, 8.0)):
        for _ in range(calls):
            captured()
        means = captured.means()
        assert means["loss"] == means["whole"] == mean
    assert number == 8
    # Python takes part in the first three, and in the capture.
    assert seen == [0, 1, 2, None]
    assert graphs[0].replays == 8 - WARM_UP


def test_update_that_cannot_be_captured_goes_on_without(tmp_path, graphs, runs, caplog):
    """With the state as if nothing had been tried, and a word about it."""

    def trained(folder, **options):
        numbers = []
        trainer = runs.make(tmp_path / folder, loggers=[log_of(numbers)], **options)
        original = trainer.loss_module.forward

        def forward(batch):
            losses = original(batch)
            losses["read"] = torch.full((), losses["loss_actor"].item())
            return losses

        trainer.loss_module.forward = forward
        trainer.train()
        return runs.state(trainer), numbers, trainer

    state, numbers, _ = trained("plain")
    assert not any(record.exc_info for record in caplog.records)
    mine, again, trainer = trained("captured", cudagraph=True)
    assert_same_bits(mine, state)
    assert [value for *_, value in again] == pytest.approx(
        [value for *_, value in numbers], rel=1e-4, abs=1e-6
    )
    assert [graph.replays for graph in graphs] == [0]
    assert all(each.grad is None for each in trainer.loss_module.parameters())
    (record,) = (each for each in caplog.records if each.levelname == "WARNING")
    assert "_local_scalar_dense" in record.message
    assert "cudagraph=False" in record.message
    assert record.exc_info


def test_capture_that_fails_after_the_backward_leaves_no_gradient(
    tmp_path, graphs, runs, monkeypatch
):
    """What is left of it would be added to that of the next update."""
    plain = runs.make(tmp_path / "plain")
    plain.train()
    trainer = runs.make(tmp_path / "captured", cudagraph=True)
    original = trainer.optimizer.step

    def step():
        if graphs and graphs[0].capturing:
            raise RuntimeError("not here")
        original()

    monkeypatch.setattr(trainer.optimizer, "step", step)
    trainer.train()
    assert graphs[0].replays == 0
    assert_same_bits(runs.state(trainer), runs.state(plain))


@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("after", [False, True])
def test_run_continues_with_or_without_a_graph(tmp_path, graphs, runs, before, after):
    undisturbed = runs.make(tmp_path / "undisturbed")
    undisturbed.train()
    wanted = runs.state(undisturbed)
    runs.make(tmp_path / "run", total_steps=6, cudagraph=before).train()
    resumed = runs.make(tmp_path / "run", cudagraph=after)
    resumed.train()
    assert_same_bits(runs.state(resumed), wanted)
    assert len(graphs) == before + after
    # Loading puts other tensors in the optimizer, which the graph knows nothing of.
    held = resumed.captured
    resumed.resume()
    assert (resumed.captured is None) == (held is None) == (not after)
    assert resumed.captured is not held or not after


def test_hooks_are_in_the_graph(tmp_path, graphs, runs):
    def trained(folder, **options):
        trainer = runs.make(tmp_path / folder, **options)
        count, seen = torch.zeros(()), []

        def double(batch):
            seen.append(trainer.step)
            return batch.set(("next", "reward"), 2 * batch["next", "reward"])

        trainer.register_op("process_optim_batch", double)
        trainer.register_op("post_optim", lambda: count.add_(1))
        trainer.train()
        return runs.state(trainer), count, seen

    state, count, seen = trained("plain")
    replayed, again, seen_again = trained("replayed", cudagraph=True)
    assert_same_bits(replayed, state)
    assert count == again == 12
    assert seen == list(range(1, 13))
    assert seen_again == seen[: WARM_UP + 1]


def test_generators_of_the_run_are_registered(tmp_path, graphs, runs):
    trainer = runs.make(tmp_path, cudagraph=True)
    trainer.train()
    (graph,) = graphs
    states = [generator.get_state() for generator in graph.generators]
    # Torch's own, the sampler's and the noise's.
    assert_same_bits(states, [runs.state(trainer)[i] for i in (-1, -3, -2)])


def test_optimizer_and_bounds_are_put_on_the_device(runs):
    """Also the counts that a run on the host has left in a checkpoint."""
    loss = runs.make_loss("OSR")
    optimizer = torch.optim.Adam(loss.parameters())
    for parameter in loss.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    assert {row["step"].device.type for row in optimizer.state.values()} == {"cpu"}
    make_capturable(loss, optimizer, torch.device("meta"))
    assert all(group["capturable"] for group in optimizer.param_groups)
    assert {row["step"].device.type for row in optimizer.state.values()} == {"meta"}
    bounds = [
        getattr(each, "distribution_kwargs", {}).get("low")
        for each in networks_of(loss)
    ]
    bounds = [each for each in bounds if each is not None]
    assert len(bounds) == 2
    assert {each.device.type for each in bounds} == {"meta"}


def test_what_cannot_be_captured_is_refused_by_name(tmp_path, graphs, runs):
    loss = runs.make_loss("OSR")
    with pytest.raises(ValueError, match="HardUpdate counts updates on the host"):
        runs.make(tmp_path, target_net_updater=HardUpdate(loss), cudagraph=True)
    trainer = runs.make(tmp_path, cudagraph=True)
    trainer.register_op("post_optim_log", lambda batch: {})
    with pytest.raises(ValueError, match="no room for post_optim_log hooks"):
        trainer.train()


def test_graph_without_a_gpu_is_refused(tmp_path, runs):
    with pytest.raises(ValueError, match="needs a CUDA device, got device='cpu'"):
        runs.make(tmp_path, cudagraph=True)


def test_noise_continues_in_the_generator_that_a_graph_holds(runs):
    perturbation, data = StatePerturbation(0.1, seed=3), runs.make_data("cpu")

    def drawn():
        return perturbation(data.copy())["perturbed", "observation"]

    first = drawn()
    held, state = perturbation._generator, perturbation.state_dict()
    second = drawn()
    perturbation.load_state_dict(state)
    assert perturbation._generator is held
    assert torch.equal(drawn(), second)
    # What a GPU's generator has left means nothing to a CPU's, which starts anew.
    state["_extra_state"] = torch.zeros(16, dtype=torch.uint8)
    perturbation = StatePerturbation(0.1, seed=3)
    perturbation.load_state_dict(state)
    assert torch.equal(drawn(), first)


class OnHost(TorchDispatchMode):
    """Notes the operations that have a tensor on the host."""

    def __init__(self) -> None:
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        options = options or {}
        out = function(*arguments, **options)
        for each in tree_leaves((arguments, options, out)):
            if isinstance(each, torch.Tensor) and each.device.type == "cpu":
                self.found.append(function)
        return out


@pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")
@pytest.mark.parametrize(("name", "layer_norm"), CASES)
def test_losses_keep_to_their_device(runs, name, layer_norm, monkeypatch):
    """The meta device stands for a GPU: it has no numbers to be read, nor copied."""
    monkeypatch.setattr(StatePerturbation, "_generator_on", lambda *_: None)
    # TorchRL's distributions check their bounds only where nothing is captured.
    monkeypatch.setattr(continuous, "safe_is_current_stream_capturing", lambda: True)
    data = runs.make_data("meta")
    loss = runs.make_loss(name, layer_norm=layer_norm, device="meta")
    for kind in (loss._buffers, loss._parameters):
        for key, tensor in kind.items():
            moved = tensor.detach().to("meta")
            kind[key] = moved.requires_grad_(tensor.requires_grad)
    for module in loss.modules():
        if isinstance(module, TD0Estimator):
            module.gamma = module.gamma.to("meta")
    perturbation = StatePerturbation(0.1)

    def step():
        losses = loss(perturbation(data[:8]))
        terms = (value for key, value in losses.items() if key.startswith("loss_"))
        sum(terms).backward()

    step()
    with OnHost() as host:
        step()
    assert not host.found
