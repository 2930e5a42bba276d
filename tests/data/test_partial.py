"""A collection that is killed goes on, to the same bytes as one that was not."""

from __future__ import annotations

import json
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_osr.data import (
    collect_level,
    collection,
    load_behavior_card,
    load_local_dataset,
    local,
    make_environment,
)
from torchrl_osr.data import partial as partial_file
from torchrl_osr.data.environment import environment_id
from torchrl_osr.data.partial import PartialCollection, Progress

ROWS = 300
FOLDER = f"hopper-medium-replay-{ROWS}-seed0"
PARTS = f".{FOLDER}.partial"


class Killed(BaseException):
    """Nothing catches it, as nothing catches SIGKILL."""


def killed_after(parts: int):
    """Return a kind of partial collection whose process dies at a part."""

    class Dying(PartialCollection):
        def save_if_due(self, columns, progress):
            before = self._parts
            super().save_if_due(columns, progress)
            if self._parts > before and self._parts == parts:
                raise Killed

    return Dying


def load(cache_dir: Path, kind=PartialCollection, **changes):
    request = {"num_transitions": ROWS, "cache_dir": cache_dir, "progress": False}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(local, "PartialCollection", partial(kind, save_every=50))
        return load_local_dataset("hopper", "medium-replay", **(request | changes))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> dict[str, bytes]:
    return files(tmp_path_factory.mktemp("undisturbed"))


def files(cache_dir: Path) -> dict[str, bytes]:
    """Load, and return all that is left."""
    load(cache_dir)
    return {
        str(path.relative_to(cache_dir)): path.read_bytes()
        for path in cache_dir.rglob("*")
        if path.is_file()
    }


@pytest.fixture
def warnings_logged(monkeypatch) -> list[str]:
    messages: list[str] = []
    monkeypatch.setattr(partial_file.torchrl_logger, "warning", messages.append)
    return messages


@pytest.fixture
def steps(monkeypatch) -> list[int]:
    """Record how many rows each episode gave."""
    played: list[int] = []
    play = collection._play_episode

    def recorded(*args):
        length, episode_return = play(*args)
        played.append(length)
        return length, episode_return

    monkeypatch.setattr(collection, "_play_episode", recorded)
    return played


def test_killed_again_and_again_it_ends_with_the_same_bytes(
    tmp_path, undisturbed, warnings_logged, steps
):
    for kill in (1, 2, 4):
        with pytest.raises(Killed):
            load(tmp_path, killed_after(kill))
        assert not (tmp_path / "local" / FOLDER).exists()
        assert len(list((tmp_path / "local" / PARTS).iterdir())) == kill
    assert files(tmp_path) == undisturbed
    assert warnings_logged == []
    assert sum(steps) == ROWS, "no row is rolled out twice, as every kill was at a part"


@pytest.mark.parametrize("env_name", [*load_behavior_card(), "pointmaze-umaze"])
def test_what_comes_after_a_reset_depends_on_its_seed_alone(env_name):
    env_id = environment_id(env_name)

    def play(env) -> list[bytes]:
        actions = np.random.default_rng(1)
        seen = [env.reset(seed=7)[0].tobytes()]
        for _ in range(100):
            action = actions.uniform(-1, 1, env.action_space.shape)
            observation, reward, terminated, *_ = env.step(action)
            seen += [observation.tobytes(), np.float64(reward).tobytes()]
            if terminated:
                break
        return seen

    with closing(make_environment(env_id)) as fresh:
        expected = play(fresh)
    with closing(make_environment(env_id)) as used:
        run_on(used, 150)
        assert play(used) == expected
        assert play(used) == expected


def run_on(env, rows: int) -> None:
    """Leave the simulation's solver somewhere else than where it starts."""
    env.reset(seed=3)
    for _ in range(rows):
        _, _, terminated, truncated, _ = env.step(np.ones(env.action_space.shape))
        if terminated or truncated:
            env.reset()


