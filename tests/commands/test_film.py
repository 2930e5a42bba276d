"""The film as a user makes it, of a run of a few steps."""

from __future__ import annotations

import json
import os
from importlib import import_module
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

CONF = Path(__file__).parents[2] / "conf/evaluation"
SHORT = ["checkpoint=run", "episodes=2", "window=[20,30]", "after=16"]


@pytest.fixture(scope="module")
def script():
    """The script's functions."""
    before = os.environ.get("MUJOCO_GL")
    module = import_module("torchrl_osr.commands.film")
    # Not for the other tests of this process.
    if before is None:
        os.environ.pop("MUJOCO_GL", None)
    return module


def composed(*overrides: str):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("film", overrides=["checkpoint=run", *overrides])


def test_film_leaves_pictures_numbers_and_a_table(tmp_path, run, tiny):
    sizes = [*tiny("medium"), "hydra.run.dir=run"]
    code, output = run(tmp_path, "train", *sizes)
    assert code == 0, output
    code, output = run(tmp_path, "film", *SHORT)
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
    assert list(film_json["controllers"]) == [*names, "OSR policy"]
    for name, numbers in film_json["controllers"].items():
        assert name in output
        assert len(numbers["returns"]) == len(numbers["alive"]) == 2
        assert all(0 <= steps <= 16 for steps in numbers["alive"])
    assert film_json["controllers"]["behaviour policy"]["alive_clean"] == [16, 16]


def test_filmed_is_the_first_in_which_not_all_fare_alike(script):
    up = [[True, True, False], [True, False, False]]
    episode, why = script.choose(composed("seed=7"), [0, 2, 5], up)
    assert (episode, why) == (2, "the first with different outcomes")
    alike = [each[:1] for each in up]
    assert script.choose(composed(), [3], alike) == (3, "the first; all end alike")
    wanted = composed("seed=7", "film_seed=12")
    assert script.choose(wanted, [0, 2, 5], up) == (5, "as asked for")
    with pytest.raises(ValueError, match=r"film_seed=12 .* \[7, 9\]"):
        script.choose(wanted, [0, 2], [])


def test_knock_takes_the_place_of_the_push(script):
    assert script.disturbance(composed())[:2] == ("push", 5)
    name, steps, wrap = script.disturbance(composed("knock=20"))
    assert (name, steps, wrap.keywords["mode"]) == ("knock", 20, "torque")
    assert script.in_words(composed("push=2"), -3.0).startswith(
        "pushed backwards with 2 x"
    )


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
        script.disturbance(composed(option))
