"""Films and maps of takes, also of those that fell too early to be shown standing."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from torchrl_osr.data import make_environment
from torchrl_osr.film import Camera, Take, film_gif, film_strip, visited_states
from torchrl_osr.film.pictures import GIF_STRIDE, principal_plane


class FakeCamera:
    """Notes which poses it was asked for."""

    seconds = 0.01

    def __init__(self) -> None:
        self.seen: list[float] = []

    def __call__(self, pose):
        self.seen.append(float(pose[0]))
        return np.full((4, 4, 3), 200, np.uint8)


def take(entries: int, *, fell: bool) -> Take:
    """Begin at entry 12, end at 15; the pose is the entry's number."""
    states = np.random.default_rng(entries).normal(size=(entries, 3))
    poses = np.arange(float(entries))[:, None]
    return Take("somebody", states.astype(np.float32), poses, 12, 15, fell)


@pytest.fixture
def takes() -> list[Take]:
    """One stays up, one falls 4 steps after the end, one 2 steps before it."""
    return [take(40, fell=False), take(20, fell=True), take(14, fell=True)]


def test_strip_shows_who_fell_where_they_lie(takes, tmp_path):
    camera, path = FakeCamera(), tmp_path / "film.png"
    film_strip(
        takes, camera, path, title="t", note="n", offsets=[-10, 0, 5], event="push"
    )
    assert camera.seen == [5, 15, 20, 5, 15, 19, 5, 13, 13]
    assert path.read_bytes().startswith(b"\x89PNG")


def test_gif_has_every_third_step(takes, tmp_path):
    camera, path = FakeCamera(), tmp_path / "film.gif"
    film_gif(
        takes[:2], camera, path, title="t", note="n", offsets=range(-6, 7), event="push"
    )
    assert camera.seen == [9, 9, 12, 12, 15, 15, 18, 18, 21, 19]
    with Image.open(path) as film:
        assert film.n_frames == len(range(-6, 7, GIF_STRIDE)) == 5
        assert film.info["loop"] == 0


def test_map_is_drawn_for_all_of_them(takes, tmp_path):
    data = np.random.default_rng(0).normal(size=(500, 3)) * [1, 5, 0]
    path = tmp_path / "visited.png"
    visited_states(data, takes, path, title="t", note="n", event="push", steps=20)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_plane_is_that_of_the_largest_variances():
    rows = np.random.default_rng(0).normal(size=(2000, 3)) * [1, 4, 2]
    directions, shares = principal_plane(rows)
    np.testing.assert_allclose(directions, [[0, 1, 0], [0, 0, 1]], atol=0.05)
    np.testing.assert_allclose(shares, [16 / 21, 4 / 21], atol=0.02)


def test_only_mujoco_tasks_have_poses_to_draw():
    with pytest.raises(ValueError, match="MuJoCo tasks can be filmed.*Pendulum"):
        Camera(make_environment("Pendulum-v1"), 8)
