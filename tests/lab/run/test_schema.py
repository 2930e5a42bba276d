"""Every configuration composes."""

from __future__ import annotations

import inspect
from dataclasses import fields

import pytest
from composed import CONF, composed, options
from hydra.utils import get_class
from omegaconf import OmegaConf

from torchrl_osr.lab.data.behavior import load_behavior_card
from torchrl_osr.lab.data.environment import MAZE_IDS
from torchrl_osr.lab.data.mazes import maze_sources
from torchrl_osr.lab.data.rollout import BEHAVIORS
from torchrl_osr.lab.data.sources import RECORDED
from torchrl_osr.lab.run.config import checked
from torchrl_osr.lab.run.schema import LOSSES, TrainConfig, schema_of

# Environments are composed below, losses in test_build.py.
GROUPS = ("data", "inverse_dynamics", "dynamics", "recovery", "logger", "preset")


@pytest.mark.parametrize("group", GROUPS)
def test_every_option_of_a_group_composes(group):
    for name in options(group):
        given = [f"{group}={name}", *["dynamics.frame_skip=1"][: name == "grey_box"]]
        assert isinstance(checked(composed("train", *given)), TrainConfig)


@pytest.mark.parametrize("name", options("experiment"))
def test_every_experiment_sweeps_over_values_that_compose(name):
    raw, given = OmegaConf.load(CONF / f"experiment/{name}.yaml"), f"+experiment={name}"
    for key, values in raw.hydra.sweeper.params.items():
        overrides = [f"{key}={value}" for value in str(values).split(",")]
        found = {str(checked(composed("train", given, each))) for each in overrides}
        assert len(found) == len(overrides)


def test_groups_name_what_the_package_has():
    mazes = {source for name in MAZE_IDS for source in maze_sources(name)}
    assert options("data") == sorted([*BEHAVIORS, *mazes, *RECORDED])
    assert options("env") == sorted([*load_behavior_card(), *MAZE_IDS, "none"])
    ids = MAZE_IDS | {name: card["env"] for name, card in load_behavior_card().items()}
    for name, env_id in ids.items():
        env = checked(composed("train", f"env={name}")).env
        assert (env.name, env.id) == (name, env_id)


def test_an_id_alone_is_enough():
    for env_id, name in {
        "Pendulum-v1": "Pendulum-v1", "robots:ns/Arm-v0": "ns-Arm-v0",
        "Walker2d-v5": "walker2d", "AntMaze_UMaze-v4": "antmaze-umaze",
    }.items():  # fmt: skip
        assert composed("train", f"env.id={env_id}").env.name == name


@pytest.mark.parametrize("name", sorted(LOSSES))
def test_schema_has_the_names_and_defaults_of_the_constructor(name):
    schema = schema_of(LOSSES[name])
    defaults = {field.name: field.default for field in fields(schema)}
    assert get_class(defaults.pop("_target_")) is LOSSES[name]
    found = inspect.signature(LOSSES[name]).parameters
    for key, default in defaults.items():
        assert key not in found or found[key].default == default
    keywords = {
        key for key, each in found.items()
        if each.kind is each.KEYWORD_ONLY and key not in ("action_spec", "gamma")
    }  # fmt: skip
    assert keywords <= defaults.keys()
    # OmegaConf takes every default for a value of its field's type, and keeps it.
    structured = OmegaConf.structured(schema)
    assert {key: structured[key] for key in defaults} == defaults


def test_official_preset_is_the_released_code():
    cfg = composed("train", "preset=official")
    assert cfg.loss == composed("train", "loss=osr_official", "preset=paper").loss
    model = composed("train", "inverse_dynamics=cvae").inverse_dynamics
    assert cfg.inverse_dynamics == model
    assert (cfg.data.standardize, cfg.trainer.steps) == (False, 4_000_000)


def test_antmaze_preset_is_corls_cql():
    """tinkoff-ai/CORL at 140648a, configs/offline/cql/antmaze/umaze_v2.yaml."""
    cfg = composed("train", "preset=antmaze")
    assert (cfg.data.reward_scale, cfg.data.reward_shift) == (10, -5)
    assert cfg.loss.target_action_gap == 0.8
    assert (cfg.loss.min_q_weight, cfg.loss.clip_diff_min) == (5, -200)
    assert (cfg.loss.max_q_backup, cfg.loss.num_random) == (True, 10)
    assert (cfg.optim.actor_lr, cfg.optim.qvalue_lr) == (1e-4, 3e-4)
    assert (cfg.optim.gamma, cfg.optim.tau) == (0.99, 5e-3)
    assert (cfg.trainer.eval_episodes, cfg.trainer.steps) == (100, 1_000_000)


def test_a_sweeps_folder_is_named_by_its_overrides_within_bounds():
    raw = OmegaConf.to_container(OmegaConf.load(CONF / "train.yaml"))
    job = {"num": 3, "override_dirname": "loss=cql,data.path=/a/b c.csv," + "x" * 300}
    subdir = raw["hydra"]["sweep"]["subdir"]
    name = OmegaConf.create({"hydra": {"job": job}, "name": subdir}).name
    assert name.startswith("3_loss-cql-data.path-a-b-c.csv-x")
    assert len(name) < 255
