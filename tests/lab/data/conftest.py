"""Toy transitions for the tests of all rooms."""

from __future__ import annotations

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
