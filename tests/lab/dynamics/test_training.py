"""Training models and rolling a run's policy out in them."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrl_osr.fast import fast_update
from torchrl_osr.lab.__main__ import main
from torchrl_osr.lab.dynamics import DynamicsOptions, ModelData
from torchrl_osr.lab.dynamics.fit import dynamics_report
from torchrl_osr.lab.dynamics.rollouts import reverse_transitions
from torchrl_osr.lab.dynamics.training import FILE, Phase, dynamics_model, load_dynamics
from torchrl_osr.trainers import OfflineTrainer

TINY = DynamicsOptions(
    num_networks=3, num_elites=2, num_cells=[8], batch_size=8, steps=20
)

pytestmark = pytest.mark.usefixtures("own_cache")


def modelled(folder: Path, data: ModelData, options: DynamicsOptions, seed: int = 0):
    """Return the model, and its trainer if one was needed."""
    folder.mkdir(exist_ok=True)
    trainers = []

    def new_trainer(loss, optimizer, **keywords) -> OfflineTrainer:
        update = fast_update(loss, optimizer)
        trainers.append(OfflineTrainer(update, progress=False, **keywords))
        return trainers[0]

    phase = Phase(folder, new_trainer, torch.optim.Adam, seed, "hopper", {})
    return dynamics_model(options, data, phase), *trainers


def test_a_model_is_trained_once_and_anew_if_its_file_is_damaged(
    data, tmp_path, monkeypatch
) -> None:
    monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path))
    options = replace(TINY, lr=0.3)
    first, trainer = modelled(tmp_path / "a", data, options)
    errors = [row["mse"] for row in trainer.history[1:]]
    assert min(errors) < errors[-1]
    best = dynamics_report(first, data.held_out)["mse"]
    assert best == pytest.approx(min(errors))
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
