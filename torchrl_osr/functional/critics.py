"""Objectives of the critics.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``M``
sampled actions of one state.
"""

from __future__ import annotations

import torch
from torch import Tensor


def soft_maximum(
    qvalue: Tensor, log_prob: Tensor, *, temperature: float = 1.0
) -> Tensor:
    r"""Log-sum-exp of the values of sampled actions, weighted by their densities.

    .. math::
        \tau \log \sum_{j=1}^{M} \exp\big(Q(s, a_j) / \tau\big) / p(a_j)

    Each weight :math:`1/p` makes a term an unbiased estimate of
    :math:`\int e^{Q(s, a) / \tau} da`. Other codes divide the log-density by
    :math:`\tau` too, which for :math:`\tau \ne 1` is the weight
    :math:`p^{-1/\tau}`; with the default both are the same.

    Args:
        qvalue: values of the sampled actions, ``[B, M]``.
        log_prob: log-density of each action under what drew it, ``[B, M]``.
        temperature: :math:`\tau`, in units of the value.

    Returns:
        ``[B]``.

    Examples:
        >>> two_uniform_actions = torch.tensor([1.0, 3.0])
        >>> density = torch.tensor([0.5, 0.5]).log()
        >>> round(soft_maximum(two_uniform_actions, density).item(), 4)
        3.8201
    """
    return temperature * torch.logsumexp(qvalue / temperature - log_prob, -1)


def conservative_gap(soft_maximum: Tensor, data_qvalue: Tensor) -> Tensor:
    r"""CQL(H) penalty: by how much sampled actions are valued above the data's.

    .. math::
        \tau \log \sum_{j=1}^{M} \exp\big(Q(s, a_j) / \tau\big) / p(a_j) - Q(s, a)

    with ``M = 3K`` actions: uniform, from ``pi(s)`` and from ``pi(s')``, *all scored
    at* ``s`` and all in one log-sum-exp ("Conservative Q-Learning", Kumar et al.
    2020, appendix F, https://arxiv.org/abs/2006.04779). The paper prints the simpler
    (3); its authors' code, like the reference CQL code, computes this. As there, the
    sum is not divided by ``M``: a constant, without effect on the gradient.

    TorchRL 0.14.1 ``CQLLoss`` differs: it takes the log-sum-exp over three actions at
    a time and scores the actions of ``pi(s')`` at ``s'``.

    Args:
        soft_maximum: the first term, see :func:`soft_maximum`, ``[B]``.
        data_qvalue: value of the data's action, ``[B]``.

    Returns:
        ``[B]``.
    """
    return soft_maximum - data_qvalue


def lagrange_terms(
    gap: Tensor, log_multiplier: Tensor, threshold: float
) -> tuple[Tensor, Tensor]:
    r"""Both sides of CQL's Lagrangian, each to be minimised.

    .. math::
        \max_{\alpha' \ge 0} \min_Q \; \alpha' \, (\text{gap}(Q) - \tau)

    CQL's appendix F (https://arxiv.org/abs/2006.04779). The multiplier is constant in
    the critics' term and the gap is constant in the multiplier's, so that one backward
    over the sum of both moves each the right way. TorchRL 0.14.1 ``CQLLoss`` detaches
    neither: there the multiplier's loss raises the gap.

    Args:
        gap: the conservative gap, ``[B]``.
        log_multiplier: :math:`\log\alpha'`, a scalar.
        threshold: :math:`\tau`, the gap that is tolerated, in units of the value.

    Returns:
        The critics' term and the multiplier's, each ``[B]``.
    """
    # The bound is that of the reference code: a gap that cannot be closed would let
    # the multiplier overflow.
    multiplier = log_multiplier.exp().clamp(max=1e6)
    excess = gap - threshold
    return multiplier.detach() * excess, -multiplier * excess.detach()


