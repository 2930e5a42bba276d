r"""OSR: conservative Q-learning whose policy learns to come back to the data.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``K``
sampled actions of a kind, ``D`` state sets of D_tot (2: clean and perturbed; 1 where
nothing recovers). The equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.utils import rsample_and_log_prob

from torchrl_osr import functional
from torchrl_osr.objectives.actor_critic import RecoveryActorCriticLoss
from torchrl_osr.objectives.base import Reduction, ScalarOutputMode, check_weight


class OSRLoss(RecoveryActorCriticLoss):
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
        min_q_weight: :math:`\alpha`, weight of the conservative term. Default 5.0. May
            be assigned later; 0 *here* leaves the term out for good, which with
            ``num_qvalue_nets=10`` is OSR-10, and with ``recovery_weight=0`` SAC-N
            (https://arxiv.org/abs/2110.01548).
        num_random: ``K``, actions drawn of each kind (uniform, at ``s``, at ``s'``).
            Default 10.
        temperature: of the log-sum-exp. Default 1.0.
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

    _schedulable_buffers = frozenset({"recovery_weight", "min_q_weight"})

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None = None,
        *,
        recovery_weight: float = 0.5,
        min_q_weight: float = 5.0,
        num_random: int = 10,
        temperature: float = 1.0,
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
        weights = {"recovery_weight": recovery_weight, "min_q_weight": min_q_weight}
        for name, weight in weights.items():
            check_weight(name, weight)
        if recovery_weight and inverse_dynamics_network is None:
            raise ValueError(
                f"recovery_weight={recovery_weight} needs an inverse_dynamics_network; "
                "pass one, or recovery_weight=0 for CQL."
            )
        super().__init__(
            actor_network,
            qvalue_network,
            inverse_dynamics_network if recovery_weight else None,
            num_random=num_random,
            temperature=temperature,
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
        for name, weight in weights.items():
            self.register_coeff_buffer(name, float(weight))
        self.conserves = min_q_weight > 0

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        losses = ["loss_actor", "loss_alpha", "loss_qvalue"]
        if self.conserves:
            losses.append("loss_cql")
        metrics = ["alpha", "entropy", "pred_value", "target_value"]
        if self.recovers:
            losses.append("loss_recovery")
            metrics.append("recovery_kl")
        return losses, metrics

    @torch.no_grad()
    def _proposals(self, policy: TensorDictBase, like: Tensor) -> tuple[Tensor, Tensor]:
        """Draw K actions each: uniform, from pi(s) and from pi(s').

        Args:
            policy: the policy at ``s`` and ``s'``, ``[2, B]``.
            like: an action, ``[B, A]``.

        Returns:
            Actions ``[3K, B, A]`` and their log-densities ``[3K, B]``.
        """
        uniform, log_density = self._uniform(self.num_random, like)
        # rsample also without gradient: torch's sample reads the scale back to the host
        # to check its sign.
        action, log_prob = rsample_and_log_prob(
            self._distribution(policy), (self.num_random,)
        )
        return (
            torch.cat([uniform, action.flatten(0, 1)]),
            torch.cat([log_density, log_prob.flatten(0, 1)]),
        )

    def _constraints(
        self,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        policy: TensorDictBase,
        pi: TanhNormal,
        done: Tensor,
    ) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        if self.conserves:
            pred_value, gap = self._conservative_terms(tensordict, states, policy)
            gap = self._reduce(gap, tensordict)
            losses = {"loss_cql": self.min_q_weight * gap}
        else:
            action = tensordict.get(self.tensor_keys.action)
            pred_value = self._qvalue(states[0], action, self.qvalue_network_params)
            losses = {}
        if not self.recovers:
            return pred_value, losses, {}
        model = self._inverse_dynamics(tensordict, done)
        kl = functional.state_recovery(pi.loc, pi.scale, model.loc, model.scale)
        kl, mean_kl = self._reduce_recovery(kl.mean(0), done, tensordict)
        losses["loss_recovery"] = self.recovery_weight * kl
        return pred_value, losses, {"recovery_kl": mean_kl}

    def _conservative_terms(
        self, tensordict: TensorDictBase, states: TensorDictBase, policy: TensorDictBase
    ) -> tuple[Tensor, Tensor]:
        """Return the values of the data's actions ``[N, B]`` and CQL's gap ``[B]``."""
        data_action = tensordict.get(self.tensor_keys.action)
        action, log_prob = self._proposals(policy[:2].detach(), data_action)
        # One pass of the critics for the data's action and all proposals.
        action = torch.cat([data_action.unsqueeze(0), action])
        clean = states[0].expand(action.shape[:-1])
        qvalue = self._qvalue(clean, action, self.qvalue_network_params)
        pred_value, sampled = qvalue[:, 0], qvalue[:, 1:].movedim(1, -1)
        gap = functional.conservative_gap(
            sampled, log_prob.movedim(0, -1), pred_value, temperature=self.temperature
        )
        return pred_value, gap.sum(0)
