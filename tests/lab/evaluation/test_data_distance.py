"""Distances to the data against a brute force in double precision."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.lab.evaluation import DataDistance


def dataset(rows: torch.Tensor) -> TensorDict:
    return TensorDict({"observation": rows}, [len(rows)])


def brute_force(distance: DataDistance, rows: torch.Tensor, scale: torch.Tensor):
    """Distances to the states that it compares with, found without it."""
    states = distance._states.numpy()
    loc = distance._loc.numpy()
    asked = (rows.double().numpy() - loc) / scale.double().numpy()
    exact = np.sqrt(np.square(asked[:, None] - states[None]).sum(-1))
    return np.sort(exact, axis=1)[:, :10].mean(1)


@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_small_distances_keep_their_digits(offset):
    """Far from zero and close together, a float32 product would lose them."""
    generator = torch.Generator().manual_seed(0)
    centres = 30 * torch.randn(40, 11, generator=generator)
    rows = centres.repeat(100, 1) + 1e-3 * torch.randn(4000, 11, generator=generator)
    rows = rows + offset
    distance = DataDistance(dataset(rows), max_reference=3000)
    scale = rows.double().std(0, correction=0).float()
    near = rows[:300]
    far = near + 5 * torch.randn(300, 11, generator=generator)
    for asked in (near, far):
        wanted = brute_force(distance, asked, scale)
        # Those that are in the reference find themselves, at distance 0.
        got = distance(asked).numpy()
        np.testing.assert_allclose(got, wanted, rtol=1e-5, atol=5e-8)
    assert brute_force(distance, near, scale).max() < 1e-3
    assert (distance(far) > 10 * distance.threshold).all()


def test_threshold_is_the_quantile_of_states_that_were_left_out():
    generator = torch.Generator().manual_seed(1)
    rows = torch.randn(5000, 4, generator=generator)
    distance = DataDistance(dataset(rows), max_reference=2000)
    assert distance._states.shape == (2000, 4)
    fresh = torch.randn(4000, 4, generator=generator)
    assert (distance(fresh) <= distance.threshold).float().mean() == pytest.approx(
        0.95, abs=0.015
    )
    kept = {tuple(row) for row in distance._states.tolist()}
    standard = [tuple(row) for row in distance._standard(rows).tolist()]
    assert len(kept) == len(kept & set(standard)) == 2000
