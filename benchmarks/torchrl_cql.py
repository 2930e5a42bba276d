"""TorchRL's CQL, set up and updated as in TorchRL's own offline script.

https://github.com/pytorch/rl/blob/main/sota-implementations/cql/cql_offline.py
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType
from torchrl.modules import (
    MLP,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import CQLLoss, SoftUpdate, group_optimizers


def cql_actor(
    observations: int, actions: int, cells: Sequence[int], device: torch.device
) -> ProbabilisticActor:
    """Policy of that script, with its narrowest standard deviation."""
    head = nn.Sequential(
        MLP(observations, 2 * actions, num_cells=cells, activation_class=nn.ReLU),
        NormalParamExtractor(scale_mapping="biased_softplus_1.0", scale_lb=0.1),
    )
    low = -torch.ones(actions, device=device)
    return ProbabilisticActor(
        TensorDictModule(head, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=Bounded(low, -low),
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": -low, "tanh_loc": False},
        default_interaction_type=ExplorationType.RANDOM,
    ).to(device)


def cql_loss(
    observations: int,
    actions: int,
    cells: Sequence[int],
    *,
    num_random: int,
    device: torch.device,
) -> CQLLoss:
    """TorchRL's CQL with the options of that script.

    Args:
        observations, actions: sizes of a state and of an action.
        cells: widths of the hidden layers of all networks.
        num_random: actions drawn of each kind.
        device: where all of it lies.
    """
    critic = MLP(observations + actions, 1, num_cells=cells, activation_class=nn.ReLU)
    return CQLLoss(
        cql_actor(observations, actions, cells, device),
        ValueOperator(critic, ["observation", "action"]).to(device),
        loss_function="l2",
        deterministic_backup=False,
        num_random=num_random,
        with_lagrange=True,
        lagrange_thresh=5.0,
    )


def cql_update(
    loss: CQLLoss, *, autocast: bool
) -> Callable[[TensorDictBase], Iterator[str]]:
    """Update of that script: four optimizers, and behaviour cloning.

    Which of the policy's two losses counts is chosen on the device: both are computed.
    """
    loss.make_value_estimator(gamma=0.99)
    updater, device = SoftUpdate(loss, tau=5e-3), loss.log_alpha.device
    groups = [
        loss.actor_network_params.flatten_keys().values(),
        loss.qvalue_network_params.flatten_keys().values(),
        [loss.log_alpha],
        [loss.log_alpha_prime],
    ]
    optimizer = group_optimizers(*[torch.optim.Adam(group, 3e-4) for group in groups])
    cloned_until, step = torch.tensor(40_000, device=device), 0

    def update(batch: TensorDictBase) -> Iterator[str]:
        nonlocal step
        now, step = torch.tensor(step, device=device), step + 1
        with torch.autocast(device.type, torch.bfloat16, enabled=autocast):
            losses = loss(batch.copy())
            actor = torch.where(
                now >= cloned_until, losses["loss_actor"], losses["loss_actor_bc"]
            )
            critic = losses["loss_qvalue"] + losses["loss_cql"]
            total = actor + critic + losses["loss_alpha"] + losses["loss_alpha_prime"]
        yield "forward"
        total.backward()
        yield "backward"
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        yield "optimizer"
        updater.step()
        yield "targets"

    return update
