"""A configuration of any origin is checked, and nothing in it is called by that."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import yaml
from composed import composed
from omegaconf import OmegaConf

from torchrl_osr.lab.run.config import (
    check_environment,
    check_targets,
    checked,
    read_config,
    read_run,
    write_config,
)


def test_configuration_is_written_and_read_back(tmp_path):
    config = checked(composed("train", "loss=rambo", "recovery=osr"))
    write_config(tmp_path, config)
    config.trust = []
    again = read_run(tmp_path)
    assert again == config


@pytest.mark.parametrize(
    "key", ["trainer.foo", "foo", "loss.recovery_wieght", "inverse_dynamics.loss.foo"]
)
def test_keys_that_were_added_are_refused(key):
    with pytest.raises(ValueError, match=f"there is no key {key}"):
        checked(composed("train", f"+{key}=1"))


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("trainer.steps", "many", "trainer.steps: Value 'many'"),
        ("loss._target_", "torchrl_osr.objectives", "is none of"),
        ("loss.recovery_weight", "x", "loss.recovery_weight: Value 'x'"),
        ("env.id", "???", "lacks env.id"),
        ("trainer.steps", 0, "trainer.steps must be at least 1, got 0"),
        (
            "data.held_out",
            float("nan"),
            "data.held_out must be between 0 and 1, got nan",
        ),
        ("optim.tau", 5.0, "optim.tau must be between 0 and 1, got 5"),
        ("seed", -1, "seed must be between 0"),
        ("data.storage", "tape", "data.storage must be one of memory, disk, got tape"),
    ],
)
def test_wrong_values_of_a_foreign_run_are_named(tmp_path, key, value, reason):
    write_config(tmp_path, checked(composed("train")))
    path = tmp_path / "config.yaml"
    cfg = OmegaConf.create(yaml.safe_load(path.read_text()))
    OmegaConf.update(cfg, key, value)
    OmegaConf.save(cfg, path)
    with pytest.raises(ValueError, match=rf"config\.yaml: .*{reason}"):
        read_run(tmp_path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: !!python/object/apply:os.system [x]", "is damaged: .*python/object"),
        ("a: [", "is damaged"),
        ("- a\n", "holds no mapping"),
        ("# " + "a" * 2**16, "more than 65,536 bytes"),
        ("seed: 1\n", "another version of torchrl-osr .format 1, this one reads 2"),
    ],
)
def test_damaged_and_old_configurations_are_refused(tmp_path, text, reason):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=reason):
        read_config(tmp_path)


@pytest.mark.parametrize(
    "target",
    ["os.mkdir", "torchrl_osr._files.os.mkdir", "torchrl_osr.load_policy", "mine.X", 3],
)
@pytest.mark.parametrize("place", ["top", "nested", "listed"])
def test_nothing_else_may_be_called(target, place):
    entry = {"_target_": target}
    loss = {"_target_": "torchrl_osr.OSRLoss", "a": {"b": [1, [entry]]}}
    config = {"top": {"loss": entry}, "nested": {"x": {"y": entry}}}
    with pytest.raises(ValueError, match="is none of"):
        check_targets(config.get(place, {"loss": loss}))


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module of the user's in the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path.copy())
    text = "from os import mkdir\ndef mine(): ...\ndef _hidden(): ...\n"
    (tmp_path / "my_module.py").write_text(text)
    yield tmp_path / "my_module.py"
    sys.modules.pop("my_module", None)


@pytest.mark.parametrize("name", ["mkdir", "_hidden", "absent"])
def test_only_what_a_trusted_module_defines_may_be_called(module, name):
    config = {"loss": {"_target_": "my_module.mine"}}
    with pytest.raises(ValueError, match=r"allow it with trust=\[my_module\]"):
        check_targets(config)
    assert "my_module" not in sys.modules
    check_targets(config, ["my_module"])
    with pytest.raises(ValueError, match="no public function or class"):
        check_targets({"loss": {"_target_": f"my_module.{name}"}}, ["my_module"])
    with pytest.raises(ValueError, match=r"trust=\[absent\] cannot be imported"):
        check_targets({}, ["absent"])


def test_an_environment_imports_only_trusted_modules():
    with pytest.raises(ValueError, match=r"allow it with trust=\[mine.evil\]"):
        check_environment("mine.evil:Hopper-v5")
    check_environment("mine.evil:Hopper-v5", ["mine.evil"])
    check_environment("Hopper-v5")


def test_no_file_of_the_current_folder_takes_the_place_of_a_library(module):
    (module.parent / "tabnanny.py").write_text("raise SystemExit('the wrong one')")
    sys.modules.pop("tabnanny", None)
    check_targets({}, ["my_module", "tabnanny"])
    assert Path(sys.modules["tabnanny"].__file__).parent != module.parent
