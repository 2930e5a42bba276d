"""The updates that ``update_speed.py`` times: ours, TorchRL's CQL, plain PyTorch."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, TensorDictReplayBuffer
from torchrl.data.replay_buffers.storages import LazyTensorStorage
from torchrl.envs.utils import ExplorationType
from torchrl.modules import (
    MLP,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import CQLLoss as TorchRLCQLLoss
from torchrl.objectives import LossModule, SoftUpdate, group_optimizers

from torchrl_osr import CQLLoss, OSRLoss, OSRVLoss, StatePerturbation
from torchrl_osr.fast import FastUpdate
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from plain_osr import Batch, PlainOSR, unpack

Update = Callable[[Any], Any]

GAMMA, TAU, RATE, ROWS = 0.99, 5e-3, 3e-4, 100_000
PLAIN, TIGHT, TORCHRL, EAGER, COMPILED, LOOP, FAST_LOOP = (
    "plain PyTorch, OSR",
    "plain PyTorch, OSR, tight",
    "TorchRL's CQLLoss",
    "OSR, eager",
    "OSR, compiled",
    "drop-in loss",
    "drop-in loss + FastUpdate",
)
CONTENDERS = (
    *("OSR", EAGER, LOOP, FAST_LOOP, "CQL(H)", "OSR-v", "OSR-10"),
    *(TORCHRL, PLAIN, TIGHT),
)
DIMENSIONS = {"hopper": (11, 3), "walker2d": (17, 6), "halfcheetah": (17, 6)}


@dataclass(frozen=True)
class Size:
    """Sizes of a task, its networks and its batches.

    Attributes:
        observations, actions: of a transition.
        cells: hidden layers of all networks.
        batch: transitions of an update.
        num_random: ``K``, sampled actions of each kind.
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
        """Return the size named ``hopper-2x256``, or ``hopper-quick``: the preset."""
        task, _, layers = name.partition("-")
        if layers == "quick":
            return cls(*DIMENSIONS[task], (128, 128), 64, 4, layer_norm=True)
        depth, width = (int(number) for number in layers.split("x"))
        return cls(*DIMENSIONS[task], (width,) * depth)


def make_batches(size: Size, device: torch.device) -> list[TensorDictBase]:
    """Return eight batches of random transitions with perturbed states."""
    ends = torch.rand(ROWS, 1) < 2e-3
    data = {
        "observation": torch.randn(ROWS, size.observations),
        "action": torch.rand(ROWS, size.actions) * 1.8 - 0.9,
        "next": {
            "observation": torch.randn(ROWS, size.observations),
            "reward": torch.randn(ROWS, 1),
            "done": ends,
            "terminated": ends & (torch.rand(ROWS, 1) < 0.5),
        },
    }
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(ROWS), batch_size=size.batch
    )
    buffer.extend(TensorDict(data, [ROWS]))
    buffer.append_transform(StatePerturbation(1e-3, seed=0))
    return [buffer.sample().exclude("index").to(device) for _ in range(8)]


def our_loss(name: str, size: Size, device: torch.device) -> LossModule:
    """Return one of the package's losses."""
    sizes = size.observations, size.actions
    cells = {"num_cells": list(size.cells)}
    critics = critic_ensemble(
        *sizes,
        num_qvalue_nets=10 if name == "OSR-10" else 2,
        layer_norm=size.layer_norm,
        **cells,
    )
    actor = tanh_gaussian_actor(*sizes, **cells)
    inverse_dynamics = tanh_gaussian_inverse_dynamics(*sizes, **cells)
    if name == "OSR-v":
        loss = OSRVLoss(actor, critics, inverse_dynamics)
    elif name == "CQL(H)":
        loss = CQLLoss(actor, critics, num_random=size.num_random)
    elif name == "OSR-10":
        options = {"min_q_weight": 0, "deterministic_backup": False}
        loss = OSRLoss(actor, critics, inverse_dynamics, **options)
    else:
        loss = OSRLoss(actor, critics, inverse_dynamics, num_random=size.num_random)
    loss.make_value_estimator(gamma=GAMMA)
    return loss.to(device)


def our_update(loss: LossModule, *, traced: bool, fused: bool | None) -> Update:
    """Return the trainer's update: one backward, one optimizer, traced on a CPU."""
    updater = SoftUpdate(loss, tau=TAU)
    optimizer = torch.optim.Adam(loss.parameters(), lr=RATE, fused=fused)
    update = FastUpdate(loss, optimizer, updater, trace=traced, warm_up=2)
    return lambda batch: update(batch.copy())


