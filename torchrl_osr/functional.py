"""The paper's equations as pure tensor functions.

"Recovering from Out-of-sample States via Inverse Dynamics in Offline Reinforcement
Learning" (Jiang et al., NeurIPS 2023), https://openreview.net/forum?id=4gLWjSaw4o

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``M``
sampled actions of one state, ``n`` discrete actions. Every function returns one number
a sample, ``[B]`` unless it says otherwise; the loss modules weigh and reduce.
Departures from the printed paper are marked, with the reason.

Symbols: ``pi`` policy, ``I`` inverse dynamics model, ``s`` clean state, ``s^``
perturbed state, ``s~`` a state of the mixed data set (clean and perturbed).
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor


def gaussian_kl(
    loc_p: Tensor,
    scale_p: Tensor,
    loc_q: Tensor | float = 0.0,
    scale_q: Tensor | float = 1.0,
) -> Tensor:
    r"""Return :math:`KL(p \,\|\, q)` of diagonal Gaussians, one number a dimension.

    .. math::
        \log\frac{\sigma_q}{\sigma_p}
        + \frac{\sigma_p^2 + (\mu_p - \mu_q)^2}{2\sigma_q^2} - \frac12

    It is also the divergence of the two *tanh*-Gaussians with these pre-tanh
    parameters and equal bounds, because a bijection leaves the KL unchanged. Means,
    standard deviations and the result are ``[B, A]``. Default ``q``: ``N(0, 1)``.

    Examples:
        >>> p, q = torch.tensor([0.4]), torch.tensor([-0.2])
        >>> kl = gaussian_kl(p, torch.tensor([0.3]), q, torch.tensor([0.5]))
        >>> round(kl.item(), 6)
        0.910826
    """
    ratio = (scale_p / scale_q).square()
    # log(x) / 2 of the squared ratio: one logarithm, and exactly 0 for p == q.
    return 0.5 * (ratio + ((loc_p - loc_q) / scale_q).square() - 1 - ratio.log())


def categorical_kl(log_prob_p: Tensor, log_prob_q: Tensor) -> Tensor:
    r"""Return :math:`KL(p \,\|\, q)` of categorical distributions.

    .. math::
        \sum_a p(a) \, [\log p(a) - \log q(a)]

    An action with ``p = 0`` adds nothing, whatever its ``q``. An action with ``q = 0``
    alone makes the divergence infinite. Log-probabilities are normalised, ``[B, n]``.
    """
    prob = log_prob_p.exp()
    # Selected before the product, not after: the gradient of 0 * inf would be nan.
    log_prob_p = torch.where(prob > 0, log_prob_p, 0.0)
    log_prob_q = torch.where(prob > 0, log_prob_q, 0.0)
    return (prob * (log_prob_p - log_prob_q)).sum(-1)


def state_recovery(
    policy_loc: Tensor,
    policy_scale: Tensor,
    inverse_dynamics_loc: Tensor,
    inverse_dynamics_scale: Tensor,
    *,
    direction: Literal["forward", "reverse"] = "forward",
    action_reduction: Literal["sum", "mean"] = "sum",
) -> Tensor:
    r"""Return the state-recovery term :math:`L_{sr}`, equations (11) and (12).

    .. math::
        KL\big(I(a \mid \tilde s, s') \,\|\, \pi(a \mid \tilde s)\big)

    The paper prints (12) with :math:`\log(\sigma_I / \sigma_\pi)`, which falls
    without bound as :math:`\sigma_\pi` grows, and without the constant -1/2.
    Implemented is the divergence of (11), with :math:`\log(\sigma_\pi / \sigma_I)`.

    Args:
        policy_loc, policy_scale: pre-tanh policy at ``s~``, ``[B, A]``.
        inverse_dynamics_loc, inverse_dynamics_scale: pre-tanh inverse dynamics
            model at ``(s~, s')``, ``[B, A]``.
        direction: ``"forward"`` is the paper's ``KL(I || pi)``, ``"reverse"`` the
            ``KL(pi || I)`` of the authors' released code.
        action_reduction: ``"sum"`` over action dimensions as in (12), ``"mean"`` as
            in the released code.
    """
    policy = (policy_loc, policy_scale)
    model = (inverse_dynamics_loc, inverse_dynamics_scale)
    pair = {"forward": (*model, *policy), "reverse": (*policy, *model)}[direction]
    divergence = gaussian_kl(*pair)
    return {"sum": torch.sum, "mean": torch.mean}[action_reduction](divergence, -1)


def soft_policy_value(
    log_prob: Tensor, qvalue: Tensor, alpha: Tensor | float
) -> Tensor:
    r"""Return SAC's objective of the policy, to be minimised, section 4.4.

    .. math::
        \alpha_e \log\pi(\hat a \mid \tilde s) - \min_i Q_i(\tilde s, \hat a)

    The paper prints :math:`+Q` in an objective to be minimised, which would seek the
    worst action. It does not print the entropy term. The authors' code has it, and so
    has CQL.

    Args:
        log_prob: log-density of the sampled action, ``[B]``.
        qvalue: values of that action, ``[N, B]``.
        alpha: entropy temperature, a scalar.
    """
    return alpha * log_prob - qvalue.min(0).values


def bootstrap_value(
    qvalue: Tensor, log_prob: Tensor | None = None, alpha: Tensor | float = 0.0
) -> Tensor:
    r"""Return the pessimistic value of the next state, :math:`V(s')` of the target (2).

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
    """
    value = qvalue.min(0).values
    return value if log_prob is None else value - alpha * log_prob


def discrete_policy_value(
    log_prob: Tensor, qvalue: Tensor, alpha: Tensor | float
) -> Tensor:
    r"""Return :func:`soft_policy_value` in expectation over all ``n`` actions.

    .. math::
        \sum_{a=1}^{n} \pi(a \mid \tilde s)
        \, [\alpha_e \log\pi(a \mid \tilde s) - \min_i Q_i(\tilde s, a)]

    "Soft Actor-Critic for Discrete Action Settings", https://arxiv.org/abs/1910.07207:
    nothing is sampled. With ``alpha=0`` it is minus the value of the state. The
    policy's log-probabilities are normalised, ``[B, n]``, the values ``[N, B, n]``.
    """
    prob = log_prob.exp()
    # 0 log 0 = 0, as in categorical_kl.
    log_prob = torch.where(prob > 0, log_prob, 0.0)
    return (prob * (alpha * log_prob - qvalue.min(0).values)).sum(-1)


def temperature_objective(
    log_alpha: Tensor, log_prob: Tensor, target_entropy: float
) -> Tensor:
    r"""Return SAC's objective of the entropy temperature, linear in its logarithm.

    .. math::
        -\log\alpha_e \, \big(\log\pi(\hat a \mid \tilde s) + \bar{\mathcal H}\big)

    The log-density of the policy's own action, ``[B]``, is treated as constant. The
    policy should keep the target entropy, in nats.
    """
    return -log_alpha * (log_prob.detach() + target_entropy)


def soft_maximum(
    qvalue: Tensor, log_prob: Tensor, *, temperature: float = 1.0
) -> Tensor:
    r"""Return the log-sum-exp of sampled actions' values, weighted by their densities.

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

    Examples:
        >>> two_uniform_actions = torch.tensor([1.0, 3.0])
        >>> density = torch.tensor([0.5, 0.5]).log()
        >>> round(soft_maximum(two_uniform_actions, density).item(), 4)
        3.8201
    """
    return temperature * torch.logsumexp(qvalue / temperature - log_prob, -1)


def conservative_gap(soft_maximum: Tensor, data_qvalue: Tensor) -> Tensor:
    r"""Return CQL(H)'s penalty: the value of sampled actions above the data's.

    .. math::
        \tau \log \sum_{j=1}^{M} \exp\big(Q(s, a_j) / \tau\big) / p(a_j) - Q(s, a)

    with ``M = 3K`` actions: uniform, from ``pi(s)`` and from ``pi(s')``, *all scored
    at* ``s`` and all in one log-sum-exp ("Conservative Q-Learning", Kumar et al.
    2020, appendix F, https://arxiv.org/abs/2006.04779). The paper prints the simpler
    (3); its authors' code, like the reference CQL code, computes this. As there, the
    sum is not divided by ``M``: a constant, without effect on the gradient.

    TorchRL 0.14.1 ``CQLLoss`` differs: it takes the log-sum-exp over three actions at
    a time and scores the actions of ``pi(s')`` at ``s'``. The first term is that of
    :func:`soft_maximum`, ``[B]``, the second the value of the data's action, ``[B]``.
    """
    return soft_maximum - data_qvalue


def lagrange_terms(
    gap: Tensor, log_multiplier: Tensor, threshold: float
) -> tuple[Tensor, Tensor]:
    r"""Return both sides of CQL's Lagrangian, each to be minimised.

    .. math::
        \max_{\alpha' \ge 0} \min_Q \; \alpha' \, (\text{gap}(Q) - \tau)

    CQL's appendix F (https://arxiv.org/abs/2006.04779). The critics' term detaches
    the multiplier, and the multiplier's term detaches the gap. One backward over the
    sum of both then moves each the right way. TorchRL 0.14.1 ``CQLLoss`` detaches
    neither: there the multiplier's loss raises the gap.

    Args:
        gap: the conservative gap, ``[B]``.
        log_multiplier: :math:`\log\alpha'`, a scalar.
        threshold: :math:`\tau`, the gap that is tolerated, in units of the value.

    Returns:
        The critics' term and the multiplier's.
    """
    # The bound is that of the reference code: a gap that cannot be closed would let
    # the multiplier overflow.
    multiplier = log_multiplier.exp().clamp(max=1e6)
    excess = gap - threshold
    return multiplier.detach() * excess, -multiplier * excess.detach()


def value_constraint(policy_qvalue: Tensor, inverse_dynamics_qvalue: Tensor) -> Tensor:
    r"""Return OSR-v's constraint on the values, equation (8).

    .. math::
        \mathbb E_{\hat a \sim \pi(\tilde s)} Q(\tilde s, \hat a)
        - \mathbb E_{a \sim I(\tilde s, s')} Q(\tilde s, a)

    Minimised over Q, it lowers actions with unknown consequences and raises those that
    lead to ``s'``. It is linear in Q and has no minimum.

    Args:
        policy_qvalue: values of the policy's actions at ``s~``, ``[B, K]``.
        inverse_dynamics_qvalue: values of the model's actions at ``s~``, ``[B, K]``.
    """
    return policy_qvalue.mean(-1) - inverse_dynamics_qvalue.mean(-1)
