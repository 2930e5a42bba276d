"""The one door: rolled-out sets and their cache, recorded sets and their options."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import numpy as np
import pytest
from recorded_logs import make_columns, save

from torchrl_osr._files import read_tensors
from torchrl_osr.lab.data import load_dataset, sources, transitions_from_columns
from torchrl_osr.lab.data.statistics import REFERENCE_RETURNS

pytestmark = pytest.mark.usefixtures("cache")

COLLECT = "'torchrl-osr collect env.id=Pendulum-v1 path=Pendulum-v1.npz', then add"


def roll_out(source="random", **options):
    options = {"num_transitions": 300, "progress": False} | options
    return load_dataset("hopper", source, **options)


@pytest.fixture
def collections(monkeypatch):
    """Record each real collection."""
    collect = mock.Mock(wraps=sources.collect_source)
    monkeypatch.setattr(sources, "collect_source", collect)
    return collect


def test_a_set_is_collected_once(collections):
    with ThreadPoolExecutor(2) as pool:
        (first, manifest), _ = pool.map(lambda _: roll_out(), range(2))
    second, again = roll_out()
    assert collections.call_count == 1
    assert (first == second).all()
    assert manifest == again


def test_other_versions_make_the_set_anew(collections, monkeypatch):
    first, _ = roll_out()
    with monkeypatch.context() as patch:
        patch.setattr(sources, "version", lambda package: "1.0")
        second, manifest = roll_out()
    assert manifest["versions"]["numpy"] == "1.0"
    assert collections.call_count == 2
    assert (first == second).all()


def test_manifest_describes_the_set(cache):
    _, manifest = roll_out(seed=3)
    _, stored = read_tensors(cache / "collected/hopper-random-300-seed3.safetensors")
    assert stored.items() <= manifest.items()
    returns = np.array(manifest["episode_returns"])
    assert manifest["env_id"] == "Hopper-v5"
    assert manifest["mean_return"] == pytest.approx(returns.mean())
    # (mean - random) / (expert - random), the constants of D4RL.
    expected = 100 * (returns.mean() + 20.272305) / (3234.3 + 20.272305)
    assert manifest["normalized_score"] == pytest.approx(expected)
    assert set(manifest["versions"]) == {"numpy", "gymnasium", "mujoco"}


def test_a_mixture_has_exact_shares():
    request = {"num_transitions": 2000, "seed": 3}
    (valuable, about), (random, other) = (
        roll_out(name, **request) for name in ("medium", "random")
    )
    data, manifest = roll_out("medium", random_share=0.9, **request)
    for rows, source in ((data[:200], valuable), (data[200:], random)):
        known = {tuple(row.tolist()) for row in source["observation"]}
        assert all(tuple(row.tolist()) in known for row in rows["observation"])
    for name in ("mean_return", "normalized_score"):
        expected = 0.1 * about[name] + 0.9 * other[name]
        assert manifest[name] == pytest.approx(expected)
    assert manifest["checksum"] == about["checksum"] + other["checksum"]


def d4rl_columns(data):
    return {
        "observations": data["observation"],
        "actions": data["action"],
        "rewards": data["next", "reward"],
        "terminals": data["next", "terminated"],
        "timeouts": data["next", "truncated"],
        "next_observations": data["next", "observation"],
        "infos/qpos": np.zeros((len(data), 6)),  # which nobody reads
    }


@pytest.mark.parametrize("source", ["d4rl", "file"])
def test_recorded_data_are_read(source, tmp_path):
    rows, _ = roll_out("medium")
    path = str(save(tmp_path / "hopper.hdf5", d4rl_columns(rows)))
    data, manifest = load_dataset("hopper", source, env_id="Hopper-v5", path=path)
    assert (data == rows).all()
    score = REFERENCE_RETURNS["hopper"].score(manifest["mean_return"])
    assert (manifest["source"], manifest["normalized_score"]) == (source, score)
    _, other = load_dataset("another", source, path=path)
    assert other["normalized_score"] is None
    with pytest.raises(ValueError, match=r"11 observation and 3 .*Walker2d-v5 has 17"):
        load_dataset("walker2d", source, env_id="Walker2d-v5", path=path)


@pytest.mark.parametrize(("bounds", "high"), [(None, 2), ([[-4.0], [4.0]], 4)])
def test_bounds_come_from_the_environment_unless_given(tmp_path, bounds, high):
    columns = make_columns()
    columns["action"] = 2 * columns["action"][:, :1]
    path = save(tmp_path / "log.npz", columns)
    data, _ = load_dataset(path=path, env_id="Pendulum-v1", action_bounds=bounds)
    expected, _ = transitions_from_columns(columns, action_bounds=(-high, high))
    assert (data == expected).all()


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        ("minari", {}, r"data=minari needs data\.path="),
        ("file", {"num_transitions": 9}, "num_transitions=9 has no effect with data=f"),
        ("file", {"clip_actions": True, "env_id": "CartPole-v1", "path": "x"}, "discr"),
        ("medium", {"path": "x"}, "rolled out in a simulator: for a log, give data"),
        ("medium", {"env_name": "log-arm"}, "for a log, give data=file"),
        ("random", {"random_share": 0.5}, "random rows: choose another source"),
        ("d4rl", {"path": "x", "columns": {"reward": "x"}}, "columns=.* has no effect"),
        ("medium", {"env_id": "Pendulum-v1"}, COLLECT),
    ],
)
def test_useless_options_are_refused(source, options, message):
    with pytest.raises(ValueError, match=message):
        load_dataset(**{"env_name": "hopper", "source": source} | options)


def test_a_d4rl_file_without_ends_names_another_way(tmp_path):
    columns = d4rl_columns(roll_out()[0])
    columns["ends"] = columns.pop("timeouts")
    path = str(save(tmp_path / "hopper.hdf5", columns))
    with pytest.raises(ValueError, match=r"truncated .*name it with data\.columns\.tr"):
        load_dataset("hopper", "d4rl", path=path)
    assert len(load_dataset(path=path, columns={"truncated": "ends"})[0]) == 300
