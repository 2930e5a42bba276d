r"""OSR: conservative Q-learning whose policy learns to come back to the data.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``K``
sampled actions of a kind, ``D`` state sets of D_tot (2: clean and perturbed; 1 where
nothing recovers). The equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor
from torchrl.modules import TanhNormal

from torchrl_osr import functional
from torchrl_osr._checks import check_choice, check_weight
from torchrl_osr.objectives.adversary import Adversary
from torchrl_osr.objectives.base import Reduction, ScalarOutputMode
from torchrl_osr.objectives.conservative import ConservativeCritics


class OSRLoss(ConservativeCritics):
    r"""Out-of-sample State Recovery by a constraint on the policy (OSR).

    .. math::
        L_\pi &= \mathbb E_{\tilde s \sim D_{tot}}
            [\alpha_e \log\pi(\hat a \mid \tilde s) - \min_i Q_i(\tilde s, \hat a)]
            + \lambda\, \mathbb E_{D_{tot}}
            KL(I(a \mid \tilde s, s') \,\|\, \pi(a \mid \tilde s)) \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2 + \alpha \sum_i \mathbb E_D \Big[
            \log \sum_{j=1}^{3K} e^{Q_i(s, a_j)} / p(a_j) - Q_i(s, a) \Big]

    Presented in "Recovering from Out-of-sample States via Inverse Dynamics in Offline
    Reinforcement Learning", https://openreview.net/forum?id=4gLWjSaw4o. With
    ``recovery_weight=0`` it is CQL(H) ("Conservative Q-Learning",
    https://arxiv.org/abs/2006.04779): no inverse dynamics model is called and no
    perturbed state is read.

    Every ``loss_*`` entry is weighted already and sends gradient into its own group of
    parameters only, so their sum, one backward and one optimizer step is right, and so
    are separate optimizers.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.TanhNormal`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights (:func:`~torchrl_osr.modules.critic_ensemble`).
        inverse_dynamics_network: a *trained* model of ``I(a | s, s')`` with the
            actor's bounds (see :class:`~torchrl_osr.InverseDynamicsLoss`). It is frozen
            here: in the state dict, moved by ``.to()``, without gradient. Needed unless
            ``recovery_weight=0``.

    Keyword Args:
        recovery_weight: :math:`\lambda`. Default 0.5. A number assigned later makes a
            schedule; 0 *here* makes the loss CQL(H) for good.
        recovery_direction: ``"forward"`` (default, the paper's ``KL(I || pi)``) or
            ``"reverse"`` (``KL(pi || I)``, the released code's).
        action_reduction: of the divergence over action dimensions: ``"sum"`` (default,
            the paper's) or ``"mean"`` (the released code's).
        recovery_target: what the policy is pulled to: ``"inverse_dynamics"``
            (default), the model, or ``"data"``, the data's action,
            ``-log pi(a | s~)`` in the place of the divergence. The latter is CQL with
            behaviour cloning, noisy on D_tot: what OSR would be without its model.
        recovery_states: ``"both"`` (default) for D_tot, ``"perturbed"`` alone, or
            ``"clean"``: no perturbed state is read, D_tot is the data.
        actor_states: where the policy seeks values: ``"both"`` (default) or ``"clean"``
            states alone.
        adversary: finds the perturbed states in the place of the batch's, see
            :class:`~torchrl_osr.Adversary`. Default ``None``.
        behavior_cloning: train the policy on the data's actions in the place of the
            values, for a warm start: assign ``False`` to end it. Default ``False``.
        min_q_weight: :math:`\alpha`, weight of the conservative term. Default 5.0. May
            be assigned later; 0 *here* leaves the term out for good, which with
            ``num_qvalue_nets=10`` is OSR-10, and with ``recovery_weight=0`` SAC-N
            (https://arxiv.org/abs/2110.01548).
        num_random: ``K``, actions drawn of each kind (uniform, at ``s``, at ``s'``).
            Default 10.
        temperature: of the log-sum-exp. Default 1.0.
        importance_sample: weigh the drawn actions by their densities. Default ``True``.
        clip_diff_min, clip_diff_max: bounds of the conservative gap, per critic and
            row, in units of the value. Default: none.
        max_q_backup: the target's value is the largest of ``num_random`` actions'.
            Default ``False``.
        deterministic_backup: leave the entropy out of the target, as CQL does and
            SAC-N does not. Default ``True``.
        with_lagrange: learn a multiplier of the conservative term that holds the gap
            at ``lagrange_thresh``. Default ``False``.
        lagrange_thresh: the tolerated gap, in units of the value. Default 0.0.
        diversity_weight: EDAC's :math:`\eta`, weight of the similarity of the critics'
            gradients by the action. Default 0.0, which leaves it out for good.
        chunk_size: on a CPU, how many states go through the critics at a time, with
            all their sampled actions, if the critics are plain MLPs; ``None`` for all
            at once, as other networks go. Default 64. The mathematics is the same.
        num_qvalue_nets: ``N``, for a single critic; a list has its own length.
            Default 2.
        loss_function: distance of the TD error: ``"l2"`` (default), ``"l1"`` or
            ``"smooth_l1"``.
        alpha_init: initial entropy temperature :math:`\alpha_e`. Default 1.0.
        fixed_alpha: keep the temperature. Default ``False``.
        target_entropy: in nats; ``"auto"`` (default) is minus the action's size.
        delay_qvalue: use target critics, to be moved by
            :class:`~torchrl.objectives.SoftUpdate`. Default ``True``.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.
        deactivate_vmap: run the critics one by one. Default ``False``.
        use_prioritized_weights: weigh rows by ``"priority_weight"``; ``"auto"``
            (default) does when the entry is there.
        scalar_output_mode: with ``reduction="none"``, ``"exclude"`` (with a warning by
            default) or ``"non_tensor"`` for the scalar metrics.

    Raises:
        TypeError: if a distribution is not a ``TanhNormal``.
        ValueError: if bounds differ, a weight is negative or the model is missing.
        KeyError: in the call, if the batch has no perturbed entry.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr import OSRLoss, StatePerturbation
        >>> from torchrl_osr.modules import (
        ...     critic_ensemble, tanh_gaussian_actor, tanh_gaussian_inverse_dynamics)
        >>> loss = OSRLoss(tanh_gaussian_actor(11, 3), critic_ensemble(11, 3),
        ...                tanh_gaussian_inverse_dynamics(11, 3))
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3),
        ...     "next": {"observation": torch.randn(4, 11), "reward": torch.ones(4, 1),
        ...              "done": no, "terminated": no}}, [4])
        >>> losses = loss(StatePerturbation(std=1e-3)(batch))
        >>> sorted(key for key in losses.keys() if key.startswith("loss_"))
        ['loss_actor', 'loss_alpha', 'loss_cql', 'loss_qvalue', 'loss_recovery']
    """

    _schedulable_buffers = frozenset(
        {"recovery_weight", "min_q_weight", "diversity_weight"}
    )

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None = None,
        *,
        recovery_weight: float = 0.5,
        recovery_direction: Literal["forward", "reverse"] = "forward",
        action_reduction: Literal["sum", "mean"] = "sum",
        recovery_target: Literal["inverse_dynamics", "data"] = "inverse_dynamics",
        recovery_states: Literal["both", "perturbed", "clean"] = "both",
        actor_states: Literal["both", "clean"] = "both",
        adversary: Adversary | None = None,
        behavior_cloning: bool = False,
        min_q_weight: float = 5.0,
        num_random: int = 10,
        temperature: float = 1.0,
        importance_sample: bool = True,
        clip_diff_min: float = -math.inf,
        clip_diff_max: float = math.inf,
        max_q_backup: bool = False,
        deterministic_backup: bool = True,
        with_lagrange: bool = False,
        lagrange_thresh: float = 0.0,
        diversity_weight: float = 0.0,
        chunk_size: int | None = 64,
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
        check_weight("recovery_weight", recovery_weight)
        check_choice("recovery_direction", recovery_direction, ("forward", "reverse"))
        check_choice("action_reduction", action_reduction, ("sum", "mean"))
        choices = ("inverse_dynamics", "data")
        check_choice("recovery_target", recovery_target, choices)
        has_model = recovery_weight > 0 and recovery_target == "inverse_dynamics"
        if has_model and inverse_dynamics_network is None:
            raise ValueError(
                f"recovery_weight={recovery_weight} needs an inverse_dynamics_network; "
                "pass one, or recovery_weight=0 for CQL."
            )
        super().__init__(
            actor_network,
            qvalue_network,
            inverse_dynamics_network if has_model else None,
            recovers=recovery_weight > 0,
            recovery_states=recovery_states,
            actor_states=actor_states,
            adversary=adversary,
            behavior_cloning=behavior_cloning,
            min_q_weight=min_q_weight,
            num_random=num_random,
            temperature=temperature,
            importance_sample=importance_sample,
            clip_diff=(clip_diff_min, clip_diff_max),
            max_q_backup=max_q_backup,
            deterministic_backup=deterministic_backup,
            with_lagrange=with_lagrange,
            lagrange_thresh=lagrange_thresh,
            diversity_weight=diversity_weight,
            chunk_size=chunk_size,
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
        self.recovery_direction = recovery_direction
        self.recovery_target = recovery_target
        self.action_reduction = action_reduction

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        losses: list[NestedKey] = ["loss_actor", "loss_alpha", "loss_qvalue"]
        metrics: list[NestedKey] = ["alpha", "entropy", "pred_value", "target_value"]
        critic_losses, critic_metrics = self._critic_keys()
        losses += critic_losses + ["loss_recovery"] * self.recovers
        metrics += critic_metrics + [self._recovery_metric] * self.recovers
        return losses, metrics

    @property
    def _recovery_metric(self) -> str:
        return "recovery_nll" if self.recovery_target == "data" else "recovery_kl"

    def _constraints(
        self,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        policy: TensorDictBase,
        pi: TanhNormal,
        data_action: Tensor,
    ) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        pred_value, losses, metrics = self._critic_terms(
            tensordict, states, policy, data_action
        )
        if not self.recovers:
            return pred_value, losses, metrics
        pi = self._recovery_policy(policy, pi)
        value = self._recovery_divergence(tensordict, pi, data_action)
        value, mean = self._reduce_recovery(value, tensordict)
        losses["loss_recovery"] = self.recovery_weight * value
        return pred_value, losses, metrics | {self._recovery_metric: mean}

    def _recovery_divergence(
        self, tensordict: TensorDictBase, pi: TanhNormal, data_action: Tensor
    ) -> Tensor:
        """Return how far the policy is from its target on D_tot, ``[D, B]``."""
        if self.recovery_target == "data":
            log_prob: Tensor = pi.log_prob(data_action.expand_as(pi.loc))
            return -log_prob
        done = self._flag(tensordict, self.tensor_keys.done)
        model = self._inverse_dynamics(tensordict, done)
        return functional.state_recovery(
            pi.loc,
            pi.scale,
            model.loc,
            model.scale,
            direction=self.recovery_direction,
            action_reduction=self.action_reduction,
        )
