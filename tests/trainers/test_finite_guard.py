"""Losses and gradients that are not finite: stopped with all that led to them, or out.

Poisoned batches come from a count on the device, so that a graph repeats them too.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_osr.trainers import finite_guard
from torchrl_osr.trainers.finite_guard import FiniteGuard, pack, unpack

REWARD = ("next", "reward")


def poison(trainer, *steps: int):
    """Make the rewards of some updates' batches NaN; return the trainer."""
    count, bad = torch.zeros(()), torch.as_tensor(steps)

    def spoil(batch):
        count.add_(1)
        now = (bad == count).any()
        return batch.set(REWARD, batch[REWARD].masked_fill(now, math.nan))

    trainer.register_op("process_optim_batch", spoil)
    return trainer


def log_of(numbers: list) -> SimpleNamespace:
    return SimpleNamespace(
        log_scalar=lambda name, value, step: numbers.append((name, step, value))
    )


def learnt(trainer) -> list[torch.Tensor]:
    """Return the trained parameters and the optimizer's state."""
    rows = trainer.optimizer.state_dict()["state"].values()
    state = [value.clone() for row in rows for value in row.values()]
    return [
        *(each.detach().clone() for each in trainer.loss_module.parameters()),
        *state,
    ]


def assert_same_bits(mine, theirs) -> None:
    assert all(torch.equal(a, b) for a, b in zip(mine, theirs, strict=True))


@pytest.fixture(params=[False, True], ids=["at once", "on the device"])
def captured(request, graphs) -> bool:
    """Return whether updates are graphs, which decide for themselves."""
    return request.param


@pytest.mark.parametrize("step", [1, 2, 7, 8])
def test_run_stops_with_what_led_to_it(tmp_path, runs, captured, step):
    trainer = poison(runs.make(tmp_path / "run", cudagraph=captured), step)
    match = f"train: step {step}: not finite: losses .*loss_qvalue.*; gradients qvalue"
    with pytest.raises(FloatingPointError, match=match) as raised:
        trainer.train()
    path = tmp_path / "run" / "nonfinite" / f"step-{step:012d}.pt"
    assert f"torch.load('{path}', weights_only=True)" in str(raised.value)
    assert [each.name for each in path.parent.iterdir()] == [path.name]
    saved = torch.load(path, weights_only=True)
    assert saved["step"] == step
    assert saved["batch"]["next"]["reward"].isnan().all()
    assert saved["batch"]["observation"].shape == (8, 3)
    assert math.isnan(saved["losses"]["loss_qvalue"])
    assert math.isfinite(saved["losses"]["loss_actor"])
    assert saved["gradients"]
    assert all(name.startswith("qvalue_network_params") for name in saved["gradients"])
    # Networks, targets and moments are those of the updates before, to the bit.
    before = runs.make(tmp_path / "before", total_steps=max(step - 1, 1))
    if step > 1:
        before.train()
        assert_same_bits(learnt(trainer), learnt(before))
    wanted = before.loss_module.state_dict()
    assert saved["loss_module"].keys() == wanted.keys()
    assert_same_bits(saved["loss_module"].values(), wanted.values())
    # And they give the loss that was not finite.
    loss = before.loss_module
    loss.load_state_dict(saved["loss_module"])
    assert loss(TensorDict(saved["batch"], [8]))["loss_qvalue"].isnan()


def test_gradient_of_a_finite_loss_is_named(tmp_path, runs, captured):
    trainer = runs.make(tmp_path, cudagraph=captured)
    original = trainer.loss_module.forward
    parameters = dict(trainer.loss_module.named_parameters())
    name = next(each for each in parameters if each.startswith("actor"))

    def forward(batch):
        losses = original(batch)
        losses["loss_root"] = (0 * parameters[name]).square().sum().sqrt()
        return losses

    trainer.loss_module.forward = forward
    match = (
        f"step 1: not finite: losses none; gradients {name}\\. .* checkpoint is None"
    )
    with pytest.raises(FloatingPointError, match=match):
        trainer.train()


def test_skipped_update_changes_neither_parameters_nor_moments(tmp_path, runs):
    trainer, seen = poison(runs.make(tmp_path, nonfinite="skip"), 7), {}

    def note(batch):
        seen[trainer.step] = learnt(trainer)
        return batch

    trainer.register_op("process_optim_batch", note)
    trainer.train()
    assert_same_bits(seen[8], seen[7])
    assert not torch.equal(seen[9][0], seen[8][0])
    assert trainer.guard.skipped == 1


