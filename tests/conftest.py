"""What several test modules share: a seed, small networks and a transition batch."""

from __future__ import annotations

import gc
import signal
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict, unravel_key
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import (
    MLP,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)

pytest_plugins = ["processes"]

torch.set_num_threads(1)

# What ignores them, such as nohup or a shell's "&", would be inherited by the runs that
# tests send signals to.
signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

OBSERVATION_DIM, ACTION_DIM = 3, 2


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

    ``transitions(64, observation=11, action=3)``. Of every five rows one is terminated
    and one is cut by a time limit. The numbers come from a generator of their own:
    equal sizes and seeds give equal transitions.
    """

    def make(
        *size: int,
        observation: int = OBSERVATION_DIM,
        action: int = ACTION_DIM,
        dtype: torch.dtype = torch.float32,
        seed: int = 7,
    ) -> TensorDict:
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
def make_batch(transitions):
    """Return a factory of what losses read: float64, perturbed states if ``twin``."""

    def make(*size: int, twin: bool = True) -> TensorDict:
        batch = transitions(*size, dtype=torch.float64).exclude(("next", "truncated"))
        if twin:
            generator = torch.Generator().manual_seed(8)
            noise = torch.randn(
                batch["observation"].shape, generator=generator, dtype=torch.float64
            )
            batch["perturbed", "observation"] = batch["observation"] + 0.1 * noise
        return batch

    return make


@pytest.fixture
def make_networks():
    """Return a factory of a small actor, critics and inverse dynamics model, float64.

    Built from TorchRL alone, with any keys; equal seeds give equal weights.
    """

    def make(
        *,
        observation="observation",
        action="action",
        low: float | torch.Tensor = -1.0,
        high: float | torch.Tensor = 1.0,
        num_critics: int = 2,
        seed: int = 0,
        distribution_class: type = TanhNormal,
        critic_activation: type[nn.Module] = nn.Tanh,
    ) -> SimpleNamespace:
        torch.manual_seed(seed)
        kwargs = {"low": low, "high": high} if distribution_class is TanhNormal else {}

        def probabilistic(*inputs) -> ProbabilisticActor:
            network = TensorDictSequential(
                TensorDictModule(
                    MLP(len(inputs) * OBSERVATION_DIM, 2 * ACTION_DIM, num_cells=[8]),
                    list(inputs),
                    ["param"],
                ),
                TensorDictModule(NormalParamExtractor(), ["param"], ["loc", "scale"]),
            )
            return ProbabilisticActor(
                network,
                in_keys=["loc", "scale"],
                out_keys=[action],
                distribution_class=distribution_class,
                distribution_kwargs=kwargs,
            ).double()

        return SimpleNamespace(
            actor=probabilistic(observation),
            critics=[
                ValueOperator(
                    MLP(
                        OBSERVATION_DIM + ACTION_DIM,
                        1,
                        num_cells=[8],
                        activation_class=critic_activation,
                    ),
                    in_keys=[observation, action],
                    out_keys=["state_action_value"],
                ).double()
                for _ in range(num_critics)
            ],
            inverse_dynamics=probabilistic(
                observation, unravel_key(("next", observation))
            ),
        )

    return make


@pytest.fixture
def check(record_property):
    """Return an assertion of closeness that notes the largest deviation it has seen.

    ``check(what, got, wanted)`` compares two sequences of tensors, deviations relative
    to the larger of 1 and the wanted number.
    """

    def compare(what: str, got, wanted, *, tolerance: float) -> None:
        largest = 0.0
        for ours, theirs in zip(got, wanted, strict=True):
            assert ours.shape == theirs.shape
            deviation = (ours - theirs).abs() / theirs.abs().clamp(min=1.0)
            largest = max(largest, deviation.max().item())
        record_property("check", (what, largest))
        assert largest <= tolerance, f"{what}: {largest}"

    return compare
