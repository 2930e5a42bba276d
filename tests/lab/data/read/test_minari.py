"""Minari sets: read as Minari itself gives them, and written so that it reads ours."""

from __future__ import annotations

import json
import os
from contextlib import suppress

import minari
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer

from torchrl_osr.lab.data import (
    check_dataset,
    export_minari,
    load_local_dataset,
    load_minari,
    mix_datasets,
    transitions_from_rows,
)

# Minari asks for an author's address, and more, whenever a set is made.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")

FORMATS = ["hdf5", "arrow", "parquet"]
LENGTHS = [5, 1, 12, 3, 2, 4, 1, 2, 3, 6, 2, 5]  # more than ten: 10 sorts before 2

VECTOR = spaces.Box(-np.inf, np.inf, (3,))
NESTED = spaces.Dict(
    {
        "observation": spaces.Box(-np.inf, np.inf, (2,)),
        "desired_goal": spaces.Box(-10, 10, (2, 2), np.float32),
        "achieved": spaces.Dict(
            {"speed": spaces.Box(-1, 1, (), np.float32), "place": VECTOR}
        ),
    }
)
UNIT = spaces.Box(-1, 1, (2,))


@pytest.fixture(autouse=True)
def _home(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def stacked(space, rows):
    if isinstance(space, spaces.Dict):
        return {key: stacked(space[key], [row[key] for row in rows]) for key in space}
    return np.stack(rows)


def make(name, observations=VECTOR, actions=UNIT, data_format="hdf5", **buffer):
    observations.seed(0)
    actions.seed(0)
    buffers = []
    for number, steps in enumerate(LENGTHS):
        fell = number % 3 == 0
        end = np.arange(steps) == steps - 1
        columns = {
            "observations": stacked(
                observations, [observations.sample() for _ in range(steps + 1)]
            ),
            "actions": np.stack([actions.sample() for _ in range(steps)]),
            "rewards": np.random.default_rng(number).normal(size=steps),
            "terminations": end & fell,
            "truncations": end & (not fell),
        }
        buffers.append(EpisodeBuffer(**(columns | buffer)))
    return minari.create_dataset_from_buffers(
        name,
        buffers,
        observation_space=observations,
        action_space=actions,
        data_format=data_format,
    )


@pytest.mark.parametrize("data_format", FORMATS)
@pytest.mark.parametrize("space", [VECTOR, NESTED], ids=["vector", "dictionary"])
def test_every_row_is_minaris_own(space, data_format):
    made = make("test/set-v0", space, data_format=data_format)
    data, manifest = load_minari("test/set-v0")
    check_dataset(data)
    episodes = [*minari.load_dataset("test/set-v0").iterate_episodes()]
    states = [flat(space, each.observations, len(each) + 1) for each in episodes]
    columns = {
        "observation": [each[:-1] for each in states],
        ("next", "observation"): [each[1:] for each in states],
        "action": [each.actions.clip(-0.999, 0.999) for each in episodes],
        ("next", "reward"): [each.rewards[:, None] for each in episodes],
        ("next", "terminated"): [each.terminations[:, None] for each in episodes],
        ("next", "truncated"): [each.truncations[:, None] for each in episodes],
    }
    for key, parts in columns.items():
        column = data[key].numpy()
        assert np.array_equal(column, np.concatenate(parts).astype(column.dtype))
    assert manifest["episode_lengths"] == LENGTHS
    assert manifest["dropped_rows"] == 0
    again, _ = load_minari(made.storage.data_path.parent)
    assert (again == data).all()


def flat(space, observations, steps):
    def at(node, step):
        if isinstance(node, dict):
            return {key: at(value, step) for key, value in node.items()}
        return node[step]

    return np.stack([spaces.flatten(space, at(observations, t)) for t in range(steps)])


def test_entries_of_a_dictionary_can_be_chosen():
    make("test/set-v0", NESTED)
    everything, manifest = load_minari("test/set-v0")
    sizes = dict(map(tuple, manifest["observation_layout"]))
    assert [*sizes.items()] == [
        ("achieved/place", 3),
        ("achieved/speed", 1),
        ("desired_goal", 4),
        ("observation", 2),
    ]
    parts = dict(
        zip(sizes, everything["observation"].split([*sizes.values()], 1), strict=True)
    )
    keys = ["observation", "achieved/speed"]
    data, _ = load_minari("test/set-v0", observation_keys=keys)
    assert data["observation"].equal(torch.cat([parts[key] for key in keys], 1))
    for wrong in (["achieved"], [], "observation"):
        with pytest.raises(ValueError, match=r"expected some of achieved/place, "):
            load_minari("test/set-v0", observation_keys=wrong)


def test_the_action_space_is_mapped_to_the_unit_box():
    made = make("test/set-v0", actions=spaces.Box(np.float32(-4), np.float32(0), (2,)))
    data, manifest = load_minari("test/set-v0")
    raw = np.concatenate([e.actions for e in made.iterate_episodes()])
    expected = ((raw.astype(float) + 4) / 4 * 2 - 1).clip(-0.999, 0.999)
    assert np.array_equal(data["action"], expected.astype(np.float32))
    assert manifest["action_bounds"] == [[-4, -4], [0, 0]]


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({"actions": spaces.Discrete(3)}, "Discrete actions are not supported"),
        ({"actions": spaces.MultiBinary(3)}, "expected a Box"),
        ({"observations": spaces.Discrete(3)}, r"Discrete\(3\); expected a Box, or a"),
        ({"observations": spaces.Dict(a=spaces.MultiBinary(2))}, "observation a is"),
        ({"observations": spaces.Box(0, 255, (4, 4), np.uint8)}, "is an image"),
        ({"actions": VECTOR}, r"action bounds \[-inf.*action_bounds="),
    ],
)
def test_other_spaces_are_refused(space, message):
    make("test/set-v0", **space)
    with pytest.raises(ValueError, match=message):
        load_minari("test/set-v0")


