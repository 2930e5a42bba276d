"""Accuracy of an inverse dynamics model on held-out rows."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    set_interaction_type,
)

from torchrl_osr.objectives.networks import ONE_HOT


@torch.no_grad()
def inverse_dynamics_report(
    inverse_dynamics_network: ProbabilisticTensorDictSequential, data: TensorDictBase
) -> dict[str, Any]:
    """Measure the accuracy on held-out data ``[N]``, without its ``done`` rows.

    Returns:
        ``"nll"``, mean negative log-likelihood in nats, and ``"rows"``. Of one-hot
        actions also ``"accuracy"``, share of rows whose action is the likeliest. Of
        continuous ones ``"r2"``, share of each action dimension's variance that the
        deterministic action explains.
    """
    data = data[~data.get(("next", "done")).squeeze(-1)]
    if not len(data):
        raise ValueError(
            "all held-out rows end an episode: hold out more rows (data.held_out=0.2); "
            "if all rows do, choose a loss without this model (loss=cql)."
        )
    # Latent variables at their mean, as the policy's losses use the model.
    with set_interaction_type(InteractionType.DETERMINISTIC):
        distribution = inverse_dynamics_network.get_dist(data)
    action = data.get("action")
    report = {"nll": -distribution.log_prob(action).mean().item(), "rows": len(data)}
    if isinstance(distribution, ONE_HOT):
        hits = (distribution.mode * action).sum(-1).double()
        return report | {"accuracy": hits.mean().item()}
    error = (action - distribution.deterministic_sample).square().sum(0)
    r2 = 1 - error / (action - action.mean(0)).square().sum(0)
    return report | {"r2": r2.tolist()}
