"""A trained run comes back as it was saved, or says why it does not."""

from __future__ import annotations

import zipfile

import pytest
import torch
from hydra.errors import InstantiationException
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch.optim.swa_utils import AveragedModel
from torchrl.checkpoint import CheckpointError, CheckpointRotation
from torchrl.envs import ObservationNorm
from untrained_run import make_run

from torchrl_osr.lab.envs import critics_of
from torchrl_osr.lab.evaluation import deterministic_policy
from torchrl_osr.lab.run.build import make_learner
from torchrl_osr.lab.run.trained_run import (
    CHECKPOINTS,
    checkpoints_of,
    load_trained,
    run_folder_of,
)
from torchrl_osr.trainers.checkpoints import safe_checkpoint


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    return folder, *make_run(folder)


@pytest.fixture
def rows() -> torch.Tensor:
    return torch.randn(6, 11)


def test_the_policy_and_the_critics_are_those_that_were_saved(run, rows):
    folder, policy, loss = run
    before = torch.get_rng_state()
    trained = load_trained(folder)
    assert torch.equal(before, torch.get_rng_state())
    again = deterministic_policy(trained.actor, trained.observation_norm)
    assert torch.equal(again(rows), policy(rows))
    assert trained.config.network.num_cells == [8]
    assert trained.folder == folder
    states = TensorDict({"observation": rows}, [6])
    there, here = (
        critics_of(each)(states, policy(rows)) for each in (loss, trained.loss)
    )
    assert torch.equal(there, here)


def test_the_inverse_dynamics_model_is_the_one_that_was_saved(run, rows):
    folder, _, loss = run
    states = {"observation": rows, "next": {"observation": rows + 1}}
    batch = TensorDict(states, [6])
    with loss.inverse_dynamics_network_params.to_module(
        loss.inverse_dynamics_network, preserve_module_state=False
    ):
        saved = loss.inverse_dynamics_network.get_dist(batch.copy())
    loaded = load_trained(folder).inverse_dynamics.get_dist(batch)
    assert torch.equal(saved.deterministic_sample, loaded.deterministic_sample)


def test_kept_checkpoints_come_oldest_first(run):
    folder, *_ = run
    files = checkpoints_of(folder)
    assert [load_trained(file).step for file in files] == [10, 900]
    assert load_trained(folder).path == files[-1]
    best = folder / CHECKPOINTS / "best.torchrl"
    assert load_trained(best).step == 10
    assert run_folder_of(best) == folder


def test_runs_without_standardisation_come_back(tmp_path, rows):
    folder = tmp_path / "run"
    make_run(folder, "data.standardize=false")
    with pytest.raises(CheckpointError, match=r"loc is \(11,\) in the file, \(\) here"):
        load_trained(folder)
    cfg = OmegaConf.load(folder / "config.yaml")
    actor, _, loss, _ = make_learner(cfg, 11, 3)
    norm = ObservationNorm(0.0, 1.0, in_keys=["observation"], standard_normal=True)
    checkpoint = safe_checkpoint(
        loss_module=loss,
        observation_norm=norm,
        policy_average=AveragedModel(actor),
    )
    CheckpointRotation(folder / CHECKPOINTS, keep_last=2).save(checkpoint, step=1000)
    trained = load_trained(folder)
    policy = deterministic_policy(trained.actor, trained.observation_norm)
    torch.testing.assert_close(policy(rows), deterministic_policy(trained.actor)(rows))


@pytest.mark.parametrize(
    ("key", "value", "shapes"),
    [
        ("env.id", "HalfCheetah-v5", [r"\(8, 11\)", r"\(8, 17\)"]),
        ("network.num_cells", [9], [r"\(8, 11\)", r"\(9, 11\)"]),
    ],
)
def test_another_environment_or_size_is_refused(tmp_path, key, value, shapes):
    folder = tmp_path / "run"
    make_run(folder)
    cfg = OmegaConf.load(folder / "config.yaml")
    OmegaConf.update(cfg, key, value)
    OmegaConf.save(cfg, folder / "config.yaml")
    wanted = rf"does not fit .*config\.yaml.* is {shapes[0]} in the file, {shapes[1]}"
    with pytest.raises(CheckpointError, match=wanted):
        load_trained(folder)


def test_a_run_of_somebody_else_calls_nothing_of_theirs(tmp_path):
    folder, marker = tmp_path / "run", tmp_path / "marker"
    make_run(folder)
    cfg = OmegaConf.load(folder / "config.yaml")
    crafted = {"_target_": "os.mkdir", "path": str(marker)}
    OmegaConf.update(cfg, "inverse_dynamics.network.more", crafted, force_add=True)
    OmegaConf.save(cfg, folder / "config.yaml")
    with pytest.raises(ValueError, match=r"'os\.mkdir' called, which is none of"):
        load_trained(folder)
    assert not marker.exists()
    with pytest.raises(InstantiationException):
        make_learner(cfg, 11, 3)
    assert marker.exists(), "the crafted configuration works"


def test_damage_is_found(tmp_path):
    folder = tmp_path / "run"
    make_run(folder)
    path = checkpoints_of(folder)[-1]
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        (member,) = (m for m in archive.infolist() if "loss_module" in m.filename)
    content[member.header_offset + 400] ^= 1
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"damaged: .*loss_module"):
        load_trained(folder)
    path.write_bytes(content[:500])
    with pytest.raises(CheckpointError, match="damaged: File is not a zip file"):
        load_trained(path)


def test_no_run_and_no_checkpoint_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*nowhere"):
        load_trained(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"no config\.yaml in"):
        load_trained(tmp_path)
    (tmp_path / "config.yaml").touch()
    with pytest.raises(FileNotFoundError, match="has no checkpoint of its policy"):
        checkpoints_of(tmp_path)


def test_the_policy_is_the_average_of_its_weights(tmp_path):
    make_run(tmp_path / "run")
    folder = tmp_path / "run"
    actor, _, loss, _ = make_learner(OmegaConf.load(folder / "config.yaml"), 11, 3)
    average = AveragedModel(actor)
    for parameter in average.parameters():
        parameter.data.add_(1.0)
    checkpoint = safe_checkpoint(
        loss_module=loss,
        observation_norm=load_trained(folder).observation_norm,
        policy_average=average,
    )
    CheckpointRotation(folder / CHECKPOINTS, keep_last=2).save(checkpoint, step=1000)
    trained = load_trained(folder)
    for holder in (trained.actor, trained.loss.actor_network_params):
        pairs = zip(holder.parameters(), average.parameters(), strict=True)
        assert all(torch.equal(*pair) for pair in pairs)
