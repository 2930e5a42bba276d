"""The updates that ``update_speed.py`` times: ours, TorchRL's CQL, the plain reference.

Each is a generator that does one update and names each part of it when it is done, so
that one clock outside can tell the parts apart. Losses are computed under bfloat16
autocast where ``autocast`` says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from matmul_bound import Pass, Products, count_flops, osr_passes, total_flops
from plain_reference import Batch, PlainOSR
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CudaGraphModule
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

Update = Callable[[Any], Iterator[str]]

GAMMA, TAU, RATE, BATCH, NUM_RANDOM, ROWS = 0.99, 5e-3, 3e-4, 256, 10, 100_000
OURS = ("OSR", "CQL(H)", "OSR-v", "OSR-10")
TORCHRL, PLAIN, PRODUCTS, SAMPLING = (
    "TorchRL CQL",
    "plain OSR",
    "products",
    "sampling",
)
COMPILED, GRAPH, BOTH = "OSR, compiled", "OSR, graph", "OSR, graph and compiled"
ON_GPU = (COMPILED, GRAPH, BOTH)
"""Those that take part on a GPU only."""
DIMENSIONS = {"hopper": (11, 3), "walker2d": (17, 6), "halfcheetah": (17, 6)}


@dataclass(frozen=True)
class Size:
    """A task's dimensions and the hidden layers of all networks."""

    observations: int
    actions: int
    cells: tuple[int, ...]

    @classmethod
    def parse(cls, name: str) -> Size:
        """Size of a name such as ``hopper-2x256``."""
        task, _, layers = name.partition("-")
        depth, width = (int(number) for number in layers.split("x"))
        return cls(*DIMENSIONS[task], (width,) * depth)


def make_buffer(size: Size, device: torch.device) -> ReplayBuffer:
    """Replay buffer of the package, with random transitions and perturbed states."""
    ends = torch.rand(ROWS, 1) < 2e-3
    next_step = {
        "observation": torch.randn(ROWS, size.observations),
        "reward": torch.randn(ROWS, 1),
        "done": ends,
        "terminated": ends & (torch.rand(ROWS, 1) < 0.5),
    }
    data = {
        "observation": torch.randn(ROWS, size.observations),
        "action": torch.rand(ROWS, size.actions) * 1.8 - 0.9,
        "next": next_step,
    }
    return make_replay_buffer(
        TensorDict(data, [ROWS]),
        batch_size=BATCH,
        seed=0,
        transform=StatePerturbation(1e-3, seed=0),
        device=device,
    )


def unpack(batch: TensorDictBase) -> Batch:
    """Batch as the plain reference reads it."""
    return Batch(
        state=batch["observation"],
        action=batch["action"],
        reward=batch["next", "reward"].squeeze(-1),
        next_state=batch["next", "observation"],
        done=batch["next", "done"].squeeze(-1),
        terminated=batch["next", "terminated"].squeeze(-1),
        perturbed=batch["perturbed", "observation"],
    )


def our_loss(name: str, size: Size, device: torch.device) -> LossModule:
    """One of the package's losses, with its defaults otherwise."""
    options: dict[str, Any] = {"num_cells": list(size.cells)}
    critics = critic_ensemble(
        size.observations,
        size.actions,
        num_qvalue_nets=10 if name == "OSR-10" else 2,
        **options,
    )
    if device.type == "cuda":
        # TorchRL copies bounds that are numbers from the host at every call, which a
        # CUDA graph cannot repeat.
        high = torch.ones(size.actions, device=device)
        options |= {"low": -high, "high": high}
    actor = tanh_gaussian_actor(size.observations, size.actions, **options)
    inverse_dynamics = tanh_gaussian_inverse_dynamics(
        size.observations, size.actions, **options
    )
    if name == "OSR-v":
        loss = OSRVLoss(actor, critics, inverse_dynamics)
    elif name == "CQL(H)":
        loss = OSRLoss(actor, critics, recovery_weight=0, actor_states="clean")
    elif name == "OSR-10":
        loss = OSRLoss(
            actor,
            critics,
            inverse_dynamics,
            min_q_weight=0,
            deterministic_backup=False,
        )
    else:
        loss = OSRLoss(actor, critics, inverse_dynamics)
    return loss.to(device)


def our_update(
    loss: LossModule, device: torch.device, *, autocast: bool, capturable: bool = False
) -> Update:
    """The update that the README shows: one backward, one optimizer."""
    loss.make_value_estimator(gamma=GAMMA)
    updater = SoftUpdate(loss, tau=TAU)
    optimizer = torch.optim.Adam(
        loss.parameters(), lr=RATE, fused=True, capturable=capturable
    )

    def update(batch: TensorDictBase) -> Iterator[str]:
        with torch.autocast(device.type, torch.bfloat16, enabled=autocast):
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


def graph_update(loss: LossModule, device: torch.device, *, autocast: bool) -> Update:
    """:func:`our_update` as a CUDA graph, after five updates without."""
    update = our_update(loss, device, autocast=autocast, capturable=True)

    def whole(batch: TensorDictBase) -> None:
        for _ in update(batch):
            pass

    graph = CudaGraphModule(whole, warmup=5, in_keys=[], out_keys=[], device=device)

    def replay(batch: TensorDictBase) -> Iterator[str]:
        graph(batch)
        yield "update"

    return replay


def osr_products(
    size: Size, device: torch.device, *, autocast: bool
) -> tuple[list[Pass], int]:
    """Matrix products of OSR's update, and the floating point operations counted in it.

    ``OSRLoss`` has two ways for many sampled actions, by network and device; the one
    that it takes is the one that has as many operations.
    """
    loss, batch = our_loss("OSR", size, device), make_buffer(size, device).sample()
    update = our_update(loss, device, autocast=autocast)
    counted = count_flops(lambda: update(batch))
    sizes = (size.observations, size.actions, size.cells)
    ways = [
        osr_passes(*sizes, batch=BATCH, num_random=NUM_RANDOM, chunk=chunk)
        for chunk in (None, loss.chunk_size)
    ]
    return min(ways, key=lambda way: abs(total_flops(way) - counted)), counted


def make_contender(
    name: str, size: Size, device: torch.device, *, autocast: bool
) -> tuple[Update, list[Any]]:
    """An update and the batches that it reads, the same for every name."""
    buffer = make_buffer(size, device)
    batches = [buffer.sample() for _ in range(8)]
    sizes = (size.observations, size.actions, size.cells)
    if name == SAMPLING:

        def sample(_: object) -> Iterator[str]:
            buffer.sample()
            yield "sampling"

        return sample, batches
    if name == PLAIN:
        plain = PlainOSR(
            *sizes, num_random=NUM_RANDOM, device=device, autocast=autocast
        )
        return plain.update, [unpack(batch) for batch in batches]
    if name == PRODUCTS:
        passes, _ = osr_products(size, device, autocast=autocast)
        dtype = torch.bfloat16 if autocast else torch.float32
        return Products(passes, dtype, device).update, batches
    if name == TORCHRL:
        loss = cql_loss(*sizes, num_random=NUM_RANDOM, device=device)
        update = cql_update(loss, autocast=autocast)
    else:
        loss = our_loss(name, size, device)
        if name in (COMPILED, BOTH):
            loss.compile()
        make_update = graph_update if name in (GRAPH, BOTH) else our_update
        update = make_update(loss, device, autocast=autocast)
    # What a loss does not read, it need not carry.
    if ("perturbed", "observation") not in loss.in_keys:
        batches = [batch.exclude("perturbed") for batch in batches]
    return update, batches