def loop_update(loss: LossModule) -> Update:
    """Return the update of a plain TorchRL loop, with PyTorch's default Adam."""
    updater = SoftUpdate(loss, tau=TAU)
    optimizer = torch.optim.Adam(loss.parameters(), lr=RATE)

    def step(batch: TensorDictBase) -> None:
        losses = loss(batch.copy())
        sum(value for name, value in losses.items() if "loss_" in name).backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()

    return step


def tight_update(plain: PlainOSR) -> Update:
    """Return the plain update with one backward, one fused Adam and fused targets."""
    critics, targets = (
        [weight for each in networks for weight in each.parameters()]
        for networks in (plain.critics, plain.targets)
    )
    trained = [*plain.actor.parameters(), plain.log_alpha, *critics]
    optimizer = torch.optim.Adam(trained, lr=RATE, fused=True)

    def update(batch: Batch) -> None:
        noise, ended = plain.draw(batch.action), batch.terminated.unsqueeze(-1)
        next_state = torch.where(ended, batch.state, batch.next_state)
        batch = batch._replace(next_state=next_state)
        for each in critics:  # the actor's loss must not train them
            each.requires_grad_(False)
        losses = plain.actor_losses(batch, noise)
        for each in critics:
            each.requires_grad_(True)
        losses |= plain.critic_losses(batch, noise)
        sum(losses.values()).backward()
        optimizer.step()
        optimizer.zero_grad()
        with torch.no_grad():
            torch._foreach_lerp_(targets, critics, TAU)

    return update


def torchrl_update(size: Size, device: torch.device) -> Update:
    """Return the update of TorchRL's own offline script, behaviour cloning included.

    https://github.com/pytorch/rl/blob/main/sota-implementations/cql/cql_offline.py
    """
    observations, actions = size.observations, size.actions
    like = {"num_cells": size.cells, "activation_class": nn.ReLU, "device": device}
    head = nn.Sequential(
        MLP(observations, 2 * actions, **like),
        NormalParamExtractor(scale_mapping="biased_softplus_1.0", scale_lb=0.1),
    )
    low = -torch.ones(actions, device=device)
    actor = ProbabilisticActor(
        TensorDictModule(head, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=Bounded(low, -low),
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": -low, "tanh_loc": False},
        default_interaction_type=ExplorationType.RANDOM,
    )
    critic = MLP(observations + actions, 1, **like)
    loss = TorchRLCQLLoss(
        actor,
        ValueOperator(critic, ["observation", "action"]),
        loss_function="l2",
        deterministic_backup=False,
        num_random=size.num_random,
        with_lagrange=True,
        lagrange_thresh=5.0,
    )
    loss.make_value_estimator(gamma=GAMMA)
    updater = SoftUpdate(loss, tau=TAU)
    groups = [
        loss.actor_network_params.flatten_keys().values(),
        loss.qvalue_network_params.flatten_keys().values(),
        [loss.log_alpha],
        [loss.log_alpha_prime],
    ]
    optimizer = group_optimizers(*[torch.optim.Adam(group, RATE) for group in groups])
    terms = "loss_actor_bc", "loss_qvalue", "loss_cql", "loss_alpha", "loss_alpha_prime"

    def update(batch: TensorDictBase) -> None:
        losses = loss(batch.copy())
        sum(losses[term] for term in terms).backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        updater.step()

    return update


def make_contender(
    name: str, size: Size, device: torch.device
) -> tuple[Update, list[Any]]:
    """Return an update and the batches that it reads, the same for every name."""
    batches = make_batches(size, device)
    if name in (PLAIN, TIGHT):
        torch.set_default_device(device)  # each contender has its own process
        options = {"num_random": size.num_random, "layer_norm": size.layer_norm}
        plain = PlainOSR(size.observations, size.actions, list(size.cells), **options)
        rows = [unpack(batch) for batch in batches]
        return plain.update if name == PLAIN else tight_update(plain), rows
    if name == TORCHRL:
        update = torchrl_update(size, device)
        return update, [batch.exclude("perturbed") for batch in batches]
    loss = our_loss(name, size, device)
    if name == COMPILED:
        loss.compile()
    if ("perturbed", "observation") not in loss.in_keys:
        batches = [batch.exclude("perturbed") for batch in batches]
    if name == LOOP:
        return loop_update(loss), batches
    fused = None if name == FAST_LOOP else True  # None: PyTorch's default
    return our_update(loss, traced=name not in (EAGER, COMPILED), fused=fused), batches
