"""The updates that ``update_speed.py`` times: ours, TorchRL's CQL, the plain reference.

Each is a generator that does one update and names each part of it when it is done, so
that one clock outside can tell the parts apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from diagnostics import count_flops
from matmul_bound import Pass, Products, osr_passes, total_flops
from plain_reference import Batch, PlainOSR
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ReplayBuffer
from torchrl.objectives import LossModule, SoftUpdate
from torchrl_cql import cql_loss, cql_update

from torchrl_osr import OSRLoss, OSRVLoss, StatePerturbation
from torchrl_osr.data import make_replay_buffer
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.trainers.cudagraph import captured

Casting = Callable[[], AbstractContextManager]
Update = Callable[[Any, Casting], Iterator[str]]

GAMMA, TAU, RATE, BATCH, NUM_RANDOM, ROWS = 0.99, 5e-3, 3e-4, 256, 10, 100_000
OURS = ("OSR", "CQL(H)", "OSR-v", "OSR-10")
TORCHRL, PLAIN, SAMPLING = "TorchRL CQL", "plain OSR", "sampling"
PRODUCTS, PRODUCTS_BF16 = "products", "products in bfloat16"
COMPILED, GRAPH, BOTH = "OSR, compiled", "OSR, graph", "OSR, graph and compiled"
# Beside plain OSR, and only there. Operations and host reads are counted in Python: of
# a compiled loss as if it were not compiled, of a graph none at all.
ON_GPU = (COMPILED, GRAPH, BOTH)
DIMENSIONS = {"hopper": (11, 3), "walker2d": (17, 6), "halfcheetah": (17, 6)}


@dataclass(frozen=True)
class Size:
    """A task's dimensions and the hidden layers of all networks."""

    observations: int
    actions: int
    cells: tuple[int, ...]

    @classmethod
    def parse(cls, name: str) -> Size:
        """Return the size of a name such as ``hopper-2x256``."""
        task, _, layers = name.partition("-")
        depth, width = (int(number) for number in layers.split("x"))
        return cls(*DIMENSIONS[task], (width,) * depth)


def make_buffer(size: Size, device: torch.device) -> ReplayBuffer:
    """Return the package's buffer, of random transitions with perturbed twins."""
    ends = torch.rand(ROWS, 1) < 2e-3
    following = {
        "observation": torch.randn(ROWS, size.observations),
        "reward": torch.randn(ROWS, 1),
        "done": ends,
        "terminated": ends & (torch.rand(ROWS, 1) < 0.5),
    }
    data = {
        "observation": torch.randn(ROWS, size.observations),
        "action": torch.rand(ROWS, size.actions) * 1.8 - 0.9,
        "next": following,
    }
    return make_replay_buffer(
        TensorDict(data, [ROWS]),
        batch_size=BATCH,
        seed=0,
        transform=StatePerturbation(1e-3, seed=0),
        device=device,
    )


def unpack(batch: TensorDictBase) -> Batch:
    """Return a batch as the plain reference reads it."""
    return Batch(
        state=batch["observation"],
        action=batch["action"],
        reward=batch["next", "reward"].squeeze(-1),
        next_state=batch["next", "observation"],
        done=batch["next", "done"].squeeze(-1),
        terminated=batch["next", "terminated"].squeeze(-1),
        perturbed=batch["perturbed", "observation"],
    )


def our_update(loss: LossModule, *, capturable: bool = False) -> Update:
    """Return the update that the README shows: one backward, one optimizer."""
    loss.make_value_estimator(gamma=GAMMA)
    updater = SoftUpdate(loss, tau=TAU)
    optimizer = torch.optim.Adam(
        loss.parameters(), lr=RATE, fused=True, capturable=capturable
    )

    def update(batch: TensorDictBase, casting: Casting) -> Iterator[str]:
        with casting():
            losses = loss(batch.copy())
        yield "forward"
        terms = [value for key, value in losses.items() if key.startswith("loss_")]
        sum(terms).backward()
        yield "backward"
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        yield "optimizer"
        updater.step()
        yield "targets"

    return update