def test_skipping_is_as_if_the_step_had_been_left_out(tmp_path, runs, captured):
    """Another run without poison, whose optimizer is held back by hand."""
    numbers, seen = [], []
    options = {"loggers": [log_of(numbers)], "nonfinite": "skip", "cudagraph": captured}
    trainer = poison(runs.make(tmp_path / "skips", **options), 2, 7, 11)
    trainer.train()
    other = runs.make(tmp_path / "other")
    step, forward = other.optimizer.step, other.loss_module.forward
    other.optimizer.step = lambda: None if other.step in (2, 7, 11) else step()
    other.loss_module.forward = lambda batch: seen.append(forward(batch)) or seen[-1]
    other.train()
    assert_same_bits(runs.state(trainer), runs.state(other))
    counts = [value for name, _, value in numbers if name == "train/skipped_updates"]
    assert counts == [1, 1, 2, 3]
    # Ticks end at 4, 6, 8, 12.
    means = [value for name, _, value in numbers if name == "train/loss_qvalue"]
    done = [(0, 2, 3), (4, 5), (7,), (8, 9, 11)]
    for mean, rows in zip(means, done, strict=True):
        wanted = torch.stack([seen[row]["loss_qvalue"] for row in rows]).mean()
        assert mean == pytest.approx(wanted.item(), rel=1e-5)


def test_each_tick_warns_once(tmp_path, runs, captured, caplog):
    options = {"nonfinite": "skip", "cudagraph": captured}
    poison(runs.make(tmp_path, **options), 2, 3, 7, 11).train()
    said = [each.message for each in caplog.records if "skipped" in each.message]
    assert len(said) == 3
    assert "2 of the 4 updates up to step 4 were skipped, 2 since" in said[0]
    assert "1 of the 2 updates up to step 8 were skipped, 3 since" in said[1]
    assert "1 of the 4 updates up to step 12 were skipped, 4 since" in said[2]


def test_tick_in_which_nothing_is_learnt_stops_the_run(tmp_path, runs, captured):
    options = {"nonfinite": "skip", "cudagraph": captured}
    trainer = poison(runs.make(tmp_path, **options), 5, 6)
    with pytest.raises(FloatingPointError, match="step 5: .* All 2 updates since were"):
        trainer.train()
    saved = torch.load(next(tmp_path.glob("nonfinite/*")), weights_only=True)
    assert saved["step"] == 5


def test_count_of_skipped_updates_survives_a_resume(tmp_path, runs):
    poison(runs.make(tmp_path, total_steps=6, nonfinite="skip"), 1, 3, 6).train()
    resumed = runs.make(tmp_path, nonfinite="skip")
    resumed.resume()
    assert resumed.guard.skipped == 3
    poison(resumed, 2).train()
    assert resumed.guard.skipped == 4


def make_guard(mode: str, layer: torch.nn.Module, *, cudagraph: bool, **options):
    optimizer = torch.optim.Adam(layer.parameters(), **options)
    trainer = SimpleNamespace(
        loss_module=layer,
        optimizer=optimizer,
        cudagraph=cudagraph,
        description="train",
        step=0,
        rotation=SimpleNamespace(directory="unused", latest=lambda: None),
    )
    return FiniteGuard(trainer, mode)


def test_what_cannot_be_had_is_refused_by_name():
    layer = torch.nn.Linear(1, 1)
    with pytest.raises(ValueError, match="'stop' or 'skip', got 'go'"):
        make_guard("go", layer, cudagraph=False)
    with pytest.raises(ValueError, match=r"fused=True\); got Adam without"):
        make_guard("skip", layer, cudagraph=True)
    make_guard("skip", layer, cudagraph=False)
    make_guard("skip", layer, cudagraph=True, fused=True)


def test_other_optimizers_on_a_device_are_told_of_at_the_end(tmp_path):
    """They take the step, and the message says so."""
    layer = torch.nn.Linear(2, 1)
    guard = make_guard("stop", layer, cudagraph=True)
    guard.trainer.rotation.directory = tmp_path
    # Also of a batch of another size than the first one's.
    for rows, factor in ((3, 1.0), (5, math.inf), (3, 1.0)):
        batch = TensorDict({"x": torch.full((rows, 2), factor)}, [rows])
        loss = layer(batch["x"]).sum()
        loss.backward()
        guard.step(batch, TensorDict({"loss_a": loss.detach()}))
        layer.zero_grad()
    with pytest.raises(FloatingPointError, match="step 2: .* 3 updates after are in"):
        guard.settle()
    saved = torch.load(next(tmp_path.glob("nonfinite/*")), weights_only=True)
    assert saved["batch"]["x"].shape == (5, 2)


def test_full_disk_does_not_hide_why_the_run_stops(tmp_path, runs, monkeypatch):
    trainer = poison(runs.make(tmp_path), 2)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(finite_guard.os, "fsync", full)
    with pytest.raises(FloatingPointError, match="not be written to .*No space left"):
        trainer.train()
    assert not list(tmp_path.glob("nonfinite/*"))


@given(
    st.lists(
        st.tuples(
            st.sampled_from([torch.bool, torch.uint8, torch.float32, torch.float64]),
            st.lists(st.integers(0, 4), max_size=3),
        ),
        min_size=1,
        max_size=6,
    )
)
def test_what_is_packed_is_unpacked(tensors):
    generator = torch.Generator().manual_seed(0)
    before = TensorDict(
        {
            ("nested", str(index)): torch.randint(0, 2, shape, generator=generator).to(
                dtype
            )
            for index, (dtype, shape) in enumerate(tensors)
        }
    )
    after = unpack(*pack(before))["nested"]
    assert after.keys() == before["nested"].keys()
    for key, value in before["nested"].items():
        assert after[key].dtype == value.dtype
        assert torch.equal(after[key], value)
