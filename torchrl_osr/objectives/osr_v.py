r"""OSR-v: critics that prefer the actions which lead back to the data.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``K``
sampled actions of a kind. The equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.utils import rsample_and_log_prob

from torchrl_osr import functional
from torchrl_osr._checks import check_choice, check_weight
from torchrl_osr.objectives.adversary import Adversary
from torchrl_osr.objectives.base import Reduction, ScalarOutputMode
from torchrl_osr.objectives.tanh_gaussian import TanhGaussianActorCritic


class OSRVLoss(TanhGaussianActorCritic):
    r"""Out-of-sample State Recovery by a constraint on the values (OSR-v).

    .. math::
        L_\pi &= \mathbb E_{\tilde s \sim D_{tot}}
            [\alpha_e \log\pi(\hat a \mid \tilde s) - \min_i Q_i(\tilde s, \hat a)] \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2 + \alpha \sum_i \mathbb E_{D_{tot}} \Big[
            \mathbb E_{\hat a \sim \pi(\tilde s)} Q_i(\tilde s, \hat a)
            - \mathbb E_{a \sim I(\tilde s, s')} Q_i(\tilde s, a) \Big]

    Presented in section 4.3 of "Recovering from Out-of-sample States via Inverse
    Dynamics in Offline Reinforcement Learning",
    https://openreview.net/forum?id=4gLWjSaw4o. The constraint stands in the place of
    CQL's: with the defaults the critics score 16 actions a row instead of 68, and
    ``OSRVLoss`` costs a fraction of :class:`~torchrl_osr.OSRLoss`. There is no
    lower-bound guarantee as CQL has: off the data the constraint may be negative.

    Every ``loss_*`` entry is weighted already and sends gradient into its own group of
    parameters only; here ``loss_recovery`` belongs to the critics.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.TanhNormal`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights (:func:`~torchrl_osr.modules.critic_ensemble`).
        inverse_dynamics_network: a *trained* model of ``I(a | s, s')`` with the
            actor's bounds (see :class:`~torchrl_osr.InverseDynamicsLoss`); frozen here.

    Keyword Args:
        recovery_weight: :math:`\alpha`, weight of the constraint. Default 5.0. May be
            assigned later.
        policy_values: how the first expectation is taken: ``"mean"`` (default, the
            paper's) over ``K`` actions of the policy, or ``"logsumexp"`` over ``K`` of
            the policy and ``K`` uniform ones, weighted by their densities.
        num_random: ``K``, actions drawn of each kind. Default 1.
        temperature: of the log-sum-exp. Default 1.0.
        adversary: finds the perturbed states in the place of the batch's, see
            :class:`~torchrl_osr.Adversary`. Default ``None``.
        behavior_cloning: train the policy on the data's actions in the place of the
            values, for a warm start: assign ``False`` to end it. Default ``False``.
        num_qvalue_nets: ``N``, for a single critic; a list has its own length.
            Default 2.
        loss_function: distance of the TD error: ``"l2"`` (default), ``"l1"`` or
            ``"smooth_l1"``.
        alpha_init: initial entropy temperature :math:`\alpha_e`. Default 1.0.
        fixed_alpha: keep the temperature. Default ``False``.
        target_entropy: in nats; ``"auto"`` (default) is minus the action's size.
        delay_qvalue: use target critics. Default ``True``.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.
        deactivate_vmap: run the critics one by one. Default ``False``.
        use_prioritized_weights: weigh rows by ``"priority_weight"``; ``"auto"``
            (default) does when the entry is there.
        scalar_output_mode: with ``reduction="none"``, ``"exclude"`` (with a warning by
            default) or ``"non_tensor"`` for the scalar metrics.

    Raises:
        TypeError: if a distribution is not a ``TanhNormal``.
        ValueError: if bounds differ or a value is out of its range.
        KeyError: in the call, if the batch has no perturbed entry.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr import OSRVLoss, StatePerturbation
        >>> from torchrl_osr.modules import (
        ...     critic_ensemble, tanh_gaussian_actor, tanh_gaussian_inverse_dynamics)
        >>> loss = OSRVLoss(tanh_gaussian_actor(11, 3), critic_ensemble(11, 3),
        ...                 tanh_gaussian_inverse_dynamics(11, 3))
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3),
        ...     "next": {"observation": torch.randn(4, 11), "reward": torch.ones(4, 1),
        ...              "done": no, "terminated": no}}, [4])
        >>> losses = loss(StatePerturbation(std=1e-3)(batch))
        >>> sorted(key for key in losses.keys() if key.startswith("loss_"))
        ['loss_actor', 'loss_alpha', 'loss_qvalue', 'loss_recovery']
    """

    _schedulable_buffers = frozenset({"recovery_weight"})

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        inverse_dynamics_network: ProbabilisticTensorDictSequential,
        *,
        recovery_weight: float = 5.0,
        policy_values: Literal["mean", "logsumexp"] = "mean",
        num_random: int = 1,
        temperature: float = 1.0,
        adversary: Adversary | None = None,
        behavior_cloning: bool = False,
        num_qvalue_nets: int = 2,
        loss_function: str = "l2",
        alpha_init: float = 1.0,
        fixed_alpha: bool = False,
        target_entropy: float | Literal["auto"] = "auto",
        delay_qvalue: bool = True,
        reduction: Reduction = None,
        deactivate_vmap: bool = False,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
        scalar_output_mode: ScalarOutputMode = None,
    ) -> None:
        if inverse_dynamics_network is None:
            raise ValueError("OSRVLoss needs an inverse_dynamics_network.")
        check_choice("policy_values", policy_values, ("mean", "logsumexp"))
        check_weight("recovery_weight", recovery_weight)
        super().__init__(
            actor_network,
            qvalue_network,
            inverse_dynamics_network,
            num_random=num_random,
            temperature=temperature,
            adversary=adversary,
            behavior_cloning=behavior_cloning,
            num_qvalue_nets=num_qvalue_nets,
            loss_function=loss_function,
            alpha_init=alpha_init,
            fixed_alpha=fixed_alpha,
            target_entropy=target_entropy,
            delay_qvalue=delay_qvalue,
            reduction=reduction,
            deactivate_vmap=deactivate_vmap,
            use_prioritized_weights=use_prioritized_weights,
            scalar_output_mode=scalar_output_mode,
        )
        self.register_coeff_buffer("recovery_weight", float(recovery_weight))
        self.policy_values = policy_values

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        losses = ["loss_actor", "loss_alpha", "loss_qvalue", "loss_recovery"]
        metrics = ["alpha", "entropy", "pred_value", "target_value", "recovery_gap"]
        return losses, metrics

    @torch.no_grad()
    def _candidates(
        self, tensordict: TensorDictBase, pi: TanhNormal
    ) -> tuple[Tensor, Tensor | None]:
        """Draw the actions whose values are compared, all on D_tot.

        Returns:
            Actions ``[M, 2, B, A]``, the last ``K`` of them the model's, and the
            log-densities of the others, ``[M - K, 2, B]``, where they are needed.
        """
        done = self._flag(tensordict, self.tensor_keys.done)
        model = self._inverse_dynamics(tensordict, done)
        number = (self.num_random,)
        action, log_prob = rsample_and_log_prob(pi, number)
        target, _ = rsample_and_log_prob(model, number)
        if self.policy_values == "mean":
            return torch.cat([action, target]), None
        uniform, log_density = self._uniform(self.num_random, pi.loc)
        log_prob = torch.cat([log_density, log_prob])
        return torch.cat([uniform, action, target]), log_prob

    def _constraints(
        self,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        policy: TensorDictBase,
        pi: TanhNormal,
        data_action: Tensor,
    ) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        candidates, log_prob = self._candidates(tensordict, pi)
        mixed = states[::2].expand(candidates.shape[:-1])
        # One pass of the critics for the data's action and all candidates.
        qvalue = self._qvalue(
            torch.cat([states[:1], mixed.flatten(0, 1)]),
            torch.cat([data_action.unsqueeze(0), candidates.flatten(0, 1)]),
            self.qvalue_network_params,
        )
        pred_value = qvalue[:, 0]
        compared = qvalue[:, 1:].reshape(-1, *candidates.shape[:-1]).movedim(1, -1)
        gap = functional.value_constraint(
            compared[..., : -self.num_random],
            compared[..., -self.num_random :],
            log_prob=None if log_prob is None else log_prob.movedim(0, -1),
            temperature=self.temperature,
        )
        gap, mean_gap = self._reduce_recovery(gap.sum(0), tensordict)
        losses = {"loss_recovery": self.recovery_weight * gap}
        return pred_value, losses, {"recovery_gap": mean_gap}
