"""The mazes as a user runs them: recorded ants, a point of our own, disturbances."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import gymnasium
import minari
import numpy as np
import pytest
from composed import composed
from minari.data_collector import EpisodeBuffer

from torchrl_osr.lab.cli import evaluate
from torchrl_osr.lab.data import load_dataset, make_environment

# Minari asks for an author's address, and more, whenever a set is made.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")

ANTS = "test/antmaze-v0"
ANT_SEEDS = (0, 1, 6)  # the last of them starts at its goal


@pytest.fixture(scope="module", autouse=True)
def _minari(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        yield


@pytest.fixture(scope="module")
def train(run, tiny):
    """Return a function that trains in ``<cwd>/run``: what was printed."""

    def train(cwd: Path, data: str, *arguments: str) -> str:
        sizes = tiny(
            data, inverse_dynamics_steps=2, steps=2, log_interval=1, eval_interval=2,
            eval_episodes=2, checkpoint_interval=2,
        )  # fmt: skip
        command = [*sizes, "hydra.run.dir=run", *arguments]
        code, output = run(cwd, "train", *command)
        assert code == 0, output
        return output

    return train


def play_ants(env):
    """Return the steps of random ants in one cell, an episode each."""
    cell = np.array([1, 1])
    for seed in ANT_SEEDS:
        rng = np.random.default_rng(seed)
        options = {"reset_cell": cell, "goal_cell": cell}
        steps, over = [(env.reset(seed=seed, options=options)[0],)], False
        while not over and len(steps) <= 20:
            action = rng.uniform(-1, 1, 8).astype(np.float32)
            observation, reward, over, *_ = env.step(action)
            steps.append((observation, action, reward, over))
        yield steps


def record_ants() -> None:
    """Leave a set as Minari's own collector would, which needs JAX."""
    buffers = []
    with closing(gymnasium.make("AntMaze_UMaze-v4", continuing_task=False)) as env:
        Path(env.unwrapped.tmp_xml_file_path).unlink()  # it is not removed by itself
        for steps in play_ants(env):
            observations = [step[0] for step in steps]
            _, actions, rewards, ends = zip(*steps[1:], strict=True)
            rows = {
                "observations": {
                    key: np.stack([each[key] for each in observations])
                    for key in env.observation_space
                },
                "actions": np.stack(actions),
                "rewards": np.array(rewards),
                "terminations": np.array(ends),
                "truncations": np.zeros(len(ends), bool),
            }
            rows["truncations"][-1] = not ends[-1]
            buffers.append(EpisodeBuffer(**rows))
        minari.create_dataset_from_buffers(
            ANTS, buffers, observation_space=env.observation_space,
            action_space=env.action_space, data_format="hdf5",
        )  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*AntMaze_UMaze-v4 is out of date")
def test_recorded_ants_are_trained_on(train, tmp_path):
    with closing(make_environment("AntMaze_UMaze-v4")) as env:
        episodes = [[step[0] for step in steps] for steps in play_ants(env)]
    observations = np.concatenate([np.stack(rows[:-1]) for rows in episodes])
    record_ants()
    data, manifest = load_dataset(source="minari", path=ANTS)
    expected = observations.astype(np.float32)
    assert np.array_equal(data["observation"], expected), "one order of the entries"
    assert manifest["observation_layout"] == [
        *(["achieved_goal", 2], ["desired_goal", 2], ["observation", 27])
    ]
    printed = train(
        tmp_path, "minari", "env=antmaze-umaze", f"data.path={ANTS}", "preset=antmaze"
    )
    for word in ("Warning", "WARN", "Traceback", "Adroit"):
        assert word not in printed
    last = json.loads((tmp_path / "run" / "returns.json").read_text())["last"]
    assert last["score"] == 100 * np.mean(last["returns"])
    assert max(last["lengths"]) <= 700


def test_a_point_is_trained_and_disturbed(train, tmp_path):
    train(tmp_path, "diverse", "env=pointmaze-umaze", "preset=pointmaze")
    folder = tmp_path / "run"

    def disturb(suite: str) -> None:
        given = f"suite={suite}", f"checkpoint={folder}", "episodes=2", "last=1"
        evaluate.main(composed("evaluate", *given, "progress=false"))

    disturb("torque")
    results = json.loads((folder / "robustness-torque.json").read_text())
    levels = results["evaluations"][0]["levels"]
    assert [level["name"] for level in levels] == [
        f"torque-{steps}" for steps in (2, 5, 10, 15, 20)
    ]
    for level in levels:
        assert set(level["scores"]) <= {0.0, 100.0}
    message = "no disturbance of suite=dynamics is possible, .*PointMaze_UMaze-v3"
    with pytest.raises(ValueError, match=message):
        disturb("dynamics")
    assert not (folder / "robustness-dynamics.json").exists()
