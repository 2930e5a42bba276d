"""OSR as an option of TorchRL's own configuration system, and the example with it."""

from __future__ import annotations

import copy
import inspect
import json

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.errors import ConfigCompositionException
from hydra.utils import instantiate
from objectives.losses import make_batch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from torchrl_osr import OSRLoss, OSRVLoss, StatePerturbation, configs
from torchrl_osr.lab.data import make_replay_buffer
from torchrl_osr.trainers import ReplayBufferCollector


@pytest.fixture(scope="module")
def _registered():
    """Options of the store, taken back for the tests of our own configuration."""
    Plugins.instance()  # They register options, too, when they are first asked for.
    store = ConfigStore.instance()
    before = copy.copy(store.repo)
    store.repo = copy.deepcopy(before)
    configs.register()
    yield
    store.repo = before


@pytest.fixture
def composed(tmp_path, _registered):
    """Return a function that composes options of the store, as a user's file does."""

    def call(*defaults: dict[str, str], overrides=(), **values):
        text = OmegaConf.to_yaml({"defaults": [*defaults, "_self_"], **values})
        (tmp_path / "user.yaml").write_text(text, encoding="utf-8")
        with initialize_config_dir(str(tmp_path), version_base="1.3"):
            return compose("user", list(overrides))

    return call


@pytest.mark.parametrize(("group", "name"), configs.OPTIONS)
def test_an_option_has_every_argument_with_its_default(composed, group, name) -> None:
    (found,) = composed({group: name}).values()
    part = configs.OPTIONS[group, name]
    for key, each in inspect.signature(part).parameters.items():
        if each.kind is each.VAR_KEYWORD:
            assert {"loss_function", "reduction"} <= found.keys()
        elif key in configs.GIVEN_IN_THE_CALL:
            assert found[key] is None
        elif each.default is each.empty:
            assert OmegaConf.is_missing(found, key)
        elif not isinstance(each.default, type):
            expected = each.default
            expected = list(expected) if isinstance(expected, tuple) else expected
            assert found[key] == expected


def test_a_mistyped_option_is_refused(composed) -> None:
    with pytest.raises(ConfigCompositionException, match="recovery_weihgt"):
        composed({"loss": "osr"}, overrides=["loss.recovery_weihgt=1.0"])


@pytest.mark.parametrize(("name", "kind"), [("osr", OSRLoss), ("osr_v", OSRVLoss)])
def test_a_loss_and_its_networks_from_a_file(composed, name, kind) -> None:
    sizes = {"observation_dim": 3, "action_dim": 2, "num_cells": [8]}
    keys = {"observation_key": ["agent", "obs"], "action_key": ["agent", "action"]}
    cfg = composed(
        {"loss": name},
        {"model@actor": "tanh_gaussian_actor"},
        {"model@critics": "critic_ensemble"},
        {"model@dynamics": "tanh_gaussian_inverse_dynamics"},
        {"transform": "state_perturbation"},
        {"replay_buffer": "tensordict"},
        {"storage@replay_buffer.storage": "lazy_tensor"},
        actor=sizes | keys,
        critics=sizes | keys,
        dynamics=sizes | keys,
        loss={"recovery_weight": 0.25, "gamma": 0.9},
        transform={"std": 0.1, "in_keys": [["agent", "obs"]]},
        replay_buffer={"batch_size": 4, "storage": {"max_size": 8}},
    )
    loss = instantiate(cfg.loss, _partial_=True)(
        actor_network=instantiate(cfg.actor),
        qvalue_network=instantiate(cfg.critics),
        inverse_dynamics_network=instantiate(cfg.dynamics),
    )
    assert type(loss) is kind
    assert float(loss.recovery_weight) == 0.25
    assert float(loss.value_estimator.gamma) == pytest.approx(0.9)
    loss.set_keys(action=("agent", "action"))
    SoftUpdate(loss, tau=0.1)
    buffer, transform = instantiate(cfg.replay_buffer), instantiate(cfg.transform)
    assert isinstance(buffer, TensorDictReplayBuffer)
    assert isinstance(transform, StatePerturbation)
    buffer.append_transform(transform)
    data = make_batch("osr", 8)
    for each in (data, data["next"]):
        each["agent"] = {"obs": each["observation"], "action": each["action"]}
    buffer.extend(data.exclude("observation", ("next", "observation")))
    assert loss(buffer.sample())["loss_actor"].isfinite()


def test_a_buffers_batches_are_a_collectors_frames() -> None:
    data = TensorDict({"row": torch.arange(50.0)}, [50])

    def make(seed: int = 7) -> ReplayBufferCollector:
        buffer = make_replay_buffer(data, batch_size=5, seed=0)
        collector = ReplayBufferCollector(buffer, total_frames=20)
        assert collector.set_seed(seed) == seed
        return collector

    whole, other = (torch.stack([b["row"] for b in make(seed)]) for seed in (7, 8))
    assert whole.shape == (4, 5)
    assert not torch.equal(whole, other)
    first, second = make(), make()
    draws = iter(first)
    assert torch.equal(torch.stack([next(draws)["row"] for _ in range(2)]), whole[:2])
    second.load_state_dict(first.state_dict())
    assert torch.equal(torch.stack([batch["row"] for batch in second]), whole[2:])


def test_the_example_trains_on_real_data(tmp_path, run) -> None:
    code, printed = run(
        tmp_path,
        "torchrl_trainer.py",
        *("data=random", "num_transitions=500", "steps=6", "batch_size=16"),
        *("inverse_dynamics_steps=4", "episodes=1", "trainer.progress_bar=false"),
        *("loss.recovery_weight=0.75", f"hydra.run.dir={tmp_path}"),
    )
    assert code == 0, printed
    assert "never trained" not in printed
    result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert result["steps"] == 6
    assert len(result["returns"]) == 1
    written = OmegaConf.load(tmp_path / ".hydra" / "config.yaml")
    assert written.loss.recovery_weight == 0.75
