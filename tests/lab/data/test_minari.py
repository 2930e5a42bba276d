"""Minari sets, read as Minari itself gives them."""

from __future__ import annotations

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from recorded_logs import make_columns, save
from torchrl import torchrl_logger
from untrained_run import make_run

from torchrl_osr.lab.data import check_dataset, load_dataset
from torchrl_osr.lab.run.monitor import MonitorConfig, monitor_of_run

# Minari asks for an author's address, and more, whenever a set is made.
pytestmark = [
    pytest.mark.filterwarnings("ignore::UserWarning:minari"),
    pytest.mark.usefixtures("cache"),
]

LENGTHS = [5, 1, 12, 3, 2, 4, 1, 2, 3, 6, 2, 5]  # more than ten: 10 sorts before 2

VECTOR = spaces.Box(-np.inf, np.inf, (3,))
SPEED_AND_PLACE = [("speed", spaces.Box(-1, 1, (), np.float32)), ("place", VECTOR)]
NESTED = spaces.Dict(  # in no alphabetical order
    [
        ("observation", spaces.Box(-np.inf, np.inf, (2,))),
        ("desired_goal", spaces.Box(-10, 10, (2, 2), np.float32)),
        ("achieved", spaces.Dict(SPEED_AND_PLACE)),
    ]
)
UNIT = spaces.Box(-1, 1, (2,))


def load(path, **options):
    return load_dataset(None, "minari", path=path, progress=False, **options)


def stacked(space, rows):
    if isinstance(space, spaces.Dict):
        return {key: stacked(space[key], [row[key] for row in rows]) for key in space}
    return np.stack(rows)


def make(name, observations=VECTOR, actions=UNIT, data_format="hdf5"):
    observations.seed(0)
    actions.seed(0)
    buffers = []
    for number, steps in enumerate(LENGTHS):
        fell = number % 3 == 0
        end = np.arange(steps) == steps - 1
        rows = [observations.sample() for _ in range(steps + 1)]
        buffer = EpisodeBuffer(
            observations=stacked(observations, rows),
            actions=np.stack([actions.sample() for _ in range(steps)]),
            rewards=np.random.default_rng(number).normal(size=steps),
            terminations=end & fell,
            truncations=end & (not fell),
        )
        buffers.append(buffer)
    known = {"observation_space": observations, "action_space": actions}
    known["data_format"] = data_format
    return minari.create_dataset_from_buffers(name, buffers, **known)


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
@pytest.mark.parametrize("space", [VECTOR, NESTED], ids=["vector", "dictionary"])
def test_every_row_is_minaris_own(space, data_format):
    made = make("test/set-v0", space, data_format=data_format)
    data, manifest = load("test/set-v0")
    check_dataset(data)
    episodes = [*minari.load_dataset("test/set-v0").iterate_episodes()]
    states = [flat(space, each.observations) for each in episodes]
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
    assert (load(made.storage.data_path.parent)[0] == data).all()


def flat(space, observations):
    if isinstance(space, spaces.Dict):
        parts = [flat(space[key], observations[key]) for key in sorted(space)]
        return np.concatenate(parts, 1)
    return observations.reshape(len(observations), -1)


def test_actions_are_mapped_to_the_unit_box_or_become_one_hot():
    made = make("test/set-v0", actions=spaces.Box(np.float32(-4), np.float32(0), (2,)))
    data, manifest = load("test/set-v0")
    raw = np.concatenate([e.actions for e in made.iterate_episodes()])
    expected = ((raw.astype(float) + 4) / 4 * 2 - 1).clip(-0.999, 0.999)
    assert np.array_equal(data["action"], expected.astype(np.float32))
    assert manifest["action_bounds"] == [[-4, -4], [0, 0]]
    made = make("test/numbers-v0", actions=spaces.Discrete(3, start=1))
    data, manifest = load("test/numbers-v0")
    numbers = np.concatenate([each.actions for each in made.iterate_episodes()]) - 1
    assert np.array_equal(data["action"], np.eye(3)[numbers])
    assert manifest["num_actions"] == 3


def test_nothing_is_fetched_unless_asked_for(tmp_path, monkeypatch):
    asked = []

    def fetch(name):
        asked.append(name)
        make(name)

    monkeypatch.setattr(minari.storage.hosting, "download_dataset", fetch)
    with pytest.raises(FileNotFoundError, match=r"'test/far-v0' is not .*download="):
        load("test/far-v0")
    assert asked == []
    data, _ = load("test/far-v0", download=True)
    load("test/far-v0", download=True)
    assert (asked, len(data)) == (["test/far-v0"], sum(LENGTHS))
    given = "data=minari", "data.path=test/far-v0", "data.download=true"
    make_run(tmp_path / "run", *given, sizes=(3, 2))
    own = save(tmp_path / "own.npz", make_columns())
    options = MonitorConfig(false_alarms=0.3, episodes=str(own))
    assert monitor_of_run(tmp_path / "run", options).record["episodes"] == 4


def test_other_action_bounds_than_the_tasks_are_a_warning(monkeypatch):
    said = []
    monkeypatch.setattr(torchrl_logger, "warning", said.append)
    for high in (2, 4):
        make(f"test/{high}-v0", actions=spaces.Box(-high, high, (1,), np.float32))
        load(f"test/{high}-v0", env_id="Pendulum-v1")
        assert len(said) == (high == 4)
