r"""RORL: an ensemble of critics, and a policy and values that are smooth around states.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``M``
perturbed states of one state. The equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.modules.distributions.utils import rsample_and_log_prob

from torchrl_osr import functional
from torchrl_osr._checks import check_literals, check_positive, check_weight
from torchrl_osr.objectives.base import BaseLoss, Terms, TransitionKeys
from torchrl_osr.objectives.step import (
    Step,
    actor_critic_in_keys,
    distribution,
    observation_keys,
)


class RORLLoss(BaseLoss):
    r"""Robust Offline Reinforcement Learning (RORL).

    SAC-N, and around each state draws :math:`\hat s_j = s + \delta_j` from a box:

    .. math::
        L_\pi &= L_\pi^{SAC} + \beta_P\, \mathbb E_D \max_j
            [KL(\pi(s) \| \pi(\hat s_j)) + KL(\pi(\hat s_j) \| \pi(s))] \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2
            + \beta_Q\, \mathbb E_D\, \mathcal L_{smooth}
            + \beta_{ood}\, \mathbb E_{D, j}\, \mathcal L_{ood}(\hat s_j, \hat a_j)

    with :func:`~torchrl_osr.functional.value_smoothness` and
    :func:`~torchrl_osr.functional.uncertainty_penalty` of the policy's actions. "RORL:
    Robust Offline Reinforcement Learning via Conservative Smoothing",
    https://arxiv.org/abs/2206.02829, and its released code, whose names the options
    have. As there, the ``M`` draws of a term are shared by all rows of the batch. A
    term whose weight is 0 *here* is left out for good and costs nothing.

    The weight :math:`\lambda` of the uncertainty falls with every update: call
    :meth:`decay_uncertainty` after each, as one moves target networks.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.TanhNormal`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights (:func:`~torchrl_osr.modules.critic_ensemble`).

    Keyword Args:
        num_samples: ``M``. Default 20.
        policy_smooth_reg: :math:`\beta_P`. Default 0.1.
        policy_smooth_eps: half-width of its box, in the observation's units, which are
            standard deviations where observations are standardised. Default 0.005.
        q_smooth_reg: :math:`\beta_Q`. Default 1e-4.
        q_smooth_eps: half-width of its box. Default 0.005.
        q_smooth_tau: weight of values that fall against those that rise. Default 0.2.
        q_ood_reg: :math:`\beta_{ood}`. Default 0.5.
        q_ood_eps: half-width of its box. Default 0.01.
        q_ood_uncertainty_reg: :math:`\lambda` at first. Default 0.1.
        q_ood_uncertainty_reg_min: what it falls to. Default 0.
        q_ood_uncertainty_decay: by how much an update. Default 1e-6.
        alpha_init: initial entropy temperature :math:`\alpha_e`. Default 1.0.
        fixed_alpha: keep the temperature. Default ``False``.
        target_entropy: in nats; ``"auto"`` (default) is minus the action's size.
        options: of every loss, see :class:`~torchrl_osr.objectives.BaseLoss`.

    Raises:
        TypeError: if the actor's distribution is not a ``TanhNormal``.
        ValueError: if an option is out of its range, or a single critic shall have a
            deviation; in the call, if the batch is empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr.lab.losses import RORLLoss
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> critics = critic_ensemble(11, 3, num_qvalue_nets=4)
        >>> loss = RORLLoss(tanh_gaussian_actor(11, 3), critics)
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3),
        ...     "next": {"observation": torch.randn(4, 11), "reward": torch.ones(4, 1),
        ...              "done": no, "terminated": no}}, [4])
        >>> sorted(key for key in loss(batch).keys() if key.startswith("loss_"))
        ['loss_actor', 'loss_alpha', 'loss_qvalue']
        >>> loss.decay_uncertainty()
    """

    _AcceptedKeys = TransitionKeys
    default_keys = TransitionKeys
    tensor_keys: TransitionKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        num_samples: int = 20,
        policy_smooth_reg: float = 0.1,
        policy_smooth_eps: float = 0.005,
        q_smooth_reg: float = 1e-4,
        q_smooth_eps: float = 0.005,
        q_smooth_tau: float = 0.2,
        q_ood_reg: float = 0.5,
        q_ood_eps: float = 0.01,
        q_ood_uncertainty_reg: float = 0.1,
        q_ood_uncertainty_reg_min: float = 0.0,
        q_ood_uncertainty_decay: float = 1e-6,
        alpha_init: float = 1.0,
        fixed_alpha: bool = False,
        target_entropy: float | Literal["auto"] = "auto",
        **options: Any,
    ) -> None:
        given = {
            name: value
            for name, value in locals().items()
            if name.endswith(("_reg", "_eps", "_min", "_decay"))
        }
        check_literals(RORLLoss.__init__, locals())
        for name, value in given.items():
            check_weight(name, value)
        check_positive("num_samples", num_samples, minimum=1)
        if q_ood_uncertainty_reg < q_ood_uncertainty_reg_min:
            raise ValueError(
                f"q_ood_uncertainty_reg={q_ood_uncertainty_reg} falls, and is below "
                f"q_ood_uncertainty_reg_min={q_ood_uncertainty_reg_min}: lower the "
                "latter."
            )
        if not 0 <= q_smooth_tau <= 1:
            raise ValueError(f"q_smooth_tau must be in [0, 1], got {q_smooth_tau}.")
        super().__init__(**options)
        self._hold_action_bounds(actor_network)
        self._hold_actor_critic(actor_network, qvalue_network)
        if self.num_qvalue_nets < 2 and q_ood_reg:
            raise ValueError(
                "one critic has no deviation: take num_qvalue_nets of at least 2, or "
                "q_ood_reg=0."
            )
        self._hold_temperature(alpha_init, fixed_alpha, target_entropy)
        for name, value in given.items():
            setattr(self, name, value)
        self.num_samples, self.q_smooth_tau = num_samples, q_smooth_tau
        self.register_buffer("uncertainty_weight", torch.tensor(q_ood_uncertainty_reg))
        self.register_buffer("num_updates", torch.tensor(0.0))
        self.make_value_estimator()

    @torch.no_grad()
    def decay_uncertainty(self) -> None:
        """Lower the weight of the uncertainty by one update's decay."""
        self.num_updates += 1
        # Of the number of updates: small steps of a float32 would add up wrongly.
        fallen = self.num_updates.double() * self.q_ood_uncertainty_decay
        weight = (self.q_ood_uncertainty_reg - fallen).clamp(
            min=self.q_ood_uncertainty_reg_min
        )
        # Into the same tensor: a recording or a CUDA graph reads it there.
        self.uncertainty_weight.copy_(weight)

    def _input_keys(self) -> list[NestedKey]:
        return actor_critic_in_keys(self, perturbed=False)

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        metrics: list[NestedKey] = ["alpha", "entropy", "pred_value", "target_value"]
        metrics += ["policy_smoothness"] * (self.policy_smooth_reg > 0)
        metrics += ["value_smoothness"] * (self.q_smooth_reg > 0)
        metrics += ["uncertainty_penalty"] * (self.q_ood_reg > 0)
        return ["loss_actor", "loss_alpha", "loss_qvalue"], metrics

    def _terms(self, tensordict: TensorDictBase) -> Terms:
        step = Step(self, tensordict, perturbed=False)
        actor, log_prob, smooth = self.actor_loss(step)
        alpha = step.temperature_loss(log_prob)
        params = self.qvalue_network_params
        pred_value = step.qvalue(step.states[0], step.data_action, params)
        target_value = step.soft_target()
        distance = step.td_distance(pred_value, target_value)
        terms = self._value_terms(step, pred_value)
        weights = {
            "value_smoothness": self.q_smooth_reg,
            "uncertainty_penalty": self.q_ood_reg,
        }
        for name, term in terms.items():
            distance = distance + weights[name] * term
        step.write_priority(pred_value, target_value)
        losses = {
            "loss_actor": actor,
            "loss_alpha": alpha,
            "loss_qvalue": step.reduce(distance),
        }
        metrics = {
            "alpha": self._alpha,
            "entropy": -step.mean(log_prob),
            "pred_value": step.mean(pred_value),
            "target_value": step.mean(target_value),
            **{name: step.mean(term) for name, term in (smooth | terms).items()},
        }
        return losses, metrics

    def actor_loss(self, step: Step) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        r""":math:`L_\pi`, the log-density of the policy's actions, its smoothness."""
        objective, log_prob = step.soft_objective("clean")
        if not self.policy_smooth_reg:
            return step.reduce(objective), log_prob, {}
        pi = step.policy("clean")
        around = self._policy(self._around(step.states[0], self.policy_smooth_eps))
        divergence = functional.jeffreys_divergence(
            pi.loc, pi.scale, around.loc, around.scale
        )
        smoothness = divergence.amax(0)
        objective = objective + self.policy_smooth_reg * smoothness
        return step.reduce(objective), log_prob, {"policy_smoothness": smoothness}

    def _value_terms(self, step: Step, pred_value: Tensor) -> dict[str, Tensor]:
        """What is added to the TD distance, unweighted, ``[B]`` each."""
        terms, params, state = {}, self.qvalue_network_params, step.states[0]
        if self.q_smooth_reg:
            around = self._around(state, self.q_smooth_eps)
            action = step.data_action.expand(self.num_samples, *step.data_action.shape)
            difference = step.qvalue(around, action, params) - pred_value.unsqueeze(1)
            terms["value_smoothness"] = functional.value_smoothness(
                difference, self.q_smooth_tau
            )
        if self.q_ood_reg:
            around = self._around(state, self.q_ood_eps)
            with torch.no_grad():
                action, _ = rsample_and_log_prob(self._policy(around))
            qvalue = step.qvalue(around, action, params)
            penalty = functional.uncertainty_penalty(qvalue, self.uncertainty_weight)
            terms["uncertainty_penalty"] = penalty.mean(0)
        return terms

    def _around(self, states: TensorDictBase, epsilon: float) -> TensorDictBase:
        """Perturbed states ``[M, B]``; the draws are the same for all rows."""
        number = self.num_samples
        around = states.expand(number, *states.batch_size).copy()
        for key in observation_keys(self):
            state: Tensor = states.get(key)
            size = state.shape[states.ndim :]
            draws = state.new_empty((number, *size)).uniform_(-epsilon, epsilon)
            around.set(key, state + draws.reshape(number, *[1] * states.ndim, *size))
        return around

    def _policy(self, states: TensorDictBase) -> Any:
        return distribution(self.actor_network, self.actor_network_params, states)
