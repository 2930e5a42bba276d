"""The film as a user makes it, of a policy that nothing has trained."""

from __future__ import annotations

import json
import os
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from composed import composed
from untrained_run import make_run

SHORT = ["checkpoint=run", "episodes=2", "window=[20,30]", "after=8"]


@pytest.fixture(scope="module")
def script():
    """The script's functions."""
    before = os.environ.get("MUJOCO_GL")
    module = import_module("torchrl_osr.commands.film")
    # Not for the other tests of this process.
    if before is None:
        os.environ.pop("MUJOCO_GL", None)
    return module


def film(*overrides: str):
    return composed("film", "checkpoint=run", *overrides)


def test_film_leaves_pictures_numbers_and_a_table(tmp_path, run_fresh):
    rows = ["data=medium", "data.num_transitions=600", "data.held_out=0.1"]
    make_run(tmp_path / "run", *rows)
    code, output = run_fresh(tmp_path, "film", *SHORT)  # OpenGL is chosen in time
    if code != 0 and "OpenGL did not start" in output:
        pytest.skip(f"no OpenGL to draw with here: {output.splitlines()[-1]}")
    assert code == 0, output
    assert "Warning" not in output
    folder = tmp_path / "run"
    assert not list(tmp_path.glob("*.log"))
    for name in ("film.png", "visited.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    film_gif = (folder / "film.gif").read_bytes()
    assert film_gif.startswith(b"GIF89a")
    assert len(film_gif) < 3_000_000
    film_json = json.loads((folder / "film.json").read_text())
    assert film_json["seeds"] == [30_000, 30_001]
    assert film_json["filmed"]["seed"] in film_json["seeds"]
    assert 25 <= film_json["filmed"]["push_over"] < 35
    names = ["behaviour policy", "inverse dynamics, time", "inverse dynamics, nearest"]
    assert list(film_json["controllers"]) == [*names, "trained policy"]
    for name, numbers in film_json["controllers"].items():
        assert name in output
        assert len(numbers["returns"]) == len(numbers["alive"]) == 2
        assert all(0 <= steps <= 8 for steps in numbers["alive"])
    assert film_json["controllers"]["behaviour policy"]["alive_clean"] == [8, 8]


class FakeCamera:
    seconds = 0.008

    def __init__(self, environment, size):
        self._picture = np.zeros((8, 8, 3), np.uint8)

    def __call__(self, pose):
        return self._picture

    def close(self): ...


def own_run(folder: Path, env: str, sizes: tuple[int, int], loss: str = "osr") -> str:
    """A run on a log, whose states need not be the robot's own."""
    states = np.random.default_rng(0).normal(size=(60, sizes[0])).astype(np.float32)
    np.savez(
        folder / "log.npz", observation=states, action=np.tanh(states[:, : sizes[1]]),
        reward=np.ones(60), terminated=np.zeros(60, bool),
        truncated=np.arange(60) % 20 == 19,
    )  # fmt: skip
    own = ["data=file", f"data.path={folder / 'log.npz'}", "data.held_out=0.1"]
    make_run(folder / "run", f"env={env}", f"loss={loss}", *own, sizes=sizes)
    return f"checkpoint={folder / 'run'}"


@pytest.mark.parametrize(
    ("loss", "models"),
    [
        ("osr", ["inverse dynamics, time", "inverse dynamics, nearest"]),
        ("cql", []),
    ],
)
def test_own_data_have_the_trained_policy_play_first(
    loss, models, script, tmp_path, monkeypatch, capsys
):
    run = own_run(tmp_path, "halfcheetah", (17, 6), loss)
    monkeypatch.setattr(script, "Camera", FakeCamera)
    script.main(film(run, "episodes=2", "window=[10,12]", "after=4"))
    printed = capsys.readouterr().out
    assert "no behaviour policy to play first: the trained policy does" in printed
    film_json = json.loads((tmp_path / "run" / "film.json").read_text())
    assert list(film_json["controllers"]) == ["trained policy", *models]
    assert film_json["controllers"]["trained policy"]["alive_clean"] == [4, 4]
    pictures = {"film.png", "film.gif", "visited.png"}
    assert pictures < {each.name for each in (tmp_path / "run").iterdir()}


def test_a_policy_that_falls_by_itself_is_not_pushed(script, tmp_path, monkeypatch):
    run = own_run(tmp_path, "hopper", (11, 3))
    monkeypatch.setattr(script, "Camera", FakeCamera)
    with pytest.raises(ValueError, match="In all 2 episodes the trained policy falls"):
        script.main(film(run, "episodes=2"))


def test_filmed_is_the_first_in_which_not_all_fare_alike(script):
    up = [[True, True, False], [True, False, False]]
    episode, why = script.choose(film("seed=7"), [0, 2, 5], up)
    assert (episode, why) == (2, "the first with different outcomes")
    alike = [each[:1] for each in up]
    assert script.choose(film(), [3], alike) == (3, "the first; all end alike")
    wanted = film("seed=7", "film_seed=12")
    assert script.choose(wanted, [0, 2, 5], up) == (5, "as asked for")
    with pytest.raises(ValueError, match=r"film_seed=12 .* \[7, 9\]"):
        script.choose(wanted, [0, 2], [])


def test_knock_takes_the_place_of_the_push(script):
    assert script.disturbance(film())[:2] == ("push", 5)
    name, steps, wrap = script.disturbance(film("knock=20"))
    assert (name, steps, wrap.keywords["mode"]) == ("knock", 20, "torque")
    assert script.in_words(film("push=2"), -3.0).startswith("pushed backwards with 2 x")


@pytest.mark.parametrize(
    ("option", "named"),
    [
        ("rule=next", "nearest"),
        ("window=[5,9]", "at 10 or later"),
        ("window=[20]", "end later still"),
    ],
)
def test_bad_input_is_named(script, option, named):
    with pytest.raises(ValueError, match=named):
        script.disturbance(film(option))


def test_an_episode_that_is_not_played_is_refused_before_any_is(script):
    with pytest.raises(ValueError, match="film_seed=3 is none of the 20 episodes"):
        script.main(film("film_seed=3"))