def test_nothing_is_fetched_unless_it_is_said(monkeypatch):
    asked = []

    def fetch(name):
        asked.append(name)
        make(name)

    monkeypatch.setattr(minari.storage.hosting, "download_dataset", fetch)
    with pytest.raises(FileNotFoundError, match=r"'test/far-v0' is not .*download="):
        load_minari("test/far-v0")
    assert asked == []

    def fail(name):
        raise ConnectionError("no route to host")

    with monkeypatch.context() as patch:
        patch.setattr(minari.storage.hosting, "download_dataset", fail)
        with pytest.raises(OSError, match="far-v0' cannot be downloaded .*no route"):
            load_minari("test/far-v0", download=True)
    data, _ = load_minari("test/far-v0", download=True)
    assert (asked, len(data)) == (["test/far-v0"], sum(LENGTHS))
    load_minari("test/far-v0", download=True)
    assert asked == ["test/far-v0"]


def test_the_environment_of_the_metadata_is_not_made(tmp_path):
    """Minari asks it for spaces that are missing; it can be any function."""
    make("test/crafted-v0")
    marker = tmp_path / "marker"
    spec = EnvSpec("Crafted-v0", entry_point="os:mkdir", kwargs={"path": str(marker)})
    folder = tmp_path / "minari" / "test" / "crafted-v0" / "data"
    path = folder / "metadata.json"
    sound = json.loads(path.read_text())
    crafted = sound | {"env_spec": spec.to_json()}
    del crafted["action_space"]
    path.write_text(json.dumps(crafted))
    with pytest.raises(ValueError, match=r"its metadata\.json has no action_space"):
        load_minari("test/crafted-v0")
    assert not marker.exists()
    with suppress(Exception):  # what it makes is no environment
        minari.load_dataset("test/crafted-v0")
    assert marker.exists(), "the crafted metadata works"
    path.write_text(json.dumps(sound))
    os.truncate(path, 10**9)
    with pytest.raises(ValueError, match="has more than 268,435,456 bytes"):
        load_minari("test/crafted-v0")


def damage_metadata(folder):
    path = folder / "metadata.json"
    content = json.loads(path.read_text()) | {"total_steps": sum(LENGTHS) + 1}
    path.write_text(json.dumps(content))


