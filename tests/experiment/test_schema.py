"""Every configuration composes, and whatever is mistyped stops by name."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException, MissingConfigException
from hydra.utils import get_class, instantiate
from omegaconf import OmegaConf

from torchrl_osr import Adversary, InverseDynamicsLoss
from torchrl_osr.data import LEVELS, load_behavior_card
from torchrl_osr.data.environment import MAZE_IDS
from torchrl_osr.data.mazes import MAZE_LEVELS
from torchrl_osr.data.sources import FILE_SOURCES
from torchrl_osr.experiment import loss_config
from torchrl_osr.experiment import schema as config

CONF = Path(__file__).parents[2] / "conf"
GROUPS = ["env", "data", "inverse_dynamics", "loss", "logger", "preset"]


@pytest.fixture(autouse=True)
def _hydra():
    config.register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


def composed(*overrides: str):
    return compose("offline_osr", overrides=list(overrides))


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@pytest.mark.parametrize(
    "override",
    [f"{group}={name}" for group in GROUPS for name in options(group)],
)
def test_every_option_composes_without_a_missing_value(override):
    cfg = composed(override)
    assert not OmegaConf.missing_keys(cfg)
    assert isinstance(OmegaConf.to_object(cfg), config.OfflineOSRConfig)


@pytest.mark.parametrize("name", options("experiment"))
def test_every_experiment_composes_and_sweeps_over_values_that_compose(name):
    raw = OmegaConf.load(CONF / "experiment" / f"{name}.yaml")
    assert not OmegaConf.missing_keys(composed(f"+experiment={name}"))
    for key, values in raw.hydra.sweeper.params.items():
        overrides = [f"{key}={value}" for value in str(values).split(",")]
        found = {str(composed(f"+experiment={name}", each)) for each in overrides}
        assert len(found) == len(overrides)


def test_groups_name_what_the_package_has():
    assert options("data") == sorted([*LEVELS, *MAZE_LEVELS, *FILE_SOURCES])
    assert options("env") == sorted([*load_behavior_card(), *MAZE_IDS])
    for name, env_id in MAZE_IDS.items():
        assert composed(f"env={name}").env == {"name": name, "id": env_id}
    for name, entry in load_behavior_card().items():
        assert composed(f"env={name}").env == {"name": name, "id": entry["env"]}


def test_presets_reach_the_values_and_the_command_line_wins():
    assert composed("preset=paper").trainer.steps == 1_000_000
    cfg = composed("preset=paper", "trainer.steps=7", "data=expert")
    assert cfg.trainer.steps == 7
    assert cfg.trainer.batch_size == 256
    assert cfg.data.level == "expert"


def test_cql_is_osr_without_recovery():
    osr, cql = composed().loss, composed("loss=cql").loss
    assert {key for key in osr if osr[key] != cql[key]} == {"recovery_weight"}
    assert cql.recovery_weight == 0


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("loss.recovery_wieght=1", "recovery_wieght"),
        ("trainer.steps=many", "many"),
        ("seed=first", "first"),
        ("network.num_cells=[wide]", "wide"),
        ("loss.fixed_alpha=perhaps", "perhaps"),
    ],
)
def test_mistyped_key_or_type_stops_by_name(override, named):
    with pytest.raises(ConfigCompositionException) as error:
        composed(override)
    assert named in f"{error.value} {error.value.__cause__}"


@pytest.mark.parametrize("group", GROUPS)
def test_unknown_option_lists_what_exists(group):
    with pytest.raises(MissingConfigException) as error:
        composed(f"{group}=nothing")
    for name in options(group):
        assert name in str(error.value)


@pytest.mark.parametrize("name", options("loss"))
def test_loss_config_is_the_loss_modules_vocabulary(name):
    cfg = OmegaConf.to_container(composed("preset=paper", f"loss={name}"), resolve=True)
    loss = cfg["loss"]
    keywords = inspect.signature(get_class(loss.pop("_target_")).__init__).parameters
    assert loss.keys() <= keywords.keys()
    if name in ("osr", "osr_v"):
        # The paper preset is the default of the class too: one set of numbers.
        assert loss == {key: keywords[key].default for key in loss}


@pytest.mark.parametrize("name", options("inverse_dynamics"))
def test_model_config_is_the_model_loss_modules_vocabulary(name):
    cfg = composed(f"inverse_dynamics={name}").inverse_dynamics
    model = instantiate(cfg.network, 3, 2, num_cells=[4])
    loss = InverseDynamicsLoss(model, **cfg.loss)
    assert (loss.states, loss.loss_function) == (
        cfg.loss.states,
        cfg.loss.loss_function,
    )


def test_adversary_of_the_configuration_is_the_class_default():
    assert instantiate(composed("loss=osr_adversarial").loss.adversary) == Adversary()


def test_official_preset_reaches_every_group_and_quick_sizes_stay_possible():
    cfg = composed("preset=official")
    assert cfg.loss == composed("loss=osr_official", "preset=paper").loss
    assert cfg.inverse_dynamics == composed("inverse_dynamics=cvae").inverse_dynamics
    assert (cfg.data.standardize, cfg.trainer.steps) == (False, 4_000_000)
    quick = composed("loss=osr_official", "inverse_dynamics=cvae")
    assert quick.loss.recovery_direction == "reverse"
    assert quick.trainer.steps == composed().trainer.steps


def test_antmaze_preset_is_corls_cql():
    cfg, paper = composed("preset=antmaze"), composed("preset=paper")
    # tinkoff-ai/CORL at 140648a, configs/offline/cql/antmaze/umaze_v2.yaml
    assert (cfg.data.reward_scale, cfg.data.reward_shift) == (10, -5)
    assert (cfg.loss.with_lagrange, cfg.loss.lagrange_thresh) == (True, 0.8)
    assert (cfg.loss.min_q_weight, cfg.loss.clip_diff_min) == (5, -200)
    assert (cfg.loss.max_q_backup, cfg.loss.deterministic_backup) == (True, True)
    assert (cfg.loss.num_random, cfg.loss.temperature) == (10, 1)
    assert (cfg.optim.actor_lr, cfg.optim.qvalue_lr) == (1e-4, 3e-4)
    assert (cfg.optim.gamma, cfg.optim.tau) == (0.99, 5e-3)
    assert (cfg.trainer.eval_episodes, cfg.trainer.steps) == (100, 1_000_000)
    assert (cfg.trainer.eval_interval, cfg.trainer.batch_size) == (50_000, 256)
    assert cfg.loss.clip_diff_max == float("inf")
    assert cfg.optim == paper.optim


def test_number_of_sampled_actions_is_the_presets_where_cqls_term_is():
    for name in options("loss"):
        number = composed(f"loss={name}").loss.num_random
        assert number == (1 if name == "osr_v" else composed().num_random)


def test_schema_documents_every_field():
    modules = (config, loss_config)
    schemas = {
        schema
        for module in modules
        for schema in vars(module).values()
        if inspect.isclass(schema) and schema.__module__ == module.__name__
    }
    for schema in schemas:
        own = set(schema.__annotations__) - {"_target_"}
        if schema is config.OfflineOSRConfig:
            own = {"seed", "num_random", "resume"}
        for name in own:
            assert f"{name}:" in schema.__doc__, f"{schema.__name__}.{name}"
