"""Settings by data set: the same for all methods that share them, in one table.

``settings.csv`` has those of the six main data sets. A change here changes what methods
are compared by.
"""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from composed import composed, options
from omegaconf import DictConfig, OmegaConf

from torchrl_osr.lab.data.environment import known_ids

TABLE = Path(__file__).with_name("settings.csv")
KEYS = (
    *("loss.min_q_weight", "loss.num_random", "loss.recovery_weight"),
    "recovery.recovery_weight",
    *("optim.actor_lr", "optim.qvalue_lr", "optim.inverse_dynamics_lr"),
    *("dynamics.rollout_steps", "dynamics.penalty", "dynamics.adversarial_weight"),
)
"""Columns of the table. Those of ``dynamics`` are blank without a model."""

METHODS = options("loss")
ENVS = ("hopper", "walker2d", "halfcheetah")
DATA = [(env, f"medium-{kind}") for kind in ("expert", "replay") for env in ENVS]


def table() -> dict[tuple[str, str, str], dict[str, str]]:
    with TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {(row["method"], row["env"], row["source"]): row for row in rows}


def settings_of(config: DictConfig) -> dict[str, str]:
    """Return the values of ``KEYS``, blank where a method has no such key."""
    found = {key: OmegaConf.select(config, key) for key in KEYS}
    blank = () if config.dynamics.use else ("dynamics.",)
    return {
        key: "" if value is None or key.startswith(blank) else f"{value:g}"
        for key, value in found.items()
    }


@pytest.mark.parametrize("method", METHODS)
def test_every_method_has_the_settings_of_the_table(method):
    cfg, rows = composed("train", f"loss={method}"), table()
    assert {name for name, *_ in rows} == set(METHODS)
    for env, source in DATA:
        cfg.env.id, cfg.data.source = known_ids()[env], source
        row = rows[method, env, source]
        assert settings_of(cfg) == {key: row[key] for key in KEYS}, (env, source)
    cfg.data.source, cfg.data.random_share = "expert", 0.5
    # Half of the actions are nobody's.
    assert cfg.optim.actor_lr == 1e-3


def test_settings_are_those_of_the_task_not_of_the_group():
    given = ["loss=rebrac", "data=medium-expert", "env.id=Walker2d-v5"]
    assert composed("train", *given).loss.actor_bc_coef == 0.01
    given = ["loss=rebrac", "env=hopper", "data=d4rl", "data.path=a/hopper_expert-v2"]
    assert composed("train", *given).loss.actor_bc_coef == 0.1
    # Of data without a row they are the constructor's.
    assert composed("train", "loss=rorl", "env.id=Pendulum-v1").loss.num_samples == 20
