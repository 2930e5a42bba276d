"""State correction: actions that a dynamics model takes back to the data.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation, ``n`` and ``m``
numbers of samples.
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


def maximum_mean_discrepancy(first: Tensor, second: Tensor, width: float) -> Tensor:
    r"""Squared maximum mean discrepancy of two samples, with a Gaussian kernel.

    .. math::
        \frac1{n^2} \sum_{i,j} k(x_i, x_j) + \frac1{m^2} \sum_{i,j} k(y_i, y_j)
        - \frac2{nm} \sum_{i,j} k(x_i, y_j), \quad
        k(x, y) = \exp\Big(-\frac{\|x - y\|^2}{2 h^2 S}\Big)

    "A Kernel Two-Sample Test", https://jmlr.org/papers/v13/gretton12a.html, the biased
    estimate. Samples much further apart than the width have no gradient.

    Args:
        first: :math:`x`, ``[n, B, S]``.
        second: :math:`y`, ``[m, B, S]``.
        width: :math:`h`, in units of one entry.

    Returns:
        ``[B]``, each entry between 0 and 2.

    Examples:
        >>> import torch
        >>> here, there = torch.zeros(3, 1), torch.full((3, 1), 2.0)
        >>> maximum_mean_discrepancy(here, there, width=1.0).item()
        1.7293294...
    """

    def kernel(x: Tensor, y: Tensor) -> Tensor:
        """Mean over all pairs, ``[B]``."""
        distance = (x.unsqueeze(1) - y.unsqueeze(0)).square().mean(-1)
        return (distance / (-2 * width**2)).exp().mean((0, 1))

    return kernel(first, first) + kernel(second, second) - 2 * kernel(first, second)
