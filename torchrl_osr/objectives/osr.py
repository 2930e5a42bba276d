r"""OSR: conservative Q-learning whose policy learns to come back to the data.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``K``
sampled actions of a kind, ``D`` sets of states (2 for D_tot: clean and perturbed). The
equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.modules.distributions.utils import rsample_and_log_prob

from torchrl_osr import functional
from torchrl_osr._checks import check_literals, check_positive, check_weight
from torchrl_osr.fast import critics
from torchrl_osr.objectives.base import BaseLoss, Terms, TransitionKeys
from torchrl_osr.objectives.distributions import check_num_actions
from torchrl_osr.objectives.mixed_states import States
from torchrl_osr.objectives.step import (
    Step,
    actor_critic_in_keys,
    critic_state,
    uniform_actions,
)


class OSRLoss(BaseLoss):
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
    ``recovery_weight=0, actor_states="clean"`` it is CQL(H) ("Conservative Q-Learning",
    https://arxiv.org/abs/2006.04779): no inverse dynamics model is called and no
    perturbed state is read.

    The entries are those of :class:`~torchrl.objectives.CQLLoss`: ``loss_actor`` (both
    terms of :math:`L_\pi`), ``loss_qvalue``, ``loss_cql`` and ``loss_alpha``. Each is
    weighted already and sends gradient to its own parameters only: add them up for one
    backward and one optimizer step, or use separate optimizers.

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
            schedule; 0 *here* leaves the recovery term out for good.
        recovery_direction: ``"forward"`` (default, the paper's ``KL(I || pi)``) or
            ``"reverse"`` (``KL(pi || I)``, the released code's).
        recovery_target: what the policy is pulled to: ``"inverse_dynamics"``
            (default), the model, or ``"data"``, the data's action: then
            ``-log pi(a | s~)`` replaces the divergence, and the loss is CQL with
            behaviour cloning, noisy on D_tot: OSR without its model.
        recovery_states: where the recovery term is taken: ``"both"`` (default) for
            D_tot, ``"perturbed"`` or ``"clean"`` states alone.
        action_reduction: of the recovery term over action dimensions: ``"sum"``
            (default, the paper's) or ``"mean"`` (the released code's).
        actor_states: where the policy seeks values, whatever the recovery term does:
            ``"both"`` (default) for D_tot, ``"clean"`` or ``"perturbed"`` states alone.
        min_q_weight: :math:`\alpha`, weight of the conservative term. Default 5.0. May
            be assigned later; 0 *here* leaves the term out for good, which with
            ``num_qvalue_nets=10`` is OSR-10, and without recovery SAC-N
            (https://arxiv.org/abs/2110.01548).
        num_random: ``K``, actions drawn of each kind (uniform, at ``s``, at ``s'``).
            Default 10.
        temperature: :math:`\tau` of the log-sum-exp, in units of the value. Default
            1.0.
        clip_diff_min: lower bound of the conservative gap, per critic and row, in
            units of the value. Default: none.
        max_q_backup: the target's value is the largest of ``num_random`` actions'.
            Default ``False``.
        deterministic_backup: leave the entropy out of the target, as CQL does and
            SAC-N does not. Default ``True``.
        with_lagrange: learn a multiplier of the conservative term that holds the gap
            at ``lagrange_thresh``; adds ``loss_alpha_prime``. Default ``False``.
        lagrange_thresh: the tolerated gap, in units of the value. Default 0.0.
        alpha_init: initial entropy temperature :math:`\alpha_e`. Default 1.0.
        min_alpha, max_alpha: bounds of the temperature. Default: none.
        fixed_alpha: keep the temperature. Default ``False``.
        target_entropy: in nats; ``"auto"`` (default) is minus the action's size.
        action_spec: of the environment's actions, whose bounds must be the actor's.
            Default: not compared.
        delay_actor: the action in the TD target is that of a target actor, which
            :class:`~torchrl.objectives.SoftUpdate` moves with the target critics.
            Default ``False``.
        chunk_size: on a CPU, how many states go through the critics at a time, with
            all their sampled actions, if the critics are plain MLPs; ``None`` for all
            at once, as other networks go. Default 64. The mathematics is the same.
        options: of every loss, see :class:`~torchrl_osr.objectives.BaseLoss`.

    Raises:
        TypeError: if a distribution is not a ``TanhNormal``, or ``gamma`` is given.
        ValueError: if bounds differ, an option is out of its range or the model is
            missing; in the call, if the batch is empty or holds several steps a row.
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
        ['loss_actor', 'loss_alpha', 'loss_cql', 'loss_qvalue']
    """

    _schedulable_buffers = frozenset({"recovery_weight", "min_q_weight"})

    _AcceptedKeys = TransitionKeys
    default_keys = TransitionKeys
    tensor_keys: TransitionKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None = None,
        *,
        recovery_weight: float = 0.5,
        recovery_direction: Literal["forward", "reverse"] = "forward",
        recovery_target: Literal["inverse_dynamics", "data"] = "inverse_dynamics",
        recovery_states: States = "both",
        action_reduction: Literal["sum", "mean"] = "sum",
        actor_states: States = "both",
        min_q_weight: float = 5.0,
        num_random: int = 10,
        temperature: float = 1.0,
        clip_diff_min: float = -math.inf,
        max_q_backup: bool = False,
        deterministic_backup: bool = True,
        with_lagrange: bool = False,
        lagrange_thresh: float = 0.0,
        alpha_init: float = 1.0,
        min_alpha: float | None = None,
        max_alpha: float | None = None,
        fixed_alpha: bool = False,
        target_entropy: float | Literal["auto"] = "auto",
        action_spec: TensorSpec | None = None,
        delay_actor: bool = False,
        chunk_size: int | None = 64,
        **options: Any,
    ) -> None:
        check_literals(OSRLoss.__init__, locals())
        check_weight("recovery_weight", recovery_weight)
        check_weight("min_q_weight", min_q_weight)
        check_positive("num_random", num_random, minimum=1)
        check_positive("temperature", temperature)
        if chunk_size is not None:
            check_positive("chunk_size", chunk_size, minimum=1)
        if with_lagrange and not min_q_weight:
            raise ValueError("with_lagrange=True needs min_q_weight above 0.")
        if max_q_backup and not deterministic_backup:
            raise ValueError(
                "max_q_backup=True takes the best action's value without entropy, as "
                "CQL does: leave deterministic_backup=True."
            )
        needs_model = recovery_weight > 0 and recovery_target == "inverse_dynamics"
        if needs_model and inverse_dynamics_network is None:
            raise ValueError(
                f"recovery_weight={recovery_weight} needs an inverse_dynamics_network; "
                "pass one, or recovery_weight=0 for CQL."
            )
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
        if with_lagrange:
            self.log_alpha_prime = nn.Parameter(torch.zeros(()))
        self.register_coeff_buffer("recovery_weight", float(recovery_weight))
        self.register_coeff_buffer("min_q_weight", float(min_q_weight))
        self.has_recovery, self.has_cql = recovery_weight > 0, min_q_weight > 0
        self.recovery_direction = recovery_direction
        self.recovery_target = recovery_target
        self.recovery_states = recovery_states
        self.action_reduction = action_reduction
        self.actor_states = actor_states
        self.num_random = num_random
        self.temperature = temperature
        self.clip_diff_min = clip_diff_min
        self.max_q_backup = max_q_backup
        self.deterministic_backup = deterministic_backup
        self.with_lagrange = with_lagrange
        self.lagrange_thresh = lagrange_thresh
        self.chunk_size = chunk_size
        # Now, not at the first call as TorchRL does: a state dict has the same entries
        # before and after it.
        self.make_value_estimator()

    @property
    def reads_perturbed(self) -> bool:
        """Whether the batch must hold perturbed states."""
        recovers = self.has_recovery and self.recovery_states != "clean"
        return recovers or self.actor_states != "clean"

    def _input_keys(self) -> list[NestedKey]:
        return actor_critic_in_keys(self, perturbed=self.reads_perturbed)

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        losses: list[NestedKey] = ["loss_actor", "loss_alpha", "loss_qvalue"]
        losses += ["loss_cql"] * self.has_cql
        losses += ["loss_alpha_prime"] * self.with_lagrange
        metrics: list[NestedKey] = ["alpha", "entropy", "pred_value", "target_value"]
        metrics += ["alpha_prime"] * self.with_lagrange
        return losses, metrics + [self._recovery_metric] * self.has_recovery

    @property
    def _recovery_metric(self) -> str:
        return "recovery_nll" if self.recovery_target == "data" else "recovery_kl"

    def _terms(self, tensordict: TensorDictBase) -> Terms:
        step = Step(self, tensordict, perturbed=self.reads_perturbed)
        return self._terms_of(step)

    def _terms_of(self, step: Step) -> Terms:
        actor, log_prob, metrics = self.actor_loss(step)
        alpha = step.temperature_loss(log_prob)
        pred_value, cql, cql_metrics = self.cql_loss(step)
        target_value = self._target_value(step)
        qvalue = step.reduce(step.td_distance(pred_value, target_value))
        step.write_priority(pred_value, target_value)
        losses = {"loss_actor": actor, "loss_alpha": alpha, "loss_qvalue": qvalue} | cql
        metrics = {
            "alpha": self._alpha,
            "entropy": -step.mean(log_prob),
            "pred_value": step.mean(pred_value),
            "target_value": step.mean(target_value),
            **cql_metrics,
            **metrics,
        }
        return losses, metrics

    def actor_loss(self, step: Step) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        r""":math:`L_\pi`: values sought on ``actor_states``, and the recovery term.

        Returns:
            The loss, the log-density of the policy's own actions ``[D, B]``, metrics.
        """
        objective, log_prob = step.soft_objective(self.actor_states)
        loss, metrics = step.reduce(objective), {}
        if self.has_recovery:
            recovery = self._recovery_divergence(step).mean(0)
            term = step.reduce(recovery, transitions=True)
            loss = loss + self.recovery_weight * term
            metrics[self._recovery_metric] = step.mean(recovery, transitions=True)
        return loss, log_prob, metrics

    def _recovery_divergence(self, step: Step) -> Tensor:
        """Divergence of policy and target on ``recovery_states``, ``[D, B]``."""
        pi = step.policy(self.recovery_states)
        if self.recovery_target == "data":
            log_prob: Tensor = pi.log_prob(step.data_action.expand_as(pi.loc))
            terms = pi.loc.shape[-1] if self.action_reduction == "mean" else 1
            return -log_prob / terms
        model = step.inverse_dynamics(self.recovery_states)
        sizes = model.loc.shape[-1], pi.loc.shape[-1]
        check_num_actions("inverse_dynamics_network", *sizes)
        return functional.state_recovery(
            pi.loc,
            pi.scale,
            model.loc,
            model.scale,
            direction=self.recovery_direction,
            action_reduction=self.action_reduction,
        )

    def cql_loss(
        self, step: Step
    ) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        """CQL(H) penalty, weighted, and the critics' values of the data's action.

        Returns:
            :math:`Q_i(s, a)`, ``[N, B]``; ``loss_cql`` and, with a Lagrange multiplier,
            ``loss_alpha_prime``; metrics.
        """
        if not self.has_cql:
            return self._data_qvalue(step), {}, {}
        pred_value, soft_maximum = self._data_qvalue_and_soft_maximum(step)
        gap = functional.conservative_gap(soft_maximum, pred_value)
        if self.clip_diff_min > -math.inf:
            gap = gap.clamp(min=self.clip_diff_min)
        losses: dict[str, Tensor] = {}
        metrics: dict[str, Tensor] = {}
        if self.with_lagrange:
            gap, multiplier = functional.lagrange_terms(
                gap, self.log_alpha_prime, self.lagrange_thresh
            )
            multiplier = step.reduce(multiplier.mean(0))
            losses["loss_alpha_prime"] = self.min_q_weight * multiplier
            metrics["alpha_prime"] = self.log_alpha_prime.detach().exp()
        losses = {"loss_cql": self.min_q_weight * step.reduce(gap.sum(0))} | losses
        return pred_value, losses, metrics

    def _data_qvalue(self, step: Step) -> Tensor:
        state, params = step.states[0], self.qvalue_network_params
        return step.qvalue(state, step.data_action, params)

    @torch.no_grad()
    def _proposals(self, step: Step) -> tuple[Tensor, Tensor]:
        """``K`` actions each: uniform, from ``pi(s)`` and from ``pi(s')``.

        Returns:
            Actions ``[3K, B, A]`` and their log-densities ``[3K, B]``.
        """
        number, bounds = self.num_random, (self.action_low, self.action_high)
        uniform, log_density = uniform_actions(number, step.data_action, *bounds)
        # rsample also without gradient: torch's sample reads the scale back to the host
        # to check its sign.
        action, log_prob = rsample_and_log_prob(step.policy("true"), (number,))
        return (
            torch.cat([uniform, action.flatten(0, 1)]),
            torch.cat([log_density, log_prob.flatten(0, 1)]),
        )

    def _data_qvalue_and_soft_maximum(self, step: Step) -> tuple[Tensor, Tensor]:
        """Both terms of the conservative gap, each ``[N, B]``; all actions at ``s``."""
        action, log_prob = self._proposals(step)
        state, params = step.states[0], self.qvalue_network_params
        # The one place where a kernel replaces a function of the same value.
        mlp = critics.applicable(self, state, action)
        if self.chunk_size is not None and mlp is not None:
            soft_maximum = critics.soft_maximum(
                params,
                mlp,
                critic_state(self, state),
                action,
                log_prob,
                temperature=self.temperature,
                chunk_size=self.chunk_size,
                equal_rows=self.clip_diff_min == -math.inf
                and self._rows_weigh_alike(step.tensordict),
            )
            return self._data_qvalue(step), soft_maximum
        # One pass of the critics for the data's action and all proposals.
        action = torch.cat([step.data_action.unsqueeze(0), action])
        qvalue = step.qvalue(state.expand(action.shape[:-1]), action, params)
        sampled = qvalue[:, 1:].movedim(1, -1)
        soft_maximum = functional.soft_maximum(
            sampled, log_prob.movedim(0, -1), temperature=self.temperature
        )
        return qvalue[:, 0], soft_maximum

    @torch.no_grad()
    def _target_value(self, step: Step) -> Tensor:
        """The TD target, ``[B]``, from an action of the policy at ``s'``."""
        if not (self.max_q_backup or self.deterministic_backup):
            return step.soft_target()
        state, pi = step.at("next"), step.target_policy()
        number = (self.num_random,) if self.max_q_backup else ()
        action, _ = rsample_and_log_prob(pi, number)
        params = self.target_qvalue_network_params
        qvalue = step.qvalue(state.expand(action.shape[:-1]), action, params)
        next_value = functional.bootstrap_value(qvalue)
        if self.max_q_backup:
            next_value = next_value.max(0).values
        return step.td_target(next_value.squeeze(0))
