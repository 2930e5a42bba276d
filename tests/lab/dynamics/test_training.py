"""Training models and rolling a run's policy out in them."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torchrl.data import LazyTensorStorage

from torchrl_osr.lab.__main__ import main
from torchrl_osr.lab.dynamics import DynamicsOptions, reverse_transitions
from torchrl_osr.lab.dynamics.training import (
    FILE,
    ModelData,
    Phase,
    dynamics_model,
    load_dynamics,
    rollout_buffer,
)
from torchrl_osr.modules import deterministic_actor
from torchrl_osr.trainers import OfflineTrainer

TINY = DynamicsOptions(
    num_networks=3, num_elites=2, num_cells=[8], batch_size=8, steps=20,
    rollout_starts=20, rollout_interval=4, generations=2, real_ratio=0.25,
)  # fmt: skip

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture
def data(transitions) -> ModelData:
    storage = LazyTensorStorage(540)
    storage.set(range(540), transitions(540, observation=11, action=3))
    held_out = transitions(60, observation=11, action=3, seed=8)
    loc, scale = torch.zeros(11), torch.full([11], 0.1)
    loc[0] = 1.2  # upright
    pieces = held_out.reshape(3, 20)
    return ModelData(storage, held_out, pieces, loc, scale, 2.0, 0.0, "Hopper-v5")


def modelled(folder: Path, data: ModelData, options: DynamicsOptions, seed: int = 0):
    """Return the model, and its trainer if one was needed."""
    folder.mkdir(exist_ok=True)
    trainers = []

    def new_trainer(*arguments, **keywords) -> OfflineTrainer:
        trainers.append(OfflineTrainer(*arguments, progress=False, **keywords))
        return trainers[0]

    phase = Phase(folder, new_trainer, torch.optim.Adam, seed, "hopper", {})
    return dynamics_model(options, data, phase), *trainers


def test_a_model_is_trained_once_and_anew_if_its_file_is_damaged(
    data, tmp_path, monkeypatch
) -> None:
    monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path))
    options = replace(TINY, lr=0.3)
    first, trainer = modelled(tmp_path / "a", data, options)
    errors = [row["mse"] for row in trainer.history]
    assert min(errors) < errors[-1]
    targets = data.held_out["next", "observation"] - data.held_out["observation"]
    targets = torch.cat([targets, data.held_out["next", "reward"]], -1)
    mean = first.predict(data.held_out["observation"], data.held_out["action"]).mean
    error = ((mean - targets) / first.target_scale).square().mean()
    assert error.item() == pytest.approx(min(errors))  # of the best evaluation
    assert len(modelled(tmp_path / "b", data, options)) == 1
    assert len(modelled(tmp_path / "c", data, options, seed=1)) == 2
    content = (tmp_path / "a" / FILE).read_bytes()
    assert (tmp_path / "b" / FILE).read_bytes() == content
    for cached in (tmp_path / "dynamics").glob("*.safetensors"):
        cached.write_bytes(cached.read_bytes()[:-3])
    assert len(modelled(tmp_path / "d", data, options)) == 2
    assert (tmp_path / "d" / FILE).read_bytes() == content


def test_a_given_model_must_be_one_of_the_same_data(data, tmp_path) -> None:
    modelled(tmp_path / "first", data, TINY)
    given = replace(TINY, path=str(tmp_path / "first" / FILE), num_cells=[5])
    (model,) = modelled(tmp_path / "same", data, given)
    assert model.layers[0].weight.shape[-1] == 8
    for other, named in (
        (data.reverse(), "held-out rows, direction of time"),
        (replace(data, reward_scale=1.0), "reward scale"),
    ):
        with pytest.raises(ValueError, match=f"other data; these differ: {named}"):
            modelled(tmp_path / named, other, given)
    path = tmp_path / "model.safetensors"
    path.write_bytes(b"no tensors at all")
    with pytest.raises(ValueError, match=r"model\.safetensors holds no dynamics model"):
        load_dynamics(path)


def test_reverse_data_run_from_the_last_state_to_the_first(data) -> None:
    reverse, samples = data.reverse(), []
    for each in (data, reverse):
        rows = each.buffer(8)
        rows.set_rng(torch.Generator().manual_seed(0))
        samples.append(rows.sample())
    torch.testing.assert_close(reverse_transitions(samples[1]), samples[0])
    step = reverse_transitions(reverse.pieces[0, 0])
    torch.testing.assert_close(step, data.pieces[0, -1])


def buffer_of(data: ModelData, options: DynamicsOptions, **batches):
    """Return a buffer of roll-outs, a batch, the untrained model and the actor."""
    torch.manual_seed(0)
    model, actor = options.ensemble(11, 3), deterministic_actor(11, 3, num_cells=[8])
    batches = {"batch_size": 8, "gamma": 0.99, "n_steps": 1} | batches
    buffer = rollout_buffer(
        options, data, model, actor, seed=0, transform=lambda batch: batch, **batches
    )
    return buffer, buffer.sample(), model, actor


@pytest.mark.parametrize("steps", [0, 3])
def test_rollouts_start_in_states_of_the_data_or_beside_them(data, steps) -> None:
    buffer, *_ = buffer_of(data, replace(TINY, perturbed_start_steps=steps))
    starts = buffer.synthetic["observation"][:10]
    known = data.storage.get(torch.arange(540))["observation"]
    there = (starts.unsqueeze(1) == known).all(-1).any(1)
    assert not there.any() if steps else there.all()


@pytest.mark.parametrize(("noise", "n_steps"), [(0.0, 1), (0.3, 1), (0.0, 3)])
def test_synthetic_rows_are_marked_and_may_have_noise(data, noise, n_steps) -> None:
    options = replace(TINY, action_noise=noise)
    if n_steps > 1:
        rows = data.storage.get(range(540))
        steps = torch.full((540, 1), n_steps)
        rows["multi_step"] = rows["next"].clone().set("steps", steps)
        storage = LazyTensorStorage(540)
        storage.set(range(540), rows)
        data = replace(data, storage=storage)
    _, batch, _, actor = buffer_of(data, options, n_steps=n_steps)
    assert batch["imagined"].flatten().tolist() == [False] * 2 + [True] * 6
    rows = batch[2:]
    apart = (rows["action"] - actor(rows.select("observation"))["action"]).abs()
    assert (0.01 < apart.max() < 2) if noise else (apart.max() < 1e-6)
    if n_steps > 1:
        steps = batch["steps_to_next_obs"].flatten().tolist()
        assert steps == [n_steps] * 2 + [1] * 6


@pytest.mark.parametrize("shift", [0.0, -100.0])
def test_the_task_ends_where_the_model_is_unsure(data, shift) -> None:
    data.held_out["next", "reward"] += shift
    options = replace(
        TINY, unknown="halt", known_share=0.5, rollout_starts=400, terminations="never"
    )
    buffer, *_ = buffer_of(data, options)
    first = buffer.synthetic[:400]["next"]
    ended = first["terminated"].squeeze(-1)
    assert 0.3 < ended.float().mean() < 0.7
    worst = min(data.held_out["next", "reward"].quantile(0.01).item(), 0)
    wanted = torch.full([int(ended.sum()), 1], worst / (1 - 0.99))
    torch.testing.assert_close(first["reward"][ended], wanted)


def test_penalty_and_ends_are_in_the_units_of_the_task(data) -> None:
    options = replace(TINY, unknown="take", rollout_steps=1)
    buffer, _, model, _ = buffer_of(data, options)
    free = buffer.synthetic
    lowered = buffer_of(data, replace(options, penalty=1.5))[0].synthetic
    assert torch.equal(free["next", "observation"], lowered["next", "observation"])
    _, scale = model.predict(free["observation"], free["action"])
    scale[..., :-1] *= data.scale
    scale[..., -1] /= data.reward_scale
    wanted = 1.5 * data.reward_scale * scale.norm(dim=-1).max(0).values
    lost = (free["next", "reward"] - lowered["next", "reward"]).squeeze(-1)
    torch.testing.assert_close(lost, wanted)
    state = free["next", "observation"] * data.scale + data.loc
    fallen = (state[:, 0] <= 0.7) | (state[:, 1].abs() >= 0.2)
    assert torch.equal(free["next", "terminated"].squeeze(-1), fallen)
    assert fallen.any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_elites": 9}, "num_elites must be between 1 and num_networks=3"),
        ({"real_ratio": 0.01}, "real_ratio=0.01 of 8 rows are 0"),
        ({"unknown": "halt", "reverse_policy": "cvae"}, "need a forward model"),
        ({"perturbed_start_steps": 3, "reverse_policy": "cvae"}, "need a forward"),
        ({"unknown": "halt"}, "needs optim.gamma below 1"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options, message) -> None:
    with pytest.raises(ValueError, match=message):
        replace(TINY, **options).check("Hopper-v5", batch_size=8, gamma=1.0)


SMALL = [
    "data=random", "data.num_transitions=600", "network.num_cells=[8]",
    "trainer.batch_size=8", "trainer.inverse_dynamics_steps=3",
    "trainer.log_interval=1", "trainer.eval_episodes=1", "trainer.eval_interval=100",
    "trainer.checkpoint_interval=7", "dynamics.num_networks=3",
    "dynamics.num_elites=2", "dynamics.num_cells=[8]", "dynamics.batch_size=8",
    "dynamics.steps=20", "dynamics.vae_num_cells=[8]", "dynamics.vae_steps=10",
    "dynamics.rollout_starts=20", "dynamics.rollout_interval=4",
]  # fmt: skip


def trained(folder: Path, *overrides: str) -> dict[str, list[list[str]]]:
    """Run the command; return the policy's scalars."""
    main(["train", *SMALL, *overrides, f"hydra.run.dir={folder}"])
    found = {}
    for path in (folder / "csv" / "scalars" / "policy").glob("*.csv"):
        with path.open() as file:
            found[path.stem] = list(csv.reader(file))
    return found


