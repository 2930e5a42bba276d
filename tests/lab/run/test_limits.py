"""Every key of the configuration has values that stop a run before it begins."""

from __future__ import annotations

import pytest
from composed import CONF, composed
from omegaconf import OmegaConf

from torchrl_osr.lab.run.build import check_parts
from torchrl_osr.lab.run.limits import CHOICES, RANGES, check_networks
from torchrl_osr.lab.run.run_config import check_run, flatten

SIZES = 11, 3

# Any text will do, or what it has to be is known when the data are read.
FREE_WORDS = ("env", "data.source", "data.path", "logger.project", "resume", "trust")


@pytest.fixture(scope="module")
def fresh():
    cfg = composed("train", "perturbation=adversarial", "network.num_cells=[8]")
    plain = OmegaConf.to_container(cfg, resolve=True)
    return lambda: OmegaConf.create(plain)


def refused(cfg, key: str, value: object) -> str:
    """What a run says of a value, before it makes anything."""
    OmegaConf.update(cfg, key, value, merge=False)
    with pytest.raises(Exception) as caught:  # noqa: PT011 Hydra's, ours: read below
        check_parts(check_run(cfg), *SIZES)
    return str(caught.value)


def test_numbers_without_sense_are_refused_by_key(fresh):
    values = flatten(OmegaConf.to_container(fresh()))
    numbers = [
        key
        for key, value in values.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    ]
    assert len(numbers) > 35
    for key in numbers:
        wrong = 10**30 if isinstance(values[key], int) else float("nan")
        assert f"{key} must be between" in refused(fresh(), key, wrong)


def test_words_without_sense_are_refused_by_key(fresh):
    values = flatten(OmegaConf.to_container(fresh()))
    words = [
        key
        for key, value in values.items()
        if isinstance(value, str) and not key.startswith(FREE_WORDS)
    ]
    assert len(words) > 15
    for key in words:
        message = refused(fresh(), key, "nonsense")
        assert key.rpartition(".")[2] in message or "_target_" in key
        assert "nonsense" in message


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("data.num_transitions", 0),
        ("data.random_share", 1.5),
        ("data.reward_scale", 0.0),
        ("network.num_cells", [8, 0]),
        ("network.num_cells", [10_000_000]),
        ("optim.actor_lr", -1e-3),
        ("optim.tau", 2.0),
        ("trainer.batch_size", 0),
        ("trainer.eval_episodes", -1),
        ("trainer.num_threads", 0),
        ("loss.num_qvalue_nets", 10**6),
        ("loss.reduction", "none"),
        ("seed", -1),
    ],
)
def test_values_of_the_right_type_are_refused_by_key(fresh, key, value):
    assert refused(fresh(), key, value).startswith(f"{key} must be ")


def test_limits_are_of_keys_that_exist(fresh):
    known = flatten(OmegaConf.to_container(fresh())).keys()
    elsewhere = {"inverse_dynamics.network.latent_dim", "loss.num_samples"}
    elsewhere |= {"recovery.reduction", "suite.half"}
    for name in ("evaluate",):
        elsewhere |= OmegaConf.load(CONF / "evaluation" / f"{name}.yaml").keys()
    assert {*RANGES, *CHOICES} <= known | elsewhere


def test_networks_larger_than_the_memory_are_refused_before_they_are_made(fresh):
    cfg = fresh()
    cfg.network.num_cells = [60_000] * 8
    with pytest.raises(ValueError, match=r"need 1,\d+ GB \(25,\d+,\d+,\d+ parameters"):
        check_networks(cfg, *SIZES, training=True)
    cfg.network.num_cells = [256, 256]
    check_networks(cfg, *SIZES, training=True)


def test_a_whole_batch_counts(fresh):
    cfg = fresh()
    cfg.trainer.batch_size = 10**9
    check_networks(cfg, *SIZES)
    with pytest.raises(ValueError, match=r"trainer\.batch_size=1000000000 need"):
        check_networks(cfg, *SIZES, training=True)
