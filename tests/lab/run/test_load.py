"""A trained run comes back as it was saved, or says why it does not."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch.optim.swa_utils import AveragedModel
from torchrl.checkpoint import CheckpointError, CheckpointRotation
from untrained_run import make_run

from torchrl_osr.lab.dynamics import DynamicsEnsemble
from torchrl_osr.lab.dynamics.training import MODEL, load_dynamics, write_dynamics
from torchrl_osr.lab.evaluation import deterministic_policy
from torchrl_osr.lab.run.build import make_learner
from torchrl_osr.lab.run.config import read_run, write_config
from torchrl_osr.lab.run.load import (
    CHECKPOINTS,
    checkpoints_of,
    load_run_policy,
    load_switching_policy,
    load_trained,
    run_folder_of,
)
from torchrl_osr.trainers.checkpoints import safe_checkpoint

BOUNDS = "env.action_low=[-1,-2,0]", "env.action_high=[1,2,4]"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    return folder, *make_run(folder)


def test_policy_critics_and_model_are_those_that_were_saved(run):
    (folder, policy, loss), rows = run, torch.randn(6, 11)
    before = torch.get_rng_state()
    trained = load_trained(folder)
    assert torch.equal(before, torch.get_rng_state())
    again = deterministic_policy(trained.actor, trained.observation_norm)
    assert torch.equal(again(rows), policy(rows))
    states = TensorDict({"observation": rows}, [6])
    there, here = (each.q(states, policy(rows)) for each in (loss, trained.loss))
    assert torch.equal(there, here)
    batch = TensorDict({"observation": rows, "next": {"observation": rows + 1}}, [6])
    with loss.inverse_dynamics_network_params.to_module(
        loss.inverse_dynamics_network, preserve_module_state=False
    ):
        saved = loss.inverse_dynamics_network.get_dist(batch.copy())
    loaded = trained.inverse_dynamics.get_dist(batch)
    assert torch.equal(saved.deterministic_sample, loaded.deterministic_sample)


def test_kept_checkpoints_come_oldest_first(run):
    folder, *_ = run
    files = checkpoints_of(folder)
    assert [load_trained(file).step for file in files] == [10, 900]
    assert load_trained(folder).path == files[-1]
    best = folder / CHECKPOINTS / "best.torchrl"
    assert load_trained(best).step == 10
    assert run_folder_of(best) == folder


def test_the_policy_is_the_average_of_its_weights(tmp_path):
    make_run(folder := tmp_path / "run")
    actor, _, loss, _ = make_learner(read_run(folder))
    average = AveragedModel(actor)
    for parameter in average.parameters():
        parameter.data.add_(1.0)
    parts = {"loss_module": loss, "policy_average": average}
    parts["observation_norm"] = load_trained(folder).observation_norm
    rotation = CheckpointRotation(folder / CHECKPOINTS, keep_last=2)
    rotation.save(safe_checkpoint(**parts), step=1000)
    trained = load_trained(folder)
    for holder in (trained.actor, trained.loss.actor_network_params):
        pairs = zip(holder.parameters(), average.parameters(), strict=True)
        assert all(torch.equal(*pair) for pair in pairs)


@pytest.mark.parametrize(
    ("key", "value", "shapes"),
    [
        ("env.observation_size", 17, [r"\(8, 11\)", r"\(8, 17\)"]),
        ("data.standardize", False, [r"\(11,\)", r"\(\)"]),
    ],
)
def test_a_configuration_of_another_run_is_refused(tmp_path, key, value, shapes):
    make_run(folder := tmp_path / "run")
    cfg = OmegaConf.load(path := folder / "config.yaml")
    OmegaConf.update(cfg, key, value)
    OmegaConf.save(cfg, path)
    wanted = f"is {shapes[0]} in the file, {shapes[1]} here"
    with pytest.raises(CheckpointError, match=wanted):
        load_trained(folder)


def test_damage_and_absence_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*nowhere"):
        load_trained(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"no config\.yaml in"):
        load_trained(tmp_path)
    make_run(folder := tmp_path / "run")
    for path in checkpoints_of(folder):
        path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(CheckpointError, match="damaged: File is not a zip file"):
        load_trained(folder)


@pytest.mark.parametrize("loss", ["osr", "td3_bc", "iql", "rebrac recovery=osr"])
def test_the_policy_of_a_run_acts_as_in_its_evaluation(tmp_path, loss):
    folder = tmp_path / "run"
    evaluated, networks = make_run(folder, *f"loss={loss}".split(), *BOUNDS)
    policy, rows = load_run_policy(folder), 2 + 3 * torch.randn(6, 11)
    actions = evaluated(rows)
    middle, half = torch.tensor([0.0, 0.0, 2.0]), torch.tensor([1.0, 2.0, 2.0])
    act = policy.act(rows)
    torch.testing.assert_close(act, middle + half * actions, atol=4e-6, rtol=0)
    states = TensorDict({"observation": (rows - 2) / 3}, [6])
    values = networks.q(states, actions).amin(0)
    torch.testing.assert_close(policy.value(rows, act), values)
    source = policy.record["source"]
    assert (source["step"], source["env_id"]) == (900, "Hopper-v5")
    assert source["data"]["source"] == "medium-replay"


def test_an_exported_policy_needs_neither_configuration_nor_environment(tmp_path):
    """The run names a loss and an environment of a module that is not there."""
    make_run(folder := tmp_path / "run", "loss=td3_bc")
    policy = load_run_policy(folder)
    policy.save(folder / "policy.safetensors")
    config = read_run(folder)
    config.env.id, config.loss["_target_"] = "absent:Arm-v0", "absent.Loss"
    write_config(folder, config)
    state = np.random.default_rng(0).normal(size=(3, 11))
    again = load_run_policy(folder)
    np.testing.assert_array_equal(again.act(state), policy.act(state))
    with pytest.raises(ValueError, match=r"trust=\[absent\]"):
        load_run_policy(checkpoints_of(folder)[-1])
    assert "absent" not in sys.modules
    assert policy.record["source"]["data"]["path"] is None


LOSS = "loss=td3_bc"


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> list[Path]:
    """Two untrained runs with models, of a task with bounds of its own."""
    top, found = tmp_path_factory.mktemp("runs"), []
    for seed in range(2):
        torch.manual_seed(seed)
        make_run(folder := top / f"seed{seed}", LOSS, *BOUNDS)
        model = DynamicsEnsemble(11, 3, num_networks=2, num_elites=1, num_cells=[4])
        write_dynamics(folder / MODEL, model)
        found.append(folder)
    return found


def test_switching_uses_all_runs_policies_models_and_critics(folders) -> None:
    switching = load_switching_policy(folders, steps=1, hold=2)
    policies = [load_run_policy(folder) for folder in folders]
    state = torch.randn(6, 11)
    state[:, 0], state[:, 1] = 1.2 + 0.1 * state[:, 0].abs(), 0.0
    wanted = []
    for policy in policies:
        action, each = policy(state), []
        for folder, own in zip(folders, policies, strict=True):
            # Restated: the run's networks see standardised states and actions in 1.
            seen, half = (state - own.loc) / own.scale, (own.high - own.low) / 2
            unit = (action - (own.low + own.high) / 2) / half
            plain = load_dynamics(folder / MODEL)
            mean = plain.predict(seen, unit)[0][plain.elites[0]]
            after = state + mean[:, :-1] * own.scale
            values = [own.smallest_value(after, policy(after)) for own in policies]
            alive = ~switching.terminated(after)
            each.append(mean[:, -1] + 0.99 * alive * sum(values) / 2)
        wanted.append(sum(each) / 2)
    wanted = torch.stack(wanted, 1)
    torch.testing.assert_close(switching.returns(state), wanted)
    actions = torch.stack([policy(state) for policy in policies], 1)
    chosen = actions[torch.arange(6), wanted.argmax(1)]
    assert torch.equal(switching(state), chosen)
    switching.reset()
    torch.testing.assert_close(switching(state.double()), chosen)
    assert load_switching_policy(folders, gamma=0.5).gamma == 0.5
    alone = load_switching_policy(folders, critics_only=True)
    for column, policy in zip(alone.returns(state).T, policies, strict=True):
        values = [each.smallest_value(state, policy(state)) for each in policies]
        torch.testing.assert_close(column, sum(values) / 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["loss=bc"], "needs continuous actions and critics"),
        ([LOSS, "optim.gamma=0.9"], "differ in .*0.9, "),
        ([LOSS, "data.reward_scale=100"], "differ in .*100.0"),
        ([LOSS, "env=none", "data=file", "data.path=a.csv"], "differ in .*Hopper-v5"),
    ],
)
def test_runs_that_do_not_fit_together_are_refused(folders, tmp_path, options, message):
    make_run(tmp_path / "run", *options)
    with pytest.raises(ValueError, match=message):
        load_switching_policy([*folders, tmp_path / "run"])


def test_one_model_is_enough_and_none_is_refused(folders, tmp_path):
    make_run(tmp_path / "run", LOSS, *BOUNDS)
    switching = load_switching_policy([folders[0], tmp_path / "run"])
    assert len(switching.networks.weights[0]) == 1
    with pytest.raises(ValueError, match="None of the runs has a model"):
        load_switching_policy([tmp_path / "run"])
