r"""OSR for discrete actions: every expectation over the actions is a sum, not a sample.

Shapes: ``B`` batch (any leading dimensions), ``n`` number of actions, ``N`` critics,
``D`` state sets of D_tot (2: clean and perturbed; 1 where nothing recovers). The
equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor

from torchrl_osr import functional
from torchrl_osr._checks import check_choice, check_weight
from torchrl_osr.objectives.base import Reduction, ScalarOutputMode
from torchrl_osr.objectives.categorical import CategoricalActorCritic
from torchrl_osr.objectives.distributions import check_num_actions


class DiscreteOSRLoss(CategoricalActorCritic):
    r"""Out-of-sample State Recovery for a finite number of actions.

    .. math::
        L_\pi &= \mathbb E_{\tilde s \sim D_{tot}} \sum_a \pi(a \mid \tilde s)
            [\alpha_e \log\pi(a \mid \tilde s) - \min_i Q_i(\tilde s, a)]
            + \lambda\, \mathbb E_{D_{tot}}
            KL(I(a \mid \tilde s, s') \,\|\, \pi(a \mid \tilde s)) \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2 + \alpha \sum_i \mathbb E_D \Big[
            \tau \log \sum_a e^{Q_i(s, a) / \tau} - Q_i(s, a) \Big] \\
        T &= r + \gamma\,(1 - \text{terminated})
            \sum_a \pi(a \mid s') \min_i \bar Q_i(s', a)

    :class:`~torchrl_osr.OSRLoss` with the actor of discrete SAC
    (https://arxiv.org/abs/1910.07207) and the exact CQL(H) term
    (https://arxiv.org/abs/2006.04779). The paper has continuous actions only; this
    is its method where they are discrete, not an experiment of its authors. With
    ``recovery_weight=0`` it is discrete CQL(H).

    Every ``loss_*`` entry is weighted already and sends gradient into its own group of
    parameters only, so their sum, one backward and one optimizer step is right.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.OneHotCategorical`, and then
            reads one-hot actions ``[B, n]`` from the batch, or in a
            :class:`torch.distributions.Categorical`, and reads indices ``[B]`` or
            ``[B, 1]`` (:func:`~torchrl_osr.modules.categorical_actor`).
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights; each writes ``"action_value"``, ``[B, n]``
            (:func:`~torchrl_osr.modules.discrete_critic_ensemble`).
        inverse_dynamics_network: a *trained* categorical model of ``I(a | s, s')``, see
            :class:`~torchrl_osr.DiscreteInverseDynamicsLoss`. It is frozen here. Needed
            unless ``recovery_weight=0``.

    Keyword Args:
        recovery_weight: :math:`\lambda`. Default 0.5. May be assigned later; 0 *here*
            makes the loss CQL(H) for good.
        min_q_weight: :math:`\alpha`, weight of the conservative term, in units of the
            value: the TD error is squared, the term is not. Default 5.0, that of
            :class:`~torchrl_osr.OSRLoss`. May be assigned later; 0 *here* leaves the
            term out for good.
        temperature: :math:`\tau`, in units of the value. Default 1.0.
        recovery_direction: ``"forward"`` (default) for ``KL(I || pi)`` or ``"reverse"``
            for ``KL(pi || I)``.
        recovery_states: ``"both"`` (default) for D_tot, ``"perturbed"`` alone, or
            ``"clean"``: no perturbed state is read, D_tot is the data.
        actor_states: where the policy seeks values: ``"both"`` (default) or ``"clean"``
            states alone.
        num_qvalue_nets: ``N``, for a single critic; a list has its own length.
            Default 2.
        loss_function: distance of the TD error: ``"l2"`` (default), ``"l1"`` or
            ``"smooth_l1"``.
        alpha_init: initial entropy temperature :math:`\alpha_e`. Default 1.0.
        fixed_alpha: keep the temperature. Default ``False``.
        target_entropy: in nats; ``"auto"`` (default) is ``target_entropy_weight`` times
            the entropy of the uniform policy, ``log(n)``.
        target_entropy_weight: Default 0.98, TorchRL's in ``DiscreteSACLoss``: a policy
            that is nearly uniform.
        delay_qvalue: use target critics, to be moved by
            :class:`~torchrl.objectives.SoftUpdate`. Default ``True``.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.
        deactivate_vmap: run the critics one by one. Default ``False``.
        use_prioritized_weights: weigh rows by ``"priority_weight"``; ``"auto"``
            (default) does when the entry is there.
        scalar_output_mode: with ``reduction="none"``, ``"exclude"`` (with a warning by
            default) or ``"non_tensor"`` for the scalar metrics.

    Raises:
        TypeError: if a distribution is not categorical.
        ValueError: if an option is out of range or the model is missing; in the call,
            if the networks' numbers of actions or the batch's actions do not match.
        KeyError: in the call, if the batch has no perturbed entry.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr import DiscreteOSRLoss, StatePerturbation
        >>> from torchrl_osr.modules import (
        ...     categorical_actor, categorical_inverse_dynamics,
        ...     discrete_critic_ensemble)
        >>> loss = DiscreteOSRLoss(categorical_actor(4, 2),
        ...                        discrete_critic_ensemble(4, 2),
        ...                        categorical_inverse_dynamics(4, 2))
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(3, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(3, 4), "action": torch.eye(2)[[0, 1, 0]],
        ...     "next": {"observation": torch.randn(3, 4), "reward": torch.ones(3, 1),
        ...              "done": no, "terminated": no}}, [3])
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
        temperature: float = 1.0,
        recovery_direction: Literal["forward", "reverse"] = "forward",
        recovery_states: Literal["both", "perturbed", "clean"] = "both",
        actor_states: Literal["both", "clean"] = "both",
        num_qvalue_nets: int = 2,
        loss_function: str = "l2",
        alpha_init: float = 1.0,
        fixed_alpha: bool = False,
        target_entropy: float | Literal["auto"] = "auto",
        target_entropy_weight: float = 0.98,
        delay_qvalue: bool = True,
        reduction: Reduction = None,
        deactivate_vmap: bool = False,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
        scalar_output_mode: ScalarOutputMode = None,
    ) -> None:
        check_weight("recovery_weight", recovery_weight)
        check_weight("min_q_weight", min_q_weight)
        check_choice("recovery_direction", recovery_direction, ("forward", "reverse"))
        if not temperature > 0:
            raise ValueError(f"temperature must be above 0, got {temperature}.")
        if recovery_weight and inverse_dynamics_network is None:
            raise ValueError(
                f"recovery_weight={recovery_weight} needs an inverse_dynamics_network; "
                "pass one, or recovery_weight=0 for CQL."
            )
        super().__init__(
            actor_network,
            qvalue_network,
            inverse_dynamics_network if recovery_weight else None,
            recovers=recovery_weight > 0,
            recovery_states=recovery_states,
            actor_states=actor_states,
            num_qvalue_nets=num_qvalue_nets,
            loss_function=loss_function,
            alpha_init=alpha_init,
            fixed_alpha=fixed_alpha,
            target_entropy=target_entropy,
            target_entropy_weight=target_entropy_weight,
            delay_qvalue=delay_qvalue,
            reduction=reduction,
            deactivate_vmap=deactivate_vmap,
            use_prioritized_weights=use_prioritized_weights,
            scalar_output_mode=scalar_output_mode,
        )
        self.register_coeff_buffer("recovery_weight", float(recovery_weight))
        self.register_coeff_buffer("min_q_weight", float(min_q_weight))
        self.conserves = min_q_weight > 0
        self.temperature = temperature
        self.recovery_direction = recovery_direction

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        losses: list[NestedKey] = ["loss_actor", "loss_alpha", "loss_qvalue"]
        losses += ["loss_cql"] * self.conserves + ["loss_recovery"] * self.recovers
        metrics: list[NestedKey] = ["alpha", "entropy", "pred_value", "target_value"]
        return losses, metrics + ["recovery_kl"] * self.recovers

    def _constraints(
        self,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        policy: TensorDictBase,
        pi: Any,
        data_action: Tensor,
    ) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        qvalue = self._action_values(states[0], self.qvalue_network_params, pi)
        index = data_action.expand(qvalue.shape[:-1]).unsqueeze(-1)
        pred_value = qvalue.gather(-1, index).squeeze(-1)
        losses: dict[str, Tensor] = {}
        metrics: dict[str, Tensor] = {}
        if self.conserves:
            # Each action once, and for certain: all of them, not a sample's densities.
            gap = functional.conservative_gap(
                qvalue, torch.zeros_like(qvalue), pred_value,
                temperature=self.temperature,
            )  # fmt: skip
            gap = self._reduce(gap.sum(0), tensordict)
            losses["loss_cql"] = self.min_q_weight * gap
        if self.recovers:
            kl = self._recovery_divergence(tensordict, policy, pi)
            kl, metrics["recovery_kl"] = self._reduce_recovery(kl, tensordict)
            losses["loss_recovery"] = self.recovery_weight * kl
        return pred_value, losses, metrics

    def _recovery_divergence(
        self, tensordict: TensorDictBase, policy: TensorDictBase, pi: Any
    ) -> Tensor:
        """Return the divergence between model and policy on D_tot, ``[D, B]``."""
        done = self._flag(tensordict, self.tensor_keys.done)
        ours = self._recovery_policy(policy, pi).logits
        theirs = self._inverse_dynamics(tensordict, done).logits
        check_num_actions("inverse_dynamics_network", theirs.shape[-1], ours.shape[-1])
        if self.recovery_direction == "forward":
            return functional.categorical_kl(theirs, ours)
        return functional.categorical_kl(ours, theirs)