def damage_data(folder):
    content = (folder / "main_data.hdf5").read_bytes()
    (folder / "main_data.hdf5").write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize(
    "damage",
    [
        damage_metadata,
        damage_data,
        lambda folder: (folder / "main_data.hdf5").unlink(),
        lambda folder: (folder / "metadata.json").write_text("{"),
        lambda folder: (folder / "metadata.json").write_text("{}"),
    ],
)
def test_a_damaged_set_is_an_error_that_says_what_to_do(damage):
    damage(make("test/set-v0").storage.data_path)
    with pytest.raises(
        ValueError, match=r"Minari cannot read test/set-v0 .*Put a whole copy"
    ):
        load_minari("test/set-v0")


def test_unequal_columns_of_an_episode_name_it():
    make("test/set-v0", actions=UNIT, rewards=np.ones(3))
    with pytest.raises(ValueError, match=r"Minari cannot read|episode 0 has shapes"):
        load_minari("test/set-v0")


@pytest.mark.parametrize("data_format", FORMATS)
def test_export_and_back_gives_the_same_numbers(data_format, tmp_path):
    # Eight policies in equal shares: seven of the cuts are in the middle of the data.
    data, _ = load_local_dataset(
        "hopper", "medium-replay", num_transitions=800, cache_dir=tmp_path
    )
    folder = export_minari(
        data, "mine/hopper/replay-v3", env_id="Hopper-v5", data_format=data_format
    )
    again, about = load_minari("mine/hopper/replay-v3")
    assert (again == data).all()
    assert set(again.keys(True, True)) == set(data.keys(True, True))
    assert (about["dataset_id"], about["env_id"]) == (
        "mine/hopper/replay-v3",
        "Hopper-v5",
    )
    assert (load_minari(folder)[0] == data).all()
    theirs = minari.load_dataset("mine/hopper/replay-v3")
    assert theirs.total_steps == 800
    assert theirs.total_episodes == int(data["next", "done"].sum())
    with pytest.raises(ValueError, match="there is a Minari set at"):
        export_minari(data, "mine/hopper/replay-v3")


def test_what_minari_cannot_hold_is_not_exported(tmp_path):
    options = {"num_transitions": 300, "cache_dir": tmp_path}
    data, _ = load_local_dataset("hopper", "medium", **options)
    random, _ = load_local_dataset("hopper", "random", **options)
    mixed = mix_datasets(data, random, random_share=0.5, seed=0)
    with pytest.raises(ValueError, match=r"row 0, and \d+ more, is not done, .*mixed"):
        export_minari(mixed, "mine/mixed-v0")
    with pytest.raises(ValueError, match="row 9, and 0 more, is not done"):
        export_minari(data[:10], "mine/short-v0")
    with pytest.raises(ValueError, match="Walker2d-v5 has observation_space"):
        export_minari(data, "mine/other-v0", env_id="Walker2d-v5")
    assert not [*(tmp_path / "minari").rglob("metadata.json")]


def test_a_failed_export_leaves_nothing(tmp_path, monkeypatch):
    data, _ = load_local_dataset(
        "hopper", "random", num_transitions=50, cache_dir=tmp_path
    )

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        storage = minari.dataset._storages.hdf5_storage.HDF5Storage
        patch.setattr(storage, "update_episodes", full_disk)
        with pytest.raises(OSError, match="No space left"):
            export_minari(data, "mine/random-v0")
    export_minari(data, "mine/random-v0")
    assert (load_minari("mine/random-v0")[0] == data).all()


def test_an_episode_that_minari_reads_in_part_is_not_exported(tmp_path):
    steps = 40_000
    data, _ = transitions_from_rows(
        {
            "observation": np.random.default_rng(0).normal(size=(steps, 1)),
            "action": np.full((steps, 1), 0.5),
            "reward": np.ones(steps),
            "terminated": np.arange(steps) == steps - 1,
            "episode": np.zeros(steps, int),
        }
    )
    with pytest.raises(ValueError, match=r"of 40000 rows .* data_format='hdf5'"):
        export_minari(data, "mine/long-v0", data_format="arrow")
    export_minari(data, "mine/long-v0")
    assert (load_minari("mine/long-v0")[0] == data).all()