def graph_update(loss: LossModule) -> Update:
    """Return :func:`our_update` as a CUDA graph, into whose batch others are copied."""
    update = our_update(loss, capturable=True)
    castings: list[Casting] = []

    def once(batch: TensorDictBase) -> TensorDictBase:
        for _ in update(batch, castings[-1]):
            pass
        return TensorDict({"updates": torch.ones_like(loss.log_alpha)})

    replayed = captured(once, loss)

    def update_graph(batch: TensorDictBase, casting: Casting) -> Iterator[str]:
        castings[:] = [casting]
        replayed(batch)
        yield "update"

    return update_graph


def our_loss(name: str, size: Size) -> LossModule:
    """Return one of the package's losses, with its defaults otherwise."""
    sizes = (size.observations, size.actions)
    cells = list(size.cells)
    actor = tanh_gaussian_actor(*sizes, num_cells=cells)
    model = tanh_gaussian_inverse_dynamics(*sizes, num_cells=cells)
    number = 10 if name == "OSR-10" else 2
    critics = critic_ensemble(*sizes, num_cells=cells, num_qvalue_nets=number)
    if name == "OSR-v":
        return OSRVLoss(actor, critics, model)
    if name == "CQL(H)":
        return OSRLoss(actor, critics, recovery_weight=0)
    if name == "OSR-10":
        return OSRLoss(
            actor, critics, model, min_q_weight=0, deterministic_backup=False
        )
    return OSRLoss(actor, critics, model)


def osr_products(
    size: Size, dtype: torch.dtype, device: torch.device
) -> tuple[list[Pass], int]:
    """Return OSR's matrix products, and how many operations they were counted to be.

    ``OSRLoss`` has two ways for many sampled actions, by network and device; the one
    that it takes is the one that has as many operations.
    """
    loss, batch = our_loss("OSR", size).to(device), make_buffer(size, device).sample()
    autocast = partial(torch.autocast, device.type, dtype=dtype)
    casting = nullcontext if dtype == torch.float32 else autocast
    update = our_update(loss)
    counted = count_flops(lambda: update(batch, casting))
    sizes = (size.observations, size.actions, size.cells)
    ways = [
        osr_passes(*sizes, batch=BATCH, num_random=NUM_RANDOM, chunk=chunk)
        for chunk in (None, loss.chunk_size)
    ]
    return min(ways, key=lambda way: abs(total_flops(way) - counted)), counted


def make_contender(
    name: str, size: Size, device: torch.device
) -> tuple[Update, list[Any]]:
    """Return an update and the batches that it reads, the same for every name."""
    buffer = make_buffer(size, device)
    batches = [buffer.sample() for _ in range(8)]
    if name == SAMPLING:

        def sample(*_: object) -> Iterator[str]:
            buffer.sample()
            yield "sampling"

        return sample, batches
    if name == PLAIN:
        sizes = (size.observations, size.actions, size.cells)
        plain = PlainOSR(*sizes, num_random=NUM_RANDOM, device=device)
        return plain.update, [unpack(batch) for batch in batches]
    if name in (PRODUCTS, PRODUCTS_BF16):
        dtype = torch.float32 if name == PRODUCTS else torch.bfloat16
        passes, _ = osr_products(size, dtype, device)
        return Products(passes, dtype, device).update, batches
    # CQL has no use for perturbed states, and needs not carry them.
    if name == TORCHRL:
        batches = [batch.exclude("perturbed") for batch in batches]
        sizes = (size.observations, size.actions, size.cells)
        update = cql_update(cql_loss(*sizes, num_random=NUM_RANDOM, device=device))
        return update, batches
    loss = our_loss(name, size).to(device)
    if not loss.recovers:
        batches = [batch.exclude("perturbed") for batch in batches]
    if name in (COMPILED, BOTH):
        loss.compile()
    if name in (GRAPH, BOTH):
        return graph_update(loss), batches
    return our_update(loss), batches
