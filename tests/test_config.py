"""Every configuration composes, and whatever is mistyped stops by name."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException, MissingConfigException
from omegaconf import OmegaConf

from torchrl_osr import OSRLoss, config
from torchrl_osr.data import LEVELS, load_behavior_card

CONF = Path(__file__).parents[1] / "conf"


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
    [
        f"{group}={name}"
        for group in ("env", "data", "loss", "logger", "preset")
        for name in options(group)
    ],
)
def test_every_option_composes_without_a_missing_value(override):
    cfg = composed(override)
    assert not OmegaConf.missing_keys(cfg)
    assert isinstance(OmegaConf.to_object(cfg), config.OfflineOSRConfig)


def test_groups_name_what_the_package_has():
    assert options("data") == sorted(LEVELS)
    assert options("env") == sorted(load_behavior_card())
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


@pytest.mark.parametrize("group", ["env", "data", "loss", "logger", "preset"])
def test_unknown_option_lists_what_exists(group):
    with pytest.raises(MissingConfigException) as error:
        composed(f"{group}=nothing")
    for name in options(group):
        assert name in str(error.value)


def test_loss_config_is_the_loss_modules_vocabulary():
    keywords = inspect.signature(OSRLoss.__init__).parameters
    cfg = OmegaConf.to_container(composed("preset=paper").loss)
    for name, value in cfg.items():
        # The paper preset is the default of the class too: one set of numbers.
        assert keywords[name].default == value, name


def test_schema_documents_every_field():
    for schema in vars(config).values():
        if inspect.isclass(schema) and schema.__module__ == config.__name__:
            own = schema.__dataclass_fields__
            if schema is config.OfflineOSRConfig:
                own = {"seed", "resume"}
            for name in own:
                assert f"{name}:" in schema.__doc__, f"{schema.__name__}.{name}"
