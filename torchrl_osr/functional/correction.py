"""State correction: actions that a dynamics model takes back to the data.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation.
"""

from __future__ import annotations

from torch import Tensor


def value_gain_weight(
    value: Tensor, next_value: Tensor, *, temperature: float, largest: float
) -> Tensor:
    r"""Weight of a transition by how much the value rises along it.

    .. math::
        \min\big( e^{\tau\,(V(s') - V(s))},\, w_{max} \big)

    "Offline Reinforcement Learning with OOD State Correction and OOD Action
    Suppression" (SCAS), https://arxiv.org/abs/2410.19400.

    Args:
        value, next_value: of the state and of the next one, ``[B]``.
        temperature: :math:`\tau`; with 0 every transition counts alike.
        largest: :math:`w_{max}`.

    Returns:
        ``[B]``.

    Examples:
        >>> import torch
        >>> values = torch.tensor([1.0, 1.0]), torch.tensor([0.8, 9.0])
        >>> value_gain_weight(*values, temperature=5.0, largest=50.0)
        tensor([ 0.3679, 50.0000])
    """
    return (temperature * (next_value - value)).exp().clamp(max=largest)


def correction_error(predicted: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    r"""Weighted distance of a predicted state from the one to come back to.

    .. math::
        w\,\frac1S \sum_{d=1}^{S} (\hat s'_d - s'_d)^2

    the state correction of SCAS, https://arxiv.org/abs/2410.19400.

    Args:
        predicted: where the model says that the policy's action leads, ``[B, S]``.
        target: the data's next state, ``[B, S]``.
        weight: see :func:`value_gain_weight`, ``[B]``.

    Returns:
        ``[B]``.
    """
    return weight * (predicted - target).square().mean(-1)
