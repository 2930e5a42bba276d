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
from torchrl_osr.lab.dynamics.training import FILE, dynamics_model, load_dynamics
from torchrl_osr.trainers import OfflineTrainer

TINY = DynamicsOptions(
    num_networks=3, num_elites=2, num_cells=[8], batch_size=8, steps=20
)

pytestmark = pytest.mark.usefixtures("own_cache")


def modelled(folder: Path, data: ModelData, options: DynamicsOptions):
    """Return the model, and its trainer if one was needed."""
    folder.mkdir(exist_ok=True)
    trainers = []

    def fit(name, loss, params, **keywords) -> OfflineTrainer:
        update = fast_update(loss, torch.optim.Adam(params, lr=options.lr))
        keywords |= {"folder": folder / name, "seed": data.seed, "progress": False}
        trainers.append(OfflineTrainer(update, **keywords))
        trainers[0].train()
        return trainers[0]

    return dynamics_model(options, data, fit, folder), *trainers


def test_the_best_model_is_kept_and_trained_once(data, tmp_path) -> None:
    options = replace(TINY, lr=0.3)
    before = torch.get_rng_state()
    first, trainer = modelled(tmp_path / "a", data, options)
    assert torch.equal(torch.get_rng_state(), before)
    errors = [row["mse"] for row in trainer.history[1:]]
    assert min(errors) < errors[-1]
    best = dynamics_report(first, data.held_out)["mse"]
    assert best == pytest.approx(min(errors))
    (again,) = modelled(tmp_path / "a", data, options)
    assert all(map(torch.equal, first.parameters(), again.parameters()))


def test_a_given_model_must_be_one_of_the_same_data(data, tmp_path) -> None:
    modelled(tmp_path / "first", data, TINY)
    given = replace(TINY, path=str(tmp_path / "first" / FILE), num_cells=[5])
    (model,) = modelled(tmp_path / "same", data, given)
    assert model.layers[0].weight.shape[-1] == 8
    other = replace(data, reward_scale=1.0, loc=data.loc + 1)
    named = "observation mean, reward scale"
    with pytest.raises(ValueError, match=f"other data; these differ: {named}"):
        modelled(tmp_path / "other", other, given)
    path = tmp_path / "model.safetensors"
    path.write_bytes(b"no tensors at all")
    with pytest.raises(ValueError, match=r"model\.safetensors holds no dynamics model"):
        load_dynamics(path)


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
