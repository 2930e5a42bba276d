"""Settings by data set: the same for all methods that share them, in one table.

``settings.csv`` is what ``torchrl-osr settings`` prints for the six main data sets. A
change here changes what methods are compared by.
"""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from composed import composed

from torchrl_osr.lab.cli.settings import KEYS, main, methods, settings_of
from torchrl_osr.lab.data.environment import environment_id

TABLE = Path(__file__).with_name("settings.csv")
DATA = [
    (env, source)
    for source in ("medium-expert", "medium-replay")
    for env in ("hopper", "walker2d", "halfcheetah")
]


def table() -> dict[tuple[str, str, str], dict[str, str]]:
    with TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {(row["method"], row["env"], row["source"]): row for row in rows}


@pytest.mark.parametrize("method", methods())
def test_every_method_has_the_settings_of_the_table(method):
    cfg, rows = composed("train", f"loss={method}"), table()
    assert {name for name, *_ in rows} == set(methods())
    for env, source in DATA:
        cfg.env.id, cfg.data.source = environment_id(env), source
        row = rows[method, env, source]
        assert settings_of(cfg) == {key: row[key] for key in KEYS}, (env, source)


def test_settings_are_those_of_the_task_not_of_the_group():
    given = ["loss=rebrac", "data=medium-expert", "env.id=Walker2d-v5"]
    assert composed("train", *given).loss.actor_bc_coef == 0.01
    # Of data without a row they are the constructor's.
    assert composed("train", "loss=rorl", "env.id=Pendulum-v1").loss.num_samples == 20


def test_the_command_prints_a_row_for_each_method(capsys, monkeypatch):
    given = ["settings", "env=hopper", "data=medium-expert", "loss=osr,iql"]
    monkeypatch.setattr("sys.argv", given)
    main()
    head, osr, iql = (line.split() for line in capsys.readouterr().out.splitlines())
    assert head[:3] == ["method", "min_q_weight", "num_random"]
    assert osr[:3] == ["osr", "20", "4"]
    assert iql == ["iql", "0.0003", "0.001", "0.001"]
