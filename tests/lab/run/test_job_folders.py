"""Names of a sweep's folders: short, unique, and never in need of quotes."""

from __future__ import annotations

import re

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st

from torchrl_osr.lab.run.schema import (
    MAX_FOLDER_NAME,
    job_folder,
    named_by_what_differs,
)


@given(st.integers(0, 10_000), st.text(max_size=300))
def test_no_name_needs_quotes_and_each_has_its_number(number, overrides):
    name = job_folder(number, overrides)
    assert re.fullmatch(r"\d+(_[A-Za-z0-9._-]+)?", name)
    assert len(name) <= MAX_FOLDER_NAME
    assert name.partition("_")[0] == str(number)
    # Hydra takes it as it stands, too.
    override = OverridesParser.create().parse_override(f"checkpoint=multirun/{name}")
    assert override.value() == f"multirun/{name}"


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        ("", "7"),
        ("loss=cql,seed=1", "7_loss-cql_seed-1"),
        ("perturbation.std=1e-3,seed=0", "7_std-1e-3_seed-0"),
        ("network.num_cells=[64,64]", "7_num_cells-64_64"),
        ("data.path=/a b/c.npz", "7_path-a-b-c.npz"),
    ],
)
def test_names_are_values_behind_their_keys(overrides, name):
    assert job_folder(7, overrides) == name


def test_only_what_differs_is_in_the_names():
    shared = ["env=hopper", "+experiment=ablation", "trainer.steps=5"]
    command = ["-m", *shared, "seed=0,1", "loss=choice(cql,osr)", "hydra.sweep.dir=x"]
    (override,) = named_by_what_differs(command)
    key, _, keys = override.partition("=")
    assert key == "hydra.job.config.override_dirname.exclude_keys"
    assert keys == "[env,experiment,trainer.steps]"
    assert named_by_what_differs(["seed=0"]) == []
