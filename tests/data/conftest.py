"""Toy transitions for the tests of all rooms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache folder of the test's own."""
    monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "cache"


@pytest.fixture(scope="session")
def make_transitions():
    """Factory of random transitions, the same for the same arguments."""

    def make(
        rows: int = 60, sizes: tuple[int, int] = (3, 2), *, offset: float = 0.0
    ) -> TensorDict:
        generator = torch.Generator().manual_seed(0)

        def normal(size: int) -> torch.Tensor:
            return torch.randn(rows, size, generator=generator)

        ended = torch.rand(rows, 1, generator=generator) < 0.2
        following = {
            "observation": normal(sizes[0]),
            "reward": normal(1),
            "done": ended,
            "terminated": ended,
            "truncated": torch.zeros_like(ended),
        }
        return TensorDict(
            {
                "observation": normal(sizes[0]) + offset,
                "action": normal(sizes[1]).tanh(),
                "next": TensorDict(following, [rows]),
            },
            [rows],
        )

    return make


@pytest.fixture(scope="session")
def make_columns():
    """Factory of recorded columns: episodes of 40 steps, half of which fall."""

    def make(rows: int = 300, *, with_next: bool = False) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(1)
        ends = np.arange(rows) % 40 == 39
        columns = {
            "observation": rng.normal(size=(rows, 3)).astype(np.float32),
            "action": rng.uniform(-1, 1, (rows, 2)).astype(np.float32),
            "reward": rng.normal(size=rows),
            "terminated": ends & (rng.random(rows) < 0.5),
        }
        columns["truncated"] = ends & ~columns["terminated"]
        if with_next:
            columns["next_observation"] = rng.normal(size=(rows, 3)).astype(np.float32)
        return columns

    return make
