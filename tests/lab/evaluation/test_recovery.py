"""Distances to the data by brute force; survival and recovery by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.lab.evaluation import DataDistance, recovery
from torchrl_osr.lab.evaluation.recovery import Trajectory, measure_recovery


@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_small_distances_keep_their_digits(offset, monkeypatch):
    """Far from zero and close together, a float32 product would lose them."""
    monkeypatch.setattr(recovery, "MAX_REFERENCE", 3000)
    generator = torch.Generator().manual_seed(0)
    centres = 30 * torch.randn(40, 11, generator=generator)
    rows = centres.repeat(100, 1) + 1e-3 * torch.randn(4000, 11, generator=generator)
    rows = rows + offset
    data = TensorDict({"observation": rows}, [4000])
    distance = DataDistance(data)
    assert len(distance._states) == 3000
    scale = rows.double().std(0, correction=0).float().double()
    far = rows[:300] + 5 * torch.randn(300, 11, generator=generator)
    for asked in (far, rows[:300]):  # some of these find themselves, at distance 0
        standard = (asked.double() - distance._loc) / scale
        exact = (standard[:, None] - distance._states).square().sum(-1).sqrt()
        nearest = exact.sort().values[:, :10].mean(1)
        found = distance(asked).double()
        torch.testing.assert_close(found, nearest, rtol=1e-5, atol=5e-8)
    assert nearest.max() < 1e-3
    assert (distance(far) > 10 * distance.threshold).all()


def test_threshold_is_the_quantile_of_states_that_were_left_out():
    rows, fresh = torch.randn(2, 5000, 4, generator=torch.Generator().manual_seed(1))
    distance = DataDistance(TensorDict({"observation": rows}, [5000]))
    share = (distance(fresh) <= distance.threshold).float().mean()
    assert share == pytest.approx(0.95, abs=0.015)


class Distance:
    """The first number of an observation; up to 2 is in the data."""

    threshold = 2.0

    def __call__(self, rows: torch.Tensor) -> torch.Tensor:
        return rows[:, 0]


def trajectory(distances, disturbed=(), *, fell=False) -> Trajectory:
    """Entry 0 is the reset."""
    rows = [np.array([each, 9.0], dtype=np.float32) for each in distances]
    return Trajectory(rows, [i in disturbed for i in range(len(rows))], fell)


def measure(disturbed: Trajectory, clean: Trajectory | None = None):
    return measure_recovery(disturbed, clean or trajectory([1.0] * 200), Distance())


@pytest.mark.parametrize(
    ("after", "fell", "survived", "alive", "steps"),
    [
        ([2.0, 3.0], False, True, None, 0),  # at the threshold is within
        ([3.0, 2.1, 1.9, 5.0], False, True, None, 2),
        ([3.0] * 50, False, True, None, None),  # never back before the end
        ([3.0] * 120 + [1.0], False, True, True, 120),
        ([3.0], True, False, False, None),  # fell in the disturbance
        ([1.0], True, False, False, None),  # and where it lies is in the data
        ([3.0, 3.0, 1.0], True, True, False, None),  # the same, a little later
        ([3.0, 1.0, 3.0], True, True, False, 1),  # back, and fell afterwards
        ([3.0] * 101, True, True, False, None),  # fell in the last step that counts
        ([3.0] * 102, True, True, True, None),  # fell one later
        ([3.0] * 101, False, True, True, None),  # the time limit, just not too early
        ([3.0] * 100, False, True, None, None),  # too early to say
    ],
)
def test_one_episode(after, fell, survived, alive, steps):
    before = [1.0, 1.0, 4.0]
    recovery = measure(trajectory([*before, *after], {2, 3}, fell=fell))
    names = "survived_knock", "alive_after", "recovery_steps"
    assert [recovery[name] for name in names] == [survived, alive, steps]


def test_the_first_disturbance_counts_if_there_is_one():
    assert measure(trajectory([1.0, 9.0, 9.0], fell=True)) is None
    recovery = measure(trajectory([1, 1, 4, 3, 1, 1, 8, 8], {2, 6}))
    assert recovery["recovery_steps"] == 2


@pytest.mark.parametrize(
    ("entries", "fell", "alive"),
    [(50, True, False), (150, True, True), (50, False, None)],
)
def test_the_undisturbed_episode_is_measured_at_the_same_step(entries, fell, alive):
    clean = trajectory([1.0] * entries, fell=fell)
    recovery = measure(trajectory([1.0, 4.0, 1.0, 1.0], {1}), clean)
    assert recovery["clean_alive_after"] == alive


def test_a_trajectory_copies_observations_and_a_goal_is_no_fall():
    kept, row = Trajectory(), np.array([1.0, 2.0])
    kept.record(row, False, {})
    row[:] = 7  # an environment may use its array again
    kept.record(row, True, {"disturbed": True})
    assert np.stack(kept.observations).tolist() == [[1, 2], [7, 7]]
    assert kept.disturbed == [False, True]
    assert kept.terminated
    kept.record(row, True, {"success": True})
    assert not kept.terminated
