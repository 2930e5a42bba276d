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
from torchrl.objectives import LossModule
from torchrl_cql import cql_loss, cql_update

from torchrl_osr import OSRLoss, OSRVLoss, StatePerturbation
from torchrl_osr.fast.traced_update import LossGradients
from torchrl_osr.lab.data import make_replay_buffer
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.trainers import SoftUpdate

Update = Callable[[Any], Iterator[str]]

GAMMA, TAU, RATE, ROWS = 0.99, 5e-3, 3e-4, 100_000
OURS = ("OSR", "CQL(H)", "OSR-v", "OSR-10")
TORCHRL, PLAIN, PRODUCTS, SAMPLING = (
    "TorchRL CQL",
    "plain OSR",
    "products",
    "sampling",
)
EAGER = "OSR, not recorded"
COMPILED, GRAPH, BOTH = "OSR, compiled", "OSR, graph", "OSR, graph and compiled"
ON_GPU = (COMPILED, GRAPH, BOTH)
"""Those that take part on a GPU only."""
DIMENSIONS = {"hopper": (11, 3), "walker2d": (17, 6), "halfcheetah": (17, 6)}


@dataclass(frozen=True)
class Size:
    """A task's dimensions, and the sizes of networks and batches.

    Attributes:
        observations, actions: of a transition.
        cells: the hidden layers of all networks.
        batch: transitions of an update.
        num_random: ``K``, actions drawn of each kind.
        layer_norm: whether the critics have layer normalisation.
    """

    observations: int
    actions: int
    cells: tuple[int, ...]
    batch: int = 256
    num_random: int = 10
    layer_norm: bool = False

    @classmethod
    def parse(cls, name: str) -> Size:
        """Size of a name such as ``hopper-2x256``, or ``hopper-quick``: that preset."""
        task, _, layers = name.partition("-")
        if layers == "quick":
            return cls(*DIMENSIONS[task], (128, 128), 64, 4, layer_norm=True)
        depth, width = (int(number) for number in layers.split("x"))
        return cls(*DIMENSIONS[task], (width,) * depth)

    @property
    def sizes(self) -> tuple[int, int, tuple[int, ...]]:
        """Of an observation, an action and the hidden layers."""
        return self.observations, self.actions, self.cells


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
        batch_size=size.batch,
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
        layer_norm=size.layer_norm,
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
    number = {"num_random": size.num_random}
    if name == "OSR-v":
        loss = OSRVLoss(actor, critics, inverse_dynamics)
    elif name == "CQL(H)":
        loss = OSRLoss(
            actor, critics, recovery_weight=0, actor_states="clean", **number
        )
    elif name == "OSR-10":
        loss = OSRLoss(
            actor,
            critics,
            inverse_dynamics,
            min_q_weight=0,
            deterministic_backup=False,
        )
    else:
        loss = OSRLoss(actor, critics, inverse_dynamics, **number)
    return loss.to(device)


def our_update(
    loss: LossModule,
    device: torch.device,
    *,
    autocast: bool,
    record: bool = True,
    capturable: bool = False,
) -> Update:
    """The trainer's update: one backward, one optimizer, losses recorded on a CPU."""
    loss.make_value_estimator(gamma=GAMMA)
    updater = SoftUpdate(loss, tau=TAU)
    optimizer = torch.optim.Adam(
        loss.parameters(), lr=RATE, fused=True, capturable=capturable
    )

    gradients = LossGradients(
        loss, torch.bfloat16 if autocast else None, record=record, warm_up=2
    )

    def update(batch: TensorDictBase) -> Iterator[str]:
        gradients(batch.copy())
        yield "forward and backward"
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
    update = our_update(loss, device, autocast=autocast, record=False)
    counted = count_flops(lambda: update(batch))
    counts = {"batch": size.batch, "num_random": size.num_random}
    ways = [
        osr_passes(*size.sizes, **counts, chunk=chunk)
        for chunk in (None, loss.chunk_size)
    ]
    return min(ways, key=lambda way: abs(total_flops(way) - counted)), counted


def make_contender(
    name: str, size: Size, device: torch.device, *, autocast: bool
) -> tuple[Update, list[Any]]:
    """An update and the batches that it reads, the same for every name."""
    buffer = make_buffer(size, device)
    batches = [buffer.sample() for _ in range(8)]
    if name == SAMPLING:

        def sample(_: object) -> Iterator[str]:
            buffer.sample()
            yield "sampling"

        return sample, batches
    if name == PLAIN:
        plain = PlainOSR(
            *size.sizes,
            num_random=size.num_random,
            layer_norm=size.layer_norm,
            device=device,
            autocast=autocast,
        )
        return plain.update, [unpack(batch) for batch in batches]
    if name == PRODUCTS:
        passes, _ = osr_products(size, device, autocast=autocast)
        dtype = torch.bfloat16 if autocast else torch.float32
        return Products(passes, dtype, device).update, batches
    if name == TORCHRL:
        loss = cql_loss(*size.sizes, num_random=size.num_random, device=device)
        update = cql_update(loss, autocast=autocast)
    else:
        loss = our_loss(name, size, device)
        if name in (COMPILED, BOTH):
            loss.compile()
        if name in (GRAPH, BOTH):
            update = graph_update(loss, device, autocast=autocast)
        else:
            record = name != EAGER
            update = our_update(loss, device, autocast=autocast, record=record)
    # What a loss does not read, it need not carry.
    if ("perturbed", "observation") not in loss.in_keys:
        batches = [batch.exclude("perturbed") for batch in batches]
    return update, batches