def value_constraint(
    policy_qvalue: Tensor,
    inverse_dynamics_qvalue: Tensor,
    *,
    log_prob: Tensor | None = None,
    temperature: float = 1.0,
) -> Tensor:
    r"""OSR-v constraint on the values, equation (8).

    .. math::
        \mathbb E_{\hat a \sim \pi(\tilde s)} Q(\tilde s, \hat a)
        - \mathbb E_{a \sim I(\tilde s, s')} Q(\tilde s, a)

    Minimised over Q, it lowers actions with unknown consequences and raises those that
    lead to ``s'``. With ``log_prob`` the first expectation is a log-sum-exp over
    importance-weighted actions instead (:func:`soft_maximum`): our addition, which
    puts the weight on the actions that Q overrates. The paper's difference is linear
    in Q, so that it has no minimum. Ours estimates, up to the constant :math:`\log M`,
    :math:`\log\int e^{Q} da - \mathbb E_I Q`, which is never below the model's entropy.

    Args:
        policy_qvalue: values of the sampled actions at ``s~``, ``[B, M]``.
        inverse_dynamics_qvalue: values of the model's actions at ``s~``, ``[B, K]``.
        log_prob: log-density of each sampled action under what drew it, ``[B, M]``.
            Default ``None``, the paper's plain mean.
        temperature: of the log-sum-exp, in units of the value.

    Returns:
        ``[B]``.
    """
    target = inverse_dynamics_qvalue.mean(-1)
    if log_prob is None:
        return policy_qvalue.mean(-1) - target
    return soft_maximum(policy_qvalue, log_prob, temperature=temperature) - target


def gradient_diversity(action_gradients: Tensor) -> Tensor:
    r"""EDAC similarity of the critics' action gradients, to be minimised.

    .. math::
        \frac{1}{N - 1} \sum_{i \ne j} \Big\langle
            \frac{\nabla_a Q_i(s, a)}{\|\nabla_a Q_i(s, a)\|},
            \frac{\nabla_a Q_j(s, a)}{\|\nabla_a Q_j(s, a)\|} \Big\rangle

    "Uncertainty-Based Offline Reinforcement Learning with Diversified Q-Ensemble" (An
    et al. 2021), https://arxiv.org/abs/2110.01548.

    Args:
        action_gradients: of each critic at the data's action, ``[N, B, A]``,
            ``N >= 2``.

    Returns:
        ``[B]``, between -N / (N - 1) and N.
    """
    number = action_gradients.shape[0]
    # Without eps: a dead critic's zero gradient would be 0 / 0.
    unit = torch.nn.functional.normalize(action_gradients, dim=-1, eps=1e-10)
    # All pairs at once: |sum_i g_i|^2 - sum_i |g_i|^2, with |g_i| = 1.
    pairs = unit.sum(0).square().sum(-1) - unit.square().sum((0, -1))
    return pairs / (number - 1)


def value_smoothness(difference: Tensor, tau: float = 0.2) -> Tensor:
    r"""RORL penalty of a change of the values around a state, to be minimised.

    .. math::
        \max_j \frac1N \sum_i (1 - \tau) \max(d_{ij}, 0)^2 + \tau \min(d_{ij}, 0)^2,
        \quad d_{ij} = Q_i(\hat s_j, a) - Q_i(s, a)

    "RORL: Robust Offline Reinforcement Learning via Conservative Smoothing" (Yang et
    al. 2022), https://arxiv.org/abs/2206.02829, as its released code has it.

    Args:
        difference: :math:`d_{ij}` of ``M`` perturbed states, ``[N, M, B]``.
        tau: weight of values that fall, against those that rise.

    Returns:
        ``[B]``.

    Examples:
        >>> value_smoothness(torch.tensor([[[1.0], [-1.0]]])).tolist()
        [0.800000011920929]
    """
    rise, fall = difference.clamp(min=0).square(), difference.clamp(max=0).square()
    return ((1 - tau) * rise + tau * fall).mean(0).amax(0)


def uncertainty_penalty(qvalue: Tensor, weight: Tensor | float) -> Tensor:
    r"""RORL penalty of actions that the critics do not agree on, to be minimised.

    .. math::
        \frac1N \sum_i \big( Q_i - [Q_i - \lambda\, \text{std}_i Q_i] \big)^2

    The bracket is a target without gradient: the more the critics disagree, the further
    each is pulled down. Source: see :func:`value_smoothness`.

    Args:
        qvalue: ``[N, B]``, ``N >= 2``.
        weight: :math:`\lambda`.

    Returns:
        ``[B]``.
    """
    target = (qvalue - weight * qvalue.std(0)).detach()
    return (qvalue - target).square().mean(0)
