"""Divergences of two policies, and the state-recovery term that is one.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``n`` number of discrete
actions.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor


def gaussian_kl(
    loc_p: Tensor, scale_p: Tensor, loc_q: Tensor, scale_q: Tensor
) -> Tensor:
    r""":math:`KL(p \,\|\, q)` of diagonal Gaussians, one number a dimension.

    .. math::
        \log\frac{\sigma_q}{\sigma_p}
        + \frac{\sigma_p^2 + (\mu_p - \mu_q)^2}{2\sigma_q^2} - \frac12

    It is also the divergence of the two *tanh*-Gaussians with these pre-tanh
    parameters and equal bounds, because a bijection leaves the KL unchanged.

    Args:
        loc_p, scale_p: mean and standard deviation of ``p``, ``[B, A]``.
        loc_q, scale_q: mean and standard deviation of ``q``, ``[B, A]``.

    Returns:
        ``[B, A]``, each entry at least 0.

    Examples:
        >>> p, q = torch.tensor([0.4]), torch.tensor([-0.2])
        >>> kl = gaussian_kl(p, torch.tensor([0.3]), q, torch.tensor([0.5]))
        >>> round(kl.item(), 6)
        0.910826
    """
    variance_ratio = (scale_p / scale_q).square()
    # log(x) / 2 of the squared ratio: one logarithm, and exactly 0 for p == q.
    return 0.5 * (
        variance_ratio + ((loc_p - loc_q) / scale_q).square() - 1 - variance_ratio.log()
    )


def jeffreys_divergence(
    loc_p: Tensor, scale_p: Tensor, loc_q: Tensor, scale_q: Tensor
) -> Tensor:
    r"""Jeffreys divergence :math:`KL(p \,\|\, q) + KL(q \,\|\, p)` of Gaussians.

    .. math::
        \frac12 \sum_i \Big(\frac{\sigma_p}{\sigma_q} - \frac{\sigma_q}{\sigma_p}\Big)^2
        + (\mu_p - \mu_q)^2 \Big(\frac1{\sigma_p^2} + \frac1{\sigma_q^2}\Big)

    It is the sum of both :func:`gaussian_kl`, whose logarithms cancel. A sum of squares
    keeps its digits where ``p`` and ``q`` are close, and there it is used: for a policy
    at two neighbouring states.

    Args:
        loc_p, scale_p: mean and standard deviation of ``p``, ``[B, A]``.
        loc_q, scale_q: mean and standard deviation of ``q``, ``[B, A]``.

    Returns:
        ``[B]``, each entry at least 0.

    Examples:
        >>> p, q = torch.tensor([0.4]), torch.tensor([-0.2])
        >>> both = jeffreys_divergence(p, torch.tensor([0.3]), q, torch.tensor([0.5]))
        >>> round(both.item(), 6)
        3.288889
    """
    gap = loc_p - loc_q
    means = (gap / scale_p).square() + (gap / scale_q).square()
    scales = (scale_p / scale_q - scale_q / scale_p).square()
    return 0.5 * (means + scales).sum(-1)


def categorical_kl(log_prob_p: Tensor, log_prob_q: Tensor) -> Tensor:
    r""":math:`KL(p \,\|\, q)` of categorical distributions.

    .. math::
        \sum_a p(a) \, [\log p(a) - \log q(a)]

    An action that ``p`` never takes counts for nothing, whatever ``q`` says of it; one
    that only ``q`` never takes makes the divergence infinite.

    Args:
        log_prob_p: normalised log-probabilities of ``p``, ``[B, n]``.
        log_prob_q: normalised log-probabilities of ``q``, ``[B, n]``.

    Returns:
        ``[B]``, each entry at least 0.

    Examples:
        >>> p, q = torch.tensor([0.5, 0.5, 0.0]), torch.tensor([0.25, 0.5, 0.25])
        >>> round(categorical_kl(p.log(), q.log()).item(), 6)
        0.346574
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
    r"""State-recovery term :math:`L_{sr}`, equations (11) and (12).

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

    Returns:
        ``[B]``.
    """
    policy = (policy_loc, policy_scale)
    inverse_dynamics = (inverse_dynamics_loc, inverse_dynamics_scale)
    if direction == "forward":
        divergence = gaussian_kl(*inverse_dynamics, *policy)
    elif direction == "reverse":
        divergence = gaussian_kl(*policy, *inverse_dynamics)
    else:
        raise ValueError(
            f"direction must be 'forward' or 'reverse', got {direction!r}."
        )
    if action_reduction == "sum":
        return divergence.sum(-1)
    if action_reduction == "mean":
        return divergence.mean(-1)
    raise ValueError(
        f"action_reduction must be 'sum' or 'mean', got {action_reduction!r}."
    )


def deterministic_recovery(
    policy_loc: Tensor,
    inverse_dynamics_loc: Tensor,
    inverse_dynamics_scale: Tensor,
    *,
    action_reduction: Literal["sum", "mean"] = "sum",
) -> Tensor:
    r"""State-recovery term of a policy without a density.

    .. math::
        \sum_d \frac{(x_d - \mu_{I,d})^2}{2\sigma_{I,d}^2}

    with :math:`x` the policy's action before the tanh. An addition, not in the paper,
    whose divergence needs two densities: towards a point :math:`KL(I \,\|\, \pi)` is
    infinite. This is the part of the reverse :math:`KL(\pi \,\|\, I)` that depends on
    the mean of a Gaussian policy of fixed width.

    Args:
        policy_loc: pre-tanh action at ``s~``, ``[B, A]``.
        inverse_dynamics_loc, inverse_dynamics_scale: pre-tanh inverse dynamics
            model at ``(s~, s')``, ``[B, A]``.
        action_reduction: ``"sum"`` or ``"mean"`` over action dimensions.

    Returns:
        ``[B]``, each entry at least 0; 0 where the action is the model's mean.

    Examples:
        >>> action, loc = torch.tensor([0.4, 1.0]), torch.tensor([-0.2, 0.0])
        >>> round(deterministic_recovery(action, loc, torch.tensor(0.5)).item(), 6)
        2.72
    """
    # Of equal widths, only the means are left in the divergence.
    return state_recovery(
        policy_loc,
        inverse_dynamics_scale,
        inverse_dynamics_loc,
        inverse_dynamics_scale,
        direction="reverse",
        action_reduction=action_reduction,
    )
