"""The inverse dynamics model inside a loss: run on D_tot, frozen where it teaches.

Shapes: ``B`` batch (any leading dimensions), ``D`` state sets of D_tot (2 or 1).
"""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    TensorDictParams,
    set_interaction_type,
)
from torch import Tensor
from torch.distributions import Distribution

from torchrl_osr.objectives.mixed_states import States, transitions


def freeze(params: TensorDictParams) -> TensorDictParams:
    """Return parameters as buffers: in the state dict, moved by ``.to()``, not trained.

    No optimizer that takes ``loss.parameters()`` can move the model then.
    """
    frozen = params.apply(lambda tensor: tensor.data, filter_empty=False)
    return TensorDictParams(frozen, no_convert=True)


@torch.no_grad()
def frozen_distribution(
    network: ProbabilisticTensorDictSequential,
    params: TensorDictParams,
    tensordict: TensorDictBase,
    *,
    done: Tensor,
    perturbed: NestedKey,
    states: States = "both",
) -> Distribution:
    """Return ``I(a | s~, s')``, ``[D, B]``, without gradient.

    A model with a latent variable
    (:func:`~torchrl_osr.modules.cvae_inverse_dynamics`) keeps it at its mean: what the
    policy is pulled to does not jitter from one call to the next.

    Args:
        network: the model.
        params: its parameters.
        tensordict: a batch ``[B]``.
        done: rows whose next state is not to be learnt from, bool ``[B]``.
        perturbed: where the perturbed twins are.
        states: ``"both"`` (default), ``"clean"`` or ``"perturbed"``.
    """
    batch = transitions(
        tensordict, network.in_keys, done=done, perturbed=perturbed, states=states
    )
    with (
        params.to_module(network, preserve_module_state=False),
        set_interaction_type(InteractionType.DETERMINISTIC),
    ):
        distribution: Distribution = network.get_dist(batch)
    return distribution
