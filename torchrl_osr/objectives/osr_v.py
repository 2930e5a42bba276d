r"""OSR-v: critics that prefer the actions which lead back to the data.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``K``
sampled actions of a kind. The equations are in :mod:`torchrl_osr.functional`.
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
from torchrl.data import TensorSpec
from torchrl.modules.distributions.utils import rsample_and_log_prob

from torchrl_osr import functional
from torchrl_osr._checks import check_literals, check_positive, check_weight
from torchrl_osr.objectives.base import BaseLoss, Terms, TransitionKeys
from torchrl_osr.objectives.distributions import check_num_actions
from torchrl_osr.objectives.step import Step, actor_critic_in_keys, uniform_actions

_NO_CQL = "the constraint of weight recovery_weight stands in the place of CQL's term"
_TARGET = (
    "its TD target is that of the policy's own action, without entropy; OSRLoss has "
    "other targets"
)
CQL_ARGUMENTS = {
    "min_q_weight": _NO_CQL,
    "with_lagrange": _NO_CQL,
    "lagrange_thresh": _NO_CQL,
    "max_q_backup": _TARGET,
    "deterministic_backup": _TARGET,
}
"""Arguments of :class:`~torchrl.objectives.CQLLoss` that have no meaning here."""


class OSRVLoss(BaseLoss):
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

    ``loss_qvalue`` holds both terms of :math:`L_Q`. Each entry is weighted already and
    sends gradient into its own group of parameters only.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.TanhNormal`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights (:func:`~torchrl_osr.modules.critic_ensemble`).
        inverse_dynamics_network: a *trained* model of ``I(a | s, s')`` with the
            actor's bounds (see :class:`~torchrl_osr.InverseDynamicsLoss`); frozen here.
            Needed unless ``recovery_target="data"``, which leaves it out.

    Keyword Args:
        recovery_weight: :math:`\alpha`, weight of the constraint. Default 5.0. May be
            assigned later.
        recovery_target: whose actions the policy's are compared with:
            ``"inverse_dynamics"`` (default), the model's, or ``"data"``, the data's
            own, at clean and at perturbed states. The latter is OSR-v without its
            model: with a model at its optimum both have the same expectation.
        policy_values: how the first expectation is taken: ``"mean"`` (default, the
            paper's) over ``K`` actions of the policy, or ``"logsumexp"`` over ``K`` of
            the policy and ``K`` uniform ones, weighted by their densities.
        num_random: ``K``, actions drawn of each kind. Default 1.
        temperature: of the log-sum-exp. Default 1.0.
        alpha_init: initial entropy temperature :math:`\alpha_e`. Default 1.0.
        min_alpha, max_alpha: bounds of the temperature. Default: none.
        fixed_alpha: keep the temperature. Default ``False``.
        target_entropy: in nats; ``"auto"`` (default) is minus the action's size.
        action_spec: of the environment's actions, whose bounds must be the actor's.
            Default: not compared.
        delay_actor: the action in the TD target is that of a target actor, which
            :class:`~torchrl.objectives.SoftUpdate` moves with the target critics.
            Default ``False``.
        options: of every loss, see :class:`~torchrl_osr.objectives.BaseLoss`.

    Raises:
        TypeError: if a distribution is not a ``TanhNormal``, or an argument belongs to
            another loss, such as CQL's ``min_q_weight``.
        ValueError: if bounds differ or an option is out of its range; in the call, if
            the batch is empty or holds several steps a row.
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
        ['loss_actor', 'loss_alpha', 'loss_qvalue']
    """

    _schedulable_buffers = frozenset({"recovery_weight"})

    _AcceptedKeys = TransitionKeys
    default_keys = TransitionKeys
    tensor_keys: TransitionKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None = None,
        *,
        recovery_weight: float = 5.0,
        recovery_target: Literal["inverse_dynamics", "data"] = "inverse_dynamics",
        policy_values: Literal["mean", "logsumexp"] = "mean",
        num_random: int = 1,
        temperature: float = 1.0,
        alpha_init: float = 1.0,
        min_alpha: float | None = None,
        max_alpha: float | None = None,
        fixed_alpha: bool = False,
        target_entropy: float | Literal["auto"] = "auto",
        action_spec: TensorSpec | None = None,
        delay_actor: bool = False,
        **options: Any,
    ) -> None:
        check_literals(OSRVLoss.__init__, locals())
        for name, advice in CQL_ARGUMENTS.items():
            if name in options:
                raise TypeError(f"OSRVLoss takes no {name}: {advice}.")
        needs_model = recovery_target == "inverse_dynamics"
        if needs_model and inverse_dynamics_network is None:
            raise ValueError(
                "OSRVLoss needs an inverse_dynamics_network; pass one, or "
                "recovery_target='data' for the data's own actions."
            )
        check_weight("recovery_weight", recovery_weight)
        check_positive("num_random", num_random, minimum=1)
        check_positive("temperature", temperature)
        super().__init__(**options)
        model = inverse_dynamics_network if needs_model else None
        self._hold_action_bounds(actor_network, model, action_spec)
        self._hold_actor_critic(
            actor_network,
            qvalue_network,
            inverse_dynamics_network=model,
            delay_actor=delay_actor,
        )
        self._hold_temperature(
            alpha_init, fixed_alpha, target_entropy, min_alpha, max_alpha
        )
        self.register_coeff_buffer("recovery_weight", float(recovery_weight))
        self.recovery_target = recovery_target
        self.policy_values = policy_values
        self.num_random = num_random
        self.temperature = temperature
        self.make_value_estimator()

    def _input_keys(self) -> list[NestedKey]:
        return actor_critic_in_keys(self, perturbed=True)

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        metrics = ["alpha", "entropy", "pred_value", "target_value", "recovery_gap"]
        return ["loss_actor", "loss_alpha", "loss_qvalue"], metrics

    def _terms(self, tensordict: TensorDictBase) -> Terms:
        step = Step(self, tensordict, perturbed=True)
        objective, log_prob = step.soft_objective("both")
        actor, alpha = step.reduce(objective), step.temperature_loss(log_prob)
        pred_value, gap = self._data_qvalue_and_gap(step)
        target_value = self._target_value(step)
        # The paper prints OSR-v's TD error without the square; (2) has it.
        distance = step.reduce(step.td_distance(pred_value, target_value))
        constraint = step.reduce(gap, transitions=True)
        qvalue = distance + self.recovery_weight * constraint
        step.write_priority(pred_value, target_value)
        losses = {"loss_actor": actor, "loss_alpha": alpha, "loss_qvalue": qvalue}
        metrics = {
            "alpha": self._alpha,
            "entropy": -step.mean(log_prob),
            "pred_value": step.mean(pred_value),
            "target_value": step.mean(target_value),
            "recovery_gap": step.mean(gap, transitions=True),
        }
        return losses, metrics

    @torch.no_grad()
    def _candidates(self, step: Step) -> tuple[Tensor, Tensor, Tensor | None]:
        """The actions whose values are compared, all on D_tot.

        Returns:
            Those to recover with, ``[K, 2, B, A]`` (the data's: ``K = 1``); the
            others, ``[M, 2, B, A]``, and their log-densities ``[M, 2, B]`` where they
            are needed.
        """
        number, pi = (self.num_random,), step.policy("both")
        action, log_prob = rsample_and_log_prob(pi, number)
        if self.recovery_target == "data":
            target = step.data_action.expand_as(pi.loc).unsqueeze(0)
        else:
            model = step.inverse_dynamics("both")
            sizes = model.loc.shape[-1], pi.loc.shape[-1]
            check_num_actions("inverse_dynamics_network", *sizes)
            target, _ = rsample_and_log_prob(model, number)
        if self.policy_values == "mean":
            return target, action, None
        bounds = self.action_low, self.action_high
        uniform, log_density = uniform_actions(self.num_random, pi.loc, *bounds)
        return (
            target,
            torch.cat([uniform, action]),
            torch.cat([log_density, log_prob]),
        )

    def _data_qvalue_and_gap(self, step: Step) -> tuple[Tensor, Tensor]:
        """:math:`Q_i(s, a)`, ``[N, B]``, and the gap of (8), ``[B]``.

        The gap is the mean over both halves of D_tot, summed over critics, as the TD
        error is.
        """
        target, action, log_prob = self._candidates(step)
        candidates = torch.cat([action, target])
        mixed = step.at("both").expand(candidates.shape[:-1])
        # One pass of the critics for the data's action and all candidates.
        qvalue = step.qvalue(
            torch.cat([step.at("clean"), mixed.flatten(0, 1)]),
            torch.cat([step.data_action.unsqueeze(0), candidates.flatten(0, 1)]),
            self.qvalue_network_params,
        )
        compared = qvalue[:, 1:].reshape(-1, *candidates.shape[:-1]).movedim(1, -1)
        gap = functional.value_constraint(
            compared[..., : len(action)],
            compared[..., len(action) :],
            log_prob=None if log_prob is None else log_prob.movedim(0, -1),
            temperature=self.temperature,
        )
        return qvalue[:, 0], gap.mean(1).sum(0)

    @torch.no_grad()
    def _target_value(self, step: Step) -> Tensor:
        """The TD target, ``[B]``, from an action of the policy at ``s'``."""
        action, _ = rsample_and_log_prob(step.target_policy())
        params = self.target_qvalue_network_params
        qvalue = step.qvalue(step.at("next"), action, params)
        return step.td_target(functional.bootstrap_value(qvalue).squeeze(0))
