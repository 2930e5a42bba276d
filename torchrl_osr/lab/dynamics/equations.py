"""Ensembles of probabilistic dynamics models.

Shapes: ``B`` batch (any leading dimensions), ``E`` networks of the ensemble, ``D``
predicted entries.
"""

from __future__ import annotations

import math

from torch import Tensor
from torch.linalg import vector_norm
from torch.nn.functional import softplus


def bounded_log_variance(value: Tensor, lowest: Tensor, highest: Tensor) -> Tensor:
    r"""Logarithm of a variance, brought smoothly between two bounds.

    .. math::
        v' = v_{max} - \operatorname{softplus}(v_{max} - v), \qquad
        v_{min} + \operatorname{softplus}(v' - v_{min})

    "Deep Reinforcement Learning in a Handful of Trials using Probabilistic Dynamics
    Models" (PETS), appendix A.1, https://arxiv.org/abs/1805.12114. The result is above
    ``lowest``, and exceeds ``highest`` by at most
    :math:`\log(1 + e^{v_{min} - v_{max}})`.

    Args:
        value: unbounded, ``[..., D]``.
        lowest, highest: bounds, ``[D]``.

    Examples:
        >>> import torch
        >>> bounds = torch.tensor(-10.0), torch.tensor(0.5)
        >>> values = torch.tensor([-100.0, -4.0, 100.0])
        >>> bounded_log_variance(values, *bounds).round(decimals=2)
        tensor([-10.0000,  -4.0100,   0.5000])
    """
    value = highest - softplus(highest - value)
    return lowest + softplus(value - lowest)


def gaussian_error(mean: Tensor, log_variance: Tensor, target: Tensor) -> Tensor:
    r"""Twice the negative log-likelihood of a diagonal Gaussian, averaged over entries.

    .. math::
        \frac1D \sum_{d=1}^{D} \frac{(\mu_d - y_d)^2}{\sigma_d^2} + \log \sigma_d^2

    without the constant :math:`\log 2\pi`: the objective of each network in "MOPO:
    Model-based Offline Policy Optimization", https://arxiv.org/abs/2005.13239, and its
    code (tianheyu927/mopo).

    Args:
        mean, log_variance: of the prediction, ``[B, D]``.
        target: ``[B, D]``.

    Returns:
        ``[B]``.
    """
    return ((mean - target).square() * (-log_variance).exp() + log_variance).mean(-1)


def disagreement(mean: Tensor) -> Tensor:
    r"""How far the predictions of an ensemble lie apart.

    .. math::
        \max_i \lVert \mu_i - \bar\mu \rVert_2

    The penalty of "MOReL" (https://arxiv.org/abs/2005.05951), there with the largest
    distance of any two networks.

    Args:
        mean: predictions, ``[E, B, D]``.

    Returns:
        ``[B]``, in the unit of the predictions.

    Examples:
        >>> import torch
        >>> disagreement(torch.tensor([[1.0, 0.0], [3.0, 0.0]]))
        tensor(1.)
    """
    distance: Tensor = vector_norm(mean - mean.mean(0), dim=-1)
    return distance.amax(0)


def largest_deviation(scale: Tensor) -> Tensor:
    r"""MOPO's estimate of a model's error, of which its penalty is a multiple.

    .. math::
        \max_i \lVert \sigma_i \rVert_2

    over all networks and all entries, that of the reward included, as in the code of
    https://arxiv.org/abs/2005.13239 (section 4.3: the maximum over the ensemble).

    Args:
        scale: predicted standard deviations, ``[E, B, D]``.

    Returns:
        ``[B]``, in the unit of the predictions.
    """
    deviation: Tensor = vector_norm(scale, dim=-1)
    return deviation.amax(0)


def adversarial_objective(log_prob: Tensor, advantage: Tensor) -> Tensor:
    r"""RAMBO's gradient of a model against the policy's value, to be minimised.

    .. math::
        \frac{A - \bar A}{\operatorname{std} A + 10^{-6}}\,
        \log \frac1E \sum_{i=1}^{E} p_i(s', r \mid s, a)

    "RAMBO-RL", https://arxiv.org/abs/2204.12581, equation (9) and its code
    (marc-rigter/rambo): transitions of a small advantage become more likely.

    Args:
        log_prob: of a sampled transition by each network, ``[E, B]``.
        advantage: :math:`A` of the transition, without gradient, ``[B]``.

    Returns:
        ``[B]``.
    """
    standardized = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
    return standardized * (log_prob.logsumexp(0) - math.log(len(log_prob)))
