"""The configuration of somebody else's run: read, and nothing of theirs is called."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest
from composed import composed
from omegaconf import OmegaConf

from torchrl_osr.lab.run.run_config import (
    check_run,
    check_targets,
    read_config,
    read_run,
    read_yaml,
)


@pytest.mark.parametrize(
    "key", ["trainer.foo", "foo", "loss.recovery_wieght", "inverse_dynamics.loss.foo"]
)
def test_keys_that_were_added_are_refused(key):
    with pytest.raises(ValueError, match=f"there is no key {key}: docs"):
        check_run(composed("train", f"+{key}=1"))


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("trainer.steps", "many", "'many' of type 'str' could not be converted"),
        ("trainer", 3, "int is not a subclass"),
        ("seed", [1], "could not be converted to Integer"),
        ("loss", 3, "loss must have options and a _target_, got 3"),
        ("loss._target_", "torchrl_osr.objectives", "is none of"),
        ("perturbation.adversary", "yes", "must have options and a _target_"),
        ("perturbation.adversary", {}, "must have options and a _target_"),
        ("inverse_dynamics", [1], "inverse_dynamics.loss must have options"),
        ("env.id", "???", "it lacks env.id"),
        ("data.held_out", float("nan"), "held_out must be between 0 and 1, got nan"),
    ],
)
def test_what_is_wrong_with_somebodys_run_is_named(tmp_path, key, value, reason):
    cfg = OmegaConf.create(OmegaConf.to_container(composed("train"), resolve=True))
    OmegaConf.update(cfg, key, value, merge=False)
    OmegaConf.save(cfg, tmp_path / "config.yaml")
    with pytest.raises(ValueError, match=rf"config\.yaml: .*{reason}"):
        read_run(tmp_path / "config.yaml")


@pytest.mark.parametrize(
    "target",
    [
        "os.mkdir",
        "torchrl_osr._files.os.mkdir",
        "torchrl_osr.lab.data.load_dataset",
        "torchrl_osr.load_policy",  # it takes a path, and modules to be trusted
        "torchrl_osr",
        "mine.Loss",
        "",
        3,
    ],
)
@pytest.mark.parametrize("place", ["loss", "loss.adversary", "loss.more"])
def test_nothing_else_may_be_called(target, place):
    cfg = OmegaConf.create({"loss": {"_target_": "torchrl_osr.OSRLoss", "more": [{}]}})
    entry = {"_target_": target}
    value = [entry] if place == "loss.more" else entry
    OmegaConf.update(cfg, place, value, force_add=True)
    with pytest.raises(ValueError, match=r"has .* called, which is none of"):
        check_targets(cfg)


def test_no_module_is_imported_for_an_environment():
    cfg = OmegaConf.create({"env": {"id": "mine.evil:Hopper-v5"}})
    with pytest.raises(ValueError, match=r"mine\.evil:Hopper-v5 imports a module"):
        check_targets(cfg)


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module of the user's in the current folder, and what importing it leaves."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path.copy())
    text = "from os import mkdir\ndef mine(): ...\ndef _hidden(): ...\n"
    (tmp_path / "my_module.py").write_text(text)
    yield tmp_path / "my_module.py"
    sys.modules.pop("my_module", None)


@pytest.mark.parametrize("name", ["mkdir", "_hidden", "absent", "os.mkdir"])
def test_what_a_trusted_module_defines_may_be_called(module, name):
    cfg = OmegaConf.create({"loss": {"_target_": "my_module.mine"}})
    with pytest.raises(ValueError, match=r"allow it with trust=\[my_module\]"):
        check_targets(cfg)
    assert "my_module" not in sys.modules
    check_targets(cfg, ["my_module"])
    cfg.loss._target_ = f"my_module.{name}"
    with pytest.raises(ValueError, match="is none of .*, my_module: a run"):
        check_targets(cfg, ["my_module"])


def test_a_trusted_module_says_itself_what_it_offers(module):
    module.write_text("from os import mkdir\n__all__ = ['mkdir']\ndef mine(): ...\n")
    cfg = OmegaConf.create({"loss": {"_target_": "my_module.mkdir"}})
    check_targets(cfg, ["my_module"])
    cfg.loss._target_ = "my_module.mine"
    with pytest.raises(ValueError, match="no public function or class 'mine'"):
        check_targets(cfg, ["my_module"])


def test_a_trusted_module_may_bring_the_environment(module):
    cfg = OmegaConf.create({"env": {"id": "my_module:Robot-v0"}})
    with pytest.raises(ValueError, match=r"allow it with trust=\[my_module\]"):
        check_targets(cfg)
    check_targets(cfg, ["my_module"])
    with pytest.raises(ValueError, match=r"trust=\[absent\] cannot be imported"):
        check_targets(cfg, ["absent"])


def test_no_file_of_the_current_folder_takes_the_place_of_a_library(module):
    (module.parent / "tabnanny.py").write_text("raise SystemExit('the wrong one')")
    sys.modules.pop("tabnanny", None)
    check_targets(OmegaConf.create({}), ["my_module", "tabnanny"])
    assert Path(sys.modules["tabnanny"].__file__).parent != module.parent


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: &a [1, 1]\nb: [*a, *a]\n", "tags or aliases"),
        ("a: !!int ''", "tags or aliases"),
        ("a: !!python/object/apply:os.system [x]", "tags or aliases"),
        ("loss: '${oc.create:\"{_target_: os.mkdir}\"}'", "has the interpolation"),
        ('loss: "\\x24{oc.env:HOME}"', "has the interpolation"),
        ("- a\n", "holds no mapping"),
        ("1", "holds a single value"),
        ("# " + "a" * 2**16, "more than 65,536 bytes"),
    ],
)
def test_what_no_run_writes_is_refused(tmp_path, text, reason):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=reason):
        read_config(path)


@pytest.mark.parametrize("length", [400, 40_000])
@pytest.mark.parametrize("opening", ["[", "{a: ", "- "])
def test_deep_nesting_is_refused_at_once(tmp_path, opening, length):
    path = tmp_path / "config.yaml"
    depth = length // 2 // len(opening)
    path.write_text(
        "a:\n " + opening * depth + {"[": "]", "{a: ": "}"}.get(opening, "") * depth
    )
    start = time.process_time()
    with pytest.raises(ValueError, match=r"config\.yaml is nested more than 32 deep"):
        read_config(path)
    assert time.process_time() - start < 1
    shallow = tmp_path / "shallow.yaml"
    shallow.write_text("a: " + "[" * 31 + "]" * 31)
    read_config(shallow)


def test_overrides_are_read_as_they_were_typed(tmp_path):
    path = tmp_path / "overrides.yaml"
    path.write_text("- seed=1\n- data.path=${oc.env:HOME}\n")
    assert read_yaml(path) == ["seed=1", "data.path=${oc.env:HOME}"]
    assert os.environ.get("HOME", "") not in read_yaml(path)
