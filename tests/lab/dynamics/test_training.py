"""Training models and rolling a run's policy out in them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from composed import trained
from tensordict import TensorDict
from uneven_dynamics import linear_dynamics

from torchrl_osr.fast import FastUpdate
from torchrl_osr.lab.dynamics import DynamicsOptions, ModelData
from torchrl_osr.lab.dynamics.training import dynamics_model, dynamics_report
from torchrl_osr.lab.evaluation.figures import read_scalars
from torchrl_osr.trainers import OfflineTrainer

TINY = DynamicsOptions(
    num_networks=3, num_elites=2, num_cells=[8], batch_size=8, steps=20
)


def modelled(folder: Path, data: ModelData, options: DynamicsOptions):
    """Return the model, and its trainer if one was needed."""
    folder.mkdir(exist_ok=True)
    trainers = []

    def fit(name, loss, params, **keywords) -> OfflineTrainer:
        update = FastUpdate(loss, torch.optim.Adam(params, lr=options.lr))
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


def test_a_model_learns_where_a_task_without_a_known_rule_ends(data, tmp_path) -> None:
    rows = data.storage[:].clone()
    fallen = rows["next", "observation"][:, :1] < -1
    data.storage.set(range(len(rows)), rows.set(("next", "terminated"), fallen))
    model, _ = modelled(tmp_path / "a", replace(data, env_id=None), TINY)
    assert -1 <= model.limits[0, 0] < -0.9
    assert model.limits.isfinite().sum() == 1
    rolled_out = modelled(tmp_path / "b", data, TINY)[0]  # a Hopper
    assert rolled_out.limits.isinf().all()


SMALL = [
    "trainer.log_interval=1", "trainer.eval_interval=100", "dynamics.num_networks=3",
    "dynamics.num_elites=2", "dynamics.num_cells=[8]", "dynamics.batch_size=8",
    "dynamics.steps=20", "dynamics.vae_num_cells=[8]", "dynamics.vae_steps=10",
    "dynamics.rollout_starts=20", "dynamics.rollout_interval=4",
]  # fmt: skip


def scalars_of(folder: Path, *overrides: str) -> dict[str, list[tuple[int, float]]]:
    """Train, or go on; return what is logged of the policy."""
    trained(folder, *SMALL, *overrides)
    return read_scalars(folder / "csv" / "scalars" / "policy")


@pytest.mark.parametrize(
    ("options", "names"),
    [
        (["loss=mopo", "dynamics.real_ratio=0.5"], {"loss_qvalue"}),
        (["loss=rim"], {"cloning_error"}),
        (["loss=sdc"], {"deviation", "multiplier"}),
    ],
)
def test_each_method_is_one_line(tmp_path, options, names) -> None:
    found = scalars_of(tmp_path / "run", *options, "trainer.steps=2")
    assert names <= found.keys()


def test_rambo_is_continued_with_the_same_bits(tmp_path) -> None:
    """Stopped amid a generation, and where one is due; with OSR's recovery term."""
    rambo = ["loss=rambo", "recovery=osr", "dynamics.real_ratio=0.25"]
    rambo += ["dynamics.adversarial_steps=7", "dynamics.adversarial_weight=1"]
    rambo += ["dynamics.generations=2"]
    whole = scalars_of(tmp_path / "whole", *rambo, "trainer.steps=18")
    for steps in (6, 12, 18):
        found = scalars_of(tmp_path / "run", *rambo, f"trainer.steps={steps}")
    for name in ("loss_qvalue", "loss_recovery"):
        assert found[name] == whole[name], name


NOISE = 0.3


def make_model():
    """s' = s + a up to noise, reward = s up to noise; two networks that agree."""
    return linear_dynamics((1, 1), {(1, 0): 1, (0, 1): 1}, (2, 2), 2 * math.log(NOISE))


def make_data(rows: int = 20_000, noise: float = NOISE) -> TensorDict:
    """One trajectory."""
    action = torch.randn(rows, 1)
    steps = action + noise * torch.randn(rows, 1)
    path = torch.cat([torch.zeros(1, 1), steps.cumsum(0)])
    no = torch.zeros(rows, 1, dtype=torch.bool)
    reward = path[:-1] + noise * torch.randn(rows, 1)
    after = {"observation": path[1:].clone(), "reward": reward, "done": no}
    after["terminated"] = no.clone()
    found = {"observation": path[:-1], "action": action, "next": after}
    return TensorDict(found, [rows])


def test_report_of_the_true_model() -> None:
    report = dynamics_report(make_model(), make_data())
    entropy = 2 * (0.5 * math.log(2 * math.pi * math.e) + math.log(NOISE))
    assert report["nll"] == pytest.approx(entropy, abs=0.02)
    assert report["within_1_sigma"] == pytest.approx(0.6827, abs=0.01)
    assert report["mse"] == pytest.approx(NOISE**2, abs=2e-3)
    # The change has a variance of 1 + .09, of which the noise is .09.
    assert report["r2"][0] == pytest.approx(1 / 1.09, abs=0.01)
