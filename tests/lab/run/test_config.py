"""A configuration of any origin is checked, and nothing in it is called by that."""

from __future__ import annotations

import sys

import pytest
from composed import composed
from omegaconf import OmegaConf

from torchrl_osr.lab.run.config import (
    check_environment,
    check_targets,
    checked,
    read_run,
    write_config,
)


def test_configuration_is_written_and_read_back(tmp_path):
    config = checked(composed("train", "loss=rambo", "recovery=osr"))
    write_config(tmp_path, config)
    config.trust = []
    assert read_run(tmp_path) == config


@pytest.mark.parametrize("key", ["trainer.foo", "foo"])
def test_keys_that_were_added_are_refused(key):
    with pytest.raises(ValueError, match=f"{key}: Key 'foo' not in"):
        checked(composed("train", f"+{key}=1"))


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("trainer.steps", "many", "trainer.steps: Value 'many'"),
        ("loss._target_", "torchrl_osr.objectives", "is no public name of"),
        ("env.id", "???", "lacks env.id"),
        ("trainer.steps", 0, "trainer.steps must be at least 1, got 0"),
        (
            *("optim.actor_lr", -1e-3),
            "optim.actor_lr must be finite and at least 0, got -0.001",
        ),
        ("dynamics.penalty", -1.0, "dynamics.penalty must be finite and at least 0"),
        ("data.reward_scale", 0.0, "data.reward_scale must not be 0"),
        ("data.seed", -1, "data.seed must be at least 0, got -1"),
        ("optim.policy_delay", 0, "optim.policy_delay must be at least 1, got 0"),
        ("data.held_out", float("nan"), "data.held_out must be between 0 and 1"),
        ("optim.tau", 5.0, "optim.tau must be between 0 and 1, got 5"),
        ("logger.kind", "tape", "logger.kind must be one of .*'csv', .*, got 'tape'"),
        ("seed", "${by_data:loss.x}", "has an interpolation: no run"),
        ("env.id", r"\${oc.create:{_target_:os.system}}", "an interpolation: no run"),
        ("format", 1, r"another version of torchrl-osr \(format 1, this one reads 2"),
    ],
)
def test_wrong_values_of_a_foreign_run_are_named(tmp_path, key, value, reason):
    write_config(tmp_path, checked(composed("train")))
    cfg = OmegaConf.load(path := tmp_path / "config.yaml")
    OmegaConf.update(cfg, key, value)
    OmegaConf.save(cfg, path)
    with pytest.raises(ValueError, match=reason):
        read_run(tmp_path)


def test_a_download_is_allowed_for_one_start(tmp_path):
    write_config(tmp_path, checked(composed("train", "data.download=true")))
    assert read_run(tmp_path).data.download is False


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: !!python/object/apply:os.system [x]", "python/object"),
        ("a: [", "while parsing"),
        ("- a\n", "it holds no mapping"),
    ],
)
def test_a_damaged_configuration_is_refused(tmp_path, text, reason):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=rf"config\.yaml is damaged: .*{reason}"):
        read_run(tmp_path)


@pytest.mark.parametrize(
    "target",
    ["os.mkdir", "torchrl_osr._files.os.mkdir", "torchrl_osr.load_policy", "mine.X", 3],
)
def test_nothing_else_may_be_called(target):
    entry = {"_target_": target}
    loss = {"_target_": "torchrl_osr.OSRLoss", "a": {"b": [1, [entry]]}}
    for config in ({"loss": entry}, {"x": {"y": entry}}, {"loss": loss}):
        with pytest.raises(ValueError, match="is no public name of"):
            check_targets(config)


def test_only_what_a_trusted_module_defines_may_be_called(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    text = "from os import mkdir\ndef mine(): ...\ndef _hidden(): ...\n"
    (tmp_path / "my_module.py").write_text(text)
    config = {"loss": {"_target_": "my_module.mine"}}
    with pytest.raises(ValueError, match=r"allow it with trust=\[my_module\]"):
        check_targets(config)
    assert "my_module" not in sys.modules
    check_targets(config, ["my_module"])
    for name in ("mkdir", "_hidden", "absent"):
        with pytest.raises(ValueError, match="is no public name of"):
            check_targets({"loss": {"_target_": f"my_module.{name}"}}, ["my_module"])
    with pytest.raises(ValueError, match=r"trust=\[absent\] cannot be imported"):
        check_targets({}, ["absent"])
    del sys.modules["my_module"]


def test_an_environment_imports_only_trusted_modules():
    with pytest.raises(ValueError, match=r"allow it with trust=\[mine.evil\]"):
        check_environment("mine.evil:Hopper-v5")
    check_environment("mine.evil:Hopper-v5", ["mine.evil"])
    check_environment("Hopper-v5")