@pytest.mark.parametrize(
    ("options", "names"),
    [
        (["loss=mopo", "dynamics.real_ratio=0.5"], {"rollout_reward"}),
        (["loss=romi", "dynamics.reverse_policy=cvae"], {"rollout_reward"}),
        (["loss=rim"], {"cloning_error", "rollout_rejected"}),
        (["loss=sdc"], {"deviation", "multiplier"}),
        (["loss=scas"], {"loss_actor"}),
    ],
)
def test_each_method_is_one_line(tmp_path, options, names) -> None:
    found = trained(tmp_path / "run", *options, "trainer.steps=2")
    assert names <= found.keys()


def test_rambo_is_continued_with_the_same_bits(tmp_path) -> None:
    """Stopped in the middle of a generation, with OSR's recovery term added."""
    rambo = ["loss=rambo", "recovery=osr", "dynamics.real_ratio=0.25"]
    rambo += ["dynamics.adversarial_steps=7", "dynamics.adversarial_weight=1"]
    whole = trained(tmp_path / "whole", *rambo, "trainer.steps=14")
    folder = tmp_path / "run"
    trained(folder, *rambo, "trainer.steps=6")
    found = trained(folder, *rambo, "trainer.steps=14", f"resume={folder}")
    for name in ("loss_qvalue", "loss_recovery", "rollout_reward"):
        assert found[name] == whole[name], name
    assert found["adversary_objective"] == whole["adversary_objective"]
