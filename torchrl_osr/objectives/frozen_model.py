"""How a loss runs its networks: the frozen inverse dynamics model, half precision.

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


def full_precision(output: TensorDictBase) -> TensorDictBase:
    """Return what layers wrote in half precision, under autocast, as float32.

    Densities, divergences and log-sum-exps are differences of large numbers: they are
    computed from it in float32.
    """
    if not (torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled("cuda")):
        return output
    half = (torch.bfloat16, torch.float16)
    return output.apply(lambda value: value.float() if value.dtype in half else value)


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
        output = full_precision(network.get_dist_params(batch))
    distribution: Distribution = network.build_dist_from_params(output)
    return distribution
