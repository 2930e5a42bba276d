"""What several test modules share: a seed, and random transitions."""

from __future__ import annotations

import gc
import signal

import pytest
import torch
from hypothesis import HealthCheck, settings
from tensordict import TensorDict

pytest_plugins = ["processes"]

torch.set_num_threads(1)

# The same examples everywhere, and no folder of them.
every = list(HealthCheck)
settings.register_profile(
    "alike", deadline=None, database=None, derandomize=True, suppress_health_check=every
)
settings.load_profile("alike")

# What ignores them, such as nohup or a shell's "&", would be inherited by the runs that
# tests send signals to.
signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_collection_finish() -> None:
    """Spare the garbage collector the walk through everything that was imported."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def transitions():
    """Return a factory of random transitions, flat or of any batch size.

    Of every five rows one is terminated and one is cut by a time limit. Equal sizes and
    seeds give equal transitions.
    """

    def make(*size, observation=3, action=2, dtype=torch.float32, seed=7) -> TensorDict:
        generator = torch.Generator().manual_seed(seed)

        def normal(dim: int) -> torch.Tensor:
            return torch.randn(*size, dim, generator=generator, dtype=dtype)

        row = torch.arange(torch.Size(size).numel()).reshape(*size, 1) % 5
        state = normal(observation)
        return TensorDict(
            {
                "observation": state,
                "action": 0.9 * torch.tanh(normal(action)),
                "next": {
                    "observation": state + 0.5 * normal(observation),
                    "reward": normal(1),
                    "done": (row == 1) | (row == 2),
                    "terminated": row == 1,
                    "truncated": row == 2,
                },
            },
            size,
        )

    return make


@pytest.fixture
def check():
    """Return an assertion of closeness, relative to the larger of 1 and each number."""

    def compare(what: str, got, wanted, *, tolerance: float) -> None:
        for ours, theirs in zip(got, wanted, strict=True):
            assert ours.shape == theirs.shape
            deviation = (ours - theirs).abs() / theirs.abs().clamp(min=1.0)
            assert deviation.max() <= tolerance, f"{what}: {deviation.max()}"

    return compare
