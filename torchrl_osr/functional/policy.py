"""Objectives of the policy and of the entropy temperature, and the bootstrap value.

Shapes: ``B`` batch (any leading dimensions), ``N`` critics, ``n`` number of discrete
actions.
"""

from __future__ import annotations

import torch
from torch import Tensor


def soft_policy_value(
    log_prob: Tensor, qvalue: Tensor, alpha: Tensor | float
) -> Tensor:
    r"""SAC objective of the policy, to be minimised, section 4.4.

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


def bootstrap_value(
    qvalue: Tensor, log_prob: Tensor | None = None, alpha: Tensor | float = 0.0
) -> Tensor:
    r"""Pessimistic value of the next state, :math:`V(s')` of the target (2).

    .. math::
        \min_i \bar Q_i(s', a') - \alpha_e \log\pi(a' \mid s'),
        \quad a' \sim \pi(s')

    The target itself, :math:`r + \gamma\,(1 - \text{terminated})\,V(s')`, is that of
    TorchRL's value estimator.

    Args:
        qvalue: target critics' values of the action, ``[N, B]``.
        log_prob: log-density of the action, ``[B]``, for SAC's target with its
            entropy. Default ``None``, the paper's.
        alpha: entropy temperature, a scalar.

    Returns:
        ``[B]``.

    Examples:
        >>> bootstrap_value(torch.tensor([[1.0, 4.0], [2.0, 3.0]]))
        tensor([1., 3.])
    """
    value = qvalue.min(0).values
    return value if log_prob is None else value - alpha * log_prob


def discrete_policy_value(
    log_prob: Tensor, qvalue: Tensor, alpha: Tensor | float
) -> Tensor:
    r""":func:`soft_policy_value` in expectation over all ``n`` actions.

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
    r"""SAC objective of the entropy temperature, linear in its logarithm.

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


def cloning_error(action: Tensor, data_action: Tensor) -> Tensor:
    r"""Mean squared distance of an action from the data's, in squared action units.

    .. math::
        \frac1A \sum_d (\pi_d(s) - a_d)^2

    Args:
        action: of a deterministic policy, ``[B, A]``.
        data_action: ``[B, A]``.

    Returns:
        ``[B]``.
    """
    return (action - data_action).square().mean(-1)


def td3_bc_objective(
    qvalue: Tensor, cloning_error: Tensor, magnitude: Tensor, alpha: float
) -> Tensor:
    r"""TD3+BC objective of the policy, to be minimised.

    .. math::
        \frac1A \|\pi(s) - a\|^2
        - \frac{\alpha}{\mathbb E_D |Q(s, \pi(s))|}\, Q(s, \pi(s))

    "A Minimalist Approach to Offline Reinforcement Learning",
    https://arxiv.org/abs/2106.06860, equations (3) to (5).

    Args:
        qvalue: value of the policy's action, ``[B]``.
        cloning_error: see :func:`cloning_error`, ``[B]``.
        magnitude: :math:`\mathbb E_D |Q(s, \pi(s))|`, a scalar without gradient.
        alpha: weight of the values.

    Returns:
        ``[B]``.

    Examples:
        >>> one = torch.ones(1)
        >>> td3_bc_objective(4 * one, 0.5 * one, magnitude=2 * one, alpha=2.5)
        tensor([-4.5000])
    """
    return cloning_error - alpha / magnitude * qvalue


def action_distance(action: Tensor, data_action: Tensor) -> Tensor:
    r"""Squared distance of an action from the data's, in squared action units.

    .. math::
        \|a - a_D\|^2 = \sum_d (a_d - a_{D,d})^2

    Args:
        action: ``[B, A]``.
        data_action: ``[B, A]``.

    Returns:
        ``[B]``.
    """
    return (action - data_action).square().sum(-1)


def rebrac_objective(
    qvalue: Tensor, distance: Tensor, magnitude: Tensor, weight: float
) -> Tensor:
    r"""ReBRAC objective of the policy, to be minimised.

    .. math::
        \beta_1 \|\pi(s) - a\|^2
        - \frac{\min_i Q_i(s, \pi(s))}{\mathbb E_D |\min_i Q_i(s, \pi(s))|}

    "Revisiting the Minimalist Approach to Offline Reinforcement Learning",
    https://arxiv.org/abs/2305.09836, as its released code has it: the paper prints no
    normaliser, and the code divides by it.

    Args:
        qvalue: the critics' smallest value of the policy's action, ``[B]``.
        distance: of that action from the data's, see :func:`action_distance`, ``[B]``.
        magnitude: the normaliser, a scalar without gradient.
        weight: :math:`\beta_1`.

    Returns:
        ``[B]``.

    Examples:
        >>> one = torch.ones(1)
        >>> rebrac_objective(4 * one, 3 * one, magnitude=2 * one, weight=0.5)
        tensor([-0.5000])
    """
    return weight * distance - qvalue / magnitude