@settings(max_examples=12, deadline=None)
@given(
    save_every=st.integers(1, 80),
    kills=st.lists(st.integers(1, 6), max_size=3),
    level=st.sampled_from(["random", "medium-expert"]),
)
def test_any_kill_at_any_size_of_a_part(tmp_path_factory, save_every, kills, level):
    folder = tmp_path_factory.mktemp("parts") / "parts"

    def collect(kind):
        kept = kind(folder, {"level": level}, save_every=save_every)
        return collect_level("hopper", level, 120, progress=False, partial=kept)

    for kill in kills:
        with suppress(Killed):
            collect(killed_after(kill))
    result = collect(PartialCollection)
    expected = collect_level("hopper", level, 120, progress=False)
    assert (result.data == expected.data).all()
    np.testing.assert_array_equal(result.episode_returns, expected.episode_returns)
    np.testing.assert_array_equal(result.episode_lengths, expected.episode_lengths)


def damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:200])


@pytest.mark.parametrize("how", [damage, cut, Path.unlink])
def test_a_damaged_part_is_named_and_all_starts_over(
    tmp_path, undisturbed, warnings_logged, how
):
    with pytest.raises(Killed):
        load(tmp_path, killed_after(3))
    # The first part was taken over before: nothing of it may stay, no flag either.
    how(tmp_path / "local" / PARTS / "000001.npz")
    assert files(tmp_path) == undisturbed
    (message,) = warnings_logged
    assert "Starting over" in message
    assert PARTS in message


def test_parts_of_another_request_are_not_used(tmp_path, undisturbed, warnings_logged):
    with pytest.raises(Killed):
        load(tmp_path, killed_after(2), seed=3)
    (tmp_path / "local" / PARTS.replace("seed0", "seed3")).rename(
        tmp_path / "local" / PARTS
    )
    (tmp_path / "local" / f"{FOLDER.replace('seed0', 'seed3')}.lock").unlink()
    assert files(tmp_path) == undisturbed
    assert "its seed is 3, wanted 0" in warnings_logged[0]


def test_a_part_that_was_being_written_is_no_part(tmp_path, undisturbed):
    with pytest.raises(Killed):
        load(tmp_path, killed_after(1))
    (tmp_path / "local" / PARTS / ".000001.npz.new").write_bytes(b"half a part")
    assert files(tmp_path) == undisturbed


def test_a_full_disk_keeps_the_parts_before(tmp_path, undisturbed, monkeypatch):
    with pytest.raises(Killed):
        load(tmp_path, killed_after(1))

    def full_disk(file, **_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(partial_file.np, "savez", full_disk)
        with pytest.raises(OSError, match=r"No space left.*goes on from row \d+"):
            load(tmp_path)
    left = [path.name for path in (tmp_path / "local" / PARTS).iterdir()]
    assert left == ["000000.npz"]
    assert files(tmp_path) == undisturbed


def test_what_a_part_holds_needs_no_pickle(tmp_path):
    columns = {"reward": np.arange(4, dtype=np.float32)[:, None]}
    generator = np.random.default_rng(2)
    state = dict(generator.bit_generator.state)
    kept = PartialCollection(tmp_path / "parts", {"seed": (1, 2)}, save_every=3)
    kept.save_if_due(columns, Progress(2, state, [0.1], [2]))
    assert not (tmp_path / "parts").exists()
    kept.save_if_due(columns, Progress(3, state, [0.1, 1 / 3], [2, 1]))
    with np.load(tmp_path / "parts" / "000000.npz", allow_pickle=False) as arrays:
        assert json.loads(arrays["state"].tobytes())["returns"] == [0.1, 1 / 3]
        assert arrays["reward"].tolist() == [[0.0], [1.0], [2.0]]
    again = PartialCollection(tmp_path / "parts", {"seed": (1, 2)})
    empty = {"reward": np.zeros((4, 1), np.float32)}
    progress = again.restore(empty)
    assert progress == Progress(3, state, [0.1, 1 / 3], [2, 1])
    other = np.random.default_rng(5)
    other.bit_generator.state = progress.generator
    assert other.random() == generator.random()
