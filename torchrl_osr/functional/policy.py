"""What the policy and the entropy temperature minimise.

Shapes: ``B`` batch (any leading dimensions), ``N`` critics, ``n`` number of discrete
actions.
"""

from __future__ import annotations

import torch
from torch import Tensor


def soft_policy_value(
    log_prob: Tensor, qvalue: Tensor, alpha: Tensor | float
) -> Tensor:
    r"""Return the policy's objective to be minimised, section 4.4.

    .. math::
        \alpha_e \log\pi(\hat a \mid \tilde s) - \min_i Q_i(\tilde s, \hat a)

    The paper prints :math:`+Q` in an objective to be minimised, which would seek
    the worst action; the entropy term is not printed but is in the authors' code
    (and in CQL, on which the method stands).

    Args:
        log_prob: log-density of the sampled action, ``[B]``.
        qvalue: values of that action, ``[N, B]``.
        alpha: entropy temperature, a scalar.

    Returns:
        ``[B]``.
    """
    return alpha * log_prob - qvalue.min(0).values


def discrete_policy_value(
    log_prob: Tensor, qvalue: Tensor, alpha: Tensor | float
) -> Tensor:
    r"""Return :func:`soft_policy_value` in expectation over all ``n`` actions.

    .. math::
        \sum_{a=1}^{n} \pi(a \mid \tilde s)
        \, [\alpha_e \log\pi(a \mid \tilde s) - \min_i Q_i(\tilde s, a)]

    "Soft Actor-Critic for Discrete Action Settings", https://arxiv.org/abs/1910.07207:
    nothing is sampled. With ``alpha=0`` it is minus the value of the state.

    Args:
        log_prob: normalised log-probabilities of the policy, ``[B, n]``.
        qvalue: values of every action, ``[N, B, n]``.
        alpha: entropy temperature, a scalar.

    Returns:
        ``[B]``.

    Examples:
        >>> qvalue = torch.tensor([[[2.0, 1.0]], [[3.0, 0.0]]])
        >>> discrete_policy_value(torch.tensor([[0.25, 0.75]]).log(), qvalue, 0.0)
        tensor([-0.5000])
    """
    prob = log_prob.exp()
    # 0 log 0 = 0, as in categorical_kl.
    log_prob = torch.where(prob > 0, log_prob, 0.0)
    return (prob * (alpha * log_prob - qvalue.min(0).values)).sum(-1)


def temperature_objective(
    log_alpha: Tensor, log_prob: Tensor, target_entropy: float
) -> Tensor:
    r"""Return SAC's objective for the entropy temperature, linear in its logarithm.

    .. math::
        -\log\alpha_e \, \big(\log\pi(\hat a \mid \tilde s) + \bar{\mathcal H}\big)

    Args:
        log_alpha: logarithm of the temperature, a scalar.
        log_prob: log-density of the policy's own action, ``[B]``; treated as constant.
        target_entropy: the entropy the policy should keep, in nats.

    Returns:
        ``[B]``.
    """
    return -log_alpha * (log_prob.detach() + target_entropy)
