"""Which states a policy comes back from, in the environments themselves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torchrl_osr._files import sha256_of
from torchrl_osr.lab.data import load_behavior_policy, make_environment
from torchrl_osr.lab.data.collect.environment import environment_id
from torchrl_osr.lab.evaluation.recoverable import (
    GROUPS,
    HALVES,
    STATES,
    RecoverableStates,
    load_recoverable_states,
    read_recoverable_states,
    recovered_share,
    recovers,
    saved_difference,
    saved_share,
)


def states_of(env_name: str, states: list[tuple], **others) -> dict[str, np.ndarray]:
    """Arrays of a file with the given positions and velocities."""
    count = len(states)
    arrays = {
        "env_name": env_name,
        "qpos": np.stack([np.asarray(qpos, float) for qpos, _ in states]),
        "qvel": np.stack([np.asarray(qvel, float) for _, qvel in states]),
        "goal": np.zeros((count, 0)),
        "group": ["recoverable"] * count,
        "walk": np.arange(count),
        "moment": np.arange(count),
        "kind": ["kick"] * count,
        "strength": np.ones(count),
        "distance": np.ones(count),
        "offsets": np.zeros((count, 2, 3)),
        "hold": 4,
        "steps": 60,
        "least_speed": -np.inf,
    }
    return {name: np.asarray(value) for name, value in (arrays | others).items()}


@pytest.fixture
def load(tmp_path: Path):
    """Write arrays and read them as states."""

    def load(arrays: dict[str, np.ndarray]) -> RecoverableStates:
        np.savez(tmp_path / "states.npz", **arrays)
        return read_recoverable_states(tmp_path / "states.npz")

    return load


def expert(env_name: str):
    policy = load_behavior_policy(env_name, "expert")
    return lambda observation: torch.from_numpy(
        policy.deterministic(observation.numpy())
    )


def still(size: int):
    return lambda observation: torch.zeros(len(observation), size)


def test_who_falls_from_each_state_is_what_the_environment_says(load) -> None:
    env = make_environment("Walker2d-v5")
    env.reset(seed=0)
    bare = env.unwrapped
    rng = np.random.default_rng(0)
    # More than are played at once; some fall and some do not.
    states = [
        (bare.init_qpos, bare.init_qvel + 2.0 * rng.standard_normal(9))
        for _ in range(20)
    ]

    def policy(observation: Tensor) -> Tensor:
        # Rounds in the same way whatever the number of rows: falls are chaotic.
        return -0.1 * observation[:, 11:]

    def stands(qpos: np.ndarray, qvel: np.ndarray) -> bool:
        env.reset()
        bare.set_state(qpos, qvel)
        observation = bare._get_obs()
        for _ in range(60):
            rows = torch.from_numpy(observation[None]).float()
            action = policy(rows)[0].numpy()
            observation, _, terminated, _, _ = env.step(action)
            if terminated:
                return False
        return True

    expected = [stands(*state) for state in states]
    back = recovers(load(states_of("walker2d", states)), policy)
    assert back.tolist() == expected
    assert 2 < sum(expected) < 18


def test_halfcheetah_has_to_regain_its_speed(load) -> None:
    state = np.zeros(9), np.zeros(9)
    arrays = states_of("halfcheetah", [state, state], least_speed=2.0, steps=100)
    assert recovers(load(arrays), expert("halfcheetah")).tolist() == [True, True]
    assert recovers(load(arrays), still(6)).tolist() == [False, False]
    arrays["least_speed"] = np.array(100.0)
    assert recovers(load(arrays), expert("halfcheetah")).tolist() == [False, False]


def test_in_a_maze_the_goal_of_each_state_counts(load) -> None:
    pytest.importorskip("gymnasium_robotics")
    env = make_environment(environment_id("pointmaze-umaze"))
    start, _ = env.reset(seed=0)
    here = start[:2]
    # It rolls towards the first goal, stands at the second, and away from the third.
    states = [(here, [1.0, 0.0]), (here, [0.0, 0.0]), (here, [0.0, 0.0])]
    goals = np.stack([here] * 3)
    goals[:, 0] += [0.6, 0.0, 5.0]
    seen = []

    def policy(observation: Tensor) -> Tensor:
        seen.append(observation)
        return torch.zeros(len(observation), 2)

    arrays = states_of("pointmaze-umaze", states, goal=goals)
    assert recovers(load(arrays), policy).tolist() == [True, True, False]
    np.testing.assert_allclose(seen[0][:, 2:4], goals, atol=1e-6)
    np.testing.assert_allclose(seen[0][:, 4:6], np.stack([here] * 3), atol=1e-6)


@pytest.mark.parametrize("half", HALVES)
def test_the_states_that_ship_are_whole(half) -> None:
    sums = json.loads((STATES / "checksums.json").read_text())
    names = [path.name for path in STATES.glob(f"*-{half}.npz")]
    assert len(names) == 4
    for name in names:
        assert sha256_of(STATES / name) == sums[name]
        states = load_recoverable_states(name.removesuffix(f"-{half}.npz"), half)
        assert {*states.group} <= {*GROUPS}
        hard = states.group == "recoverable"
        assert hard.any()
        assert not states.offsets[~hard].any()


def test_states_that_do_not_ship_are_named() -> None:
    with pytest.raises(ValueError, match=r"'ant'; there are of: halfcheetah, hopper,"):
        load_recoverable_states("ant")
    with pytest.raises(ValueError, match="half must be one of"):
        load_recoverable_states("hopper", "all")


def test_a_file_of_something_else_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "rows.npz"
    np.savez(path, qpos=np.zeros((2, 9)), extra=np.zeros(1))
    with pytest.raises(ValueError, match=r"rows\.npz holds no recoverable.*extra"):
        read_recoverable_states(path)
    path.write_bytes(b"PK broken")
    with pytest.raises(ValueError, match="damaged"):
        read_recoverable_states(path)


def test_no_states_are_no_answers(load) -> None:
    arrays = states_of("hopper", [(np.zeros(6), np.zeros(6))])
    names = set(arrays) - {"env_name", "hold", "steps", "least_speed"}
    empty = arrays | {name: arrays[name][:0] for name in names}
    assert recovers(load(empty), still(3)).shape == (0,)


def test_the_recovered_share_of_known_tables() -> None:
    baseline = [[1, 0, 0, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0, 0, 0]]
    method = [[1, 1, 0, 0, 0, 0, 0, 0], [1, 1, 1, 0, 0, 0, 0, 0]]
    walk = [0, 0, 1, 1, 2, 2, 3, 3]
    assert recovered_share(np.ones((2, 8)), baseline, walk) == (1, 1, 1)
    assert recovered_share(baseline, baseline, walk) == (0, 0, 0)
    # 5 of 16 against 2 of 16.
    assert recovered_share(method, baseline, walk)[0] == pytest.approx(3 / 14)
    # With one walk the seeds alone vary: (2 - 1) / 7, (3 - 1) / 7, or between.
    one = recovered_share(method, baseline, [7] * 8)
    assert one == pytest.approx((3 / 14, 1 / 7, 2 / 7))
    # With one seed the walks alone vary, the states of one together.
    two = [0, 0, 0, 0, 1, 1, 1, 1]
    single = recovered_share(method[:1], np.zeros((1, 8)), two)
    assert single == pytest.approx((1 / 4, 0, 1 / 2))


def test_the_saved_share_of_known_tables() -> None:
    back, walk = [[1, 1, 0, 0], [1, 0, 0, 0]], [0, 0, 1, 1]
    # All walks alike: with one of them the seeds alone vary, from 1 / 4 to 2 / 4.
    assert saved_share(back, [7] * 4) == pytest.approx((3 / 8, 1 / 4, 1 / 2))
    # With one seed the walks alone vary, from none of a walk to all.
    assert saved_share(back[:1], walk) == pytest.approx((1 / 2, 0, 1))
    # Nothing varies where all come back: Wilson's interval of two walks, 2 / (2 + z^2).
    all_of_them = saved_share(np.ones((3, 4)), walk)
    assert all_of_them == pytest.approx((1, 0.342380, 1), abs=1e-6)
    none = saved_share(np.zeros((3, 4)), walk)
    assert none == pytest.approx((0, 0, 0.657620), abs=1e-6)
    # A walk with more states counts for more.
    assert saved_share([[1, 1, 1, 0]], [0, 0, 0, 1])[0] == 3 / 4


def test_the_saved_difference_of_known_tables() -> None:
    method, baseline, walk = [[1, 1, 1, 0]], [[1, 0, 0, 0]], [0, 0, 1, 1]
    assert saved_difference(method, baseline, walk) == (1 / 2, 1 / 2, 1 / 2)
    # One more of four states with one seed, one fewer with the other.
    both = [[1, 1, 0, 0], [1, 0, 0, 0]], [[1, 0, 0, 0], [1, 1, 0, 0]]
    assert saved_difference(*both, [7] * 4) == (0, -1 / 4, 1 / 4)
    # A tie is no share of none: it says nothing about what either saves.
    assert saved_difference(method, method, walk) == (0, 0, 0)


def test_the_interval_of_the_recovered_share_covers_the_truth() -> None:
    """Seeds and walks differ; of 30 intervals of 95 % at least 25 hold the truth."""
    rng, held = np.random.default_rng(0), 0
    walk = np.repeat(np.arange(40), 3)
    for _ in range(30):
        seed = rng.normal(0, 0.05, (20, 1))
        place = np.repeat(rng.normal(0, 0.1, 40), 3)
        draws = rng.random((2, 20, 120))
        baseline = draws[0] < np.clip(0.15 + seed + place, 0, 1)
        method = draws[1] < np.clip(0.40 + seed + place, 0, 1)
        _, low, high = recovered_share(method, baseline, walk)
        held += low <= 0.2902 <= high  # by 10^7 draws of the two shares
    assert held >= 25


def test_shares_without_a_difference_or_with_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="the baseline saves all states"):
        recovered_share([[1, 0]], [[1, 1]], [0, 1])
    with pytest.raises(ValueError, match=r"got \(1, 3\) and \(2,\)"):
        recovered_share([[1, 0]], [[1, 1, 0]], [0, 1])
    with pytest.raises(ValueError, match="have the same seeds; got 1 and 2"):
        recovered_share([[1, 0]], [[1, 0], [0, 0]], [0, 1])
    with pytest.raises(ValueError, match="finite"):
        saved_share([[1, np.nan]], [0, 1])
    with pytest.raises(ValueError, match="have the same seeds; got 1 and 2"):
        saved_difference([[1, 0]], [[1, 0], [0, 0]], [0, 1])
    with pytest.raises(ValueError, match=r"got \(0, 2\) and"):
        saved_share(np.zeros((0, 2)), [0, 1])


def test_seeds_that_are_not_paired_vary_by_themselves() -> None:
    """One walk: method 2 / 4; baseline 1 / 4 or 3 / 4 with either seed, or between."""
    method, baseline = [[1, 1, 0, 0]], [[1, 0, 0, 0], [1, 1, 1, 0]]
    share = recovered_share(method, baseline, [7] * 4, paired=False)
    assert share == pytest.approx((0, -1, 1 / 3))
