r"""EDAC and RORL: SAC with an ensemble of critics, diversified or smoothed.

Shapes: ``R`` rows, ``A`` action, ``N`` critics, ``M`` perturbed states of one state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torch.nn.functional import normalize
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives.utils import _vmap_func

from torchrl_osr import functional as F
from torchrl_osr._checks import check_at_least, check_weight
from torchrl_osr._entries import state_keys
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses, StatePolicy
from torchrl_osr.objectives.networks import distribution, full_precision
from torchrl_osr.objectives.transitions import Transitions


def gradient_diversity(action_gradients: Tensor) -> Tensor:
    """Return the diversity term of gradients ``[N, R, A]``, ``[R]``."""
    # Without eps, a dead critic's zero gradient would be 0 / 0.
    unit = normalize(action_gradients, dim=-1, eps=1e-10)
    # All pairs at once: |sum_i g_i|^2 - sum_i |g_i|^2, with |g_i| = 1.
    pairs = unit.sum(0).square().sum(-1) - unit.square().sum((0, -1))
    return pairs / (len(action_gradients) - 1)


class EDACLoss(ActorCriticLoss):
    r"""Ensemble-Diversified Actor-Critic (EDAC).

    .. math::
        L_Q = \sum_i \mathbb E_D (Q_i - T)^2 + \eta\, \mathbb E_D
            \frac{1}{N - 1} \sum_{i \ne j} \Big\langle
            \frac{\nabla_a Q_i}{\|\nabla_a Q_i\|},
            \frac{\nabla_a Q_j}{\|\nabla_a Q_j\|} \Big\rangle

    and otherwise SAC-N, see :class:`~torchrl_osr.CQLLoss`. "Uncertainty-Based Offline
    Reinforcement Learning with Diversified Q-Ensemble",
    https://arxiv.org/abs/2110.01548. ``loss_qvalue`` holds both terms of :math:`L_Q`.

    Keyword Args:
        diversity_weight: :math:`\eta`. Default 1.0. May be assigned later.
        alpha_init, target_entropy: see :class:`~torchrl_osr.CQLLoss`.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Examples:
        >>> from torchrl_osr.lab.losses import EDACLoss
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> critics = critic_ensemble(11, 3, num_qvalue_nets=4)
        >>> loss = EDACLoss(tanh_gaussian_actor(11, 3), critics)
        >>> loss.out_keys[:3]
        ['loss_actor', 'loss_alpha', 'loss_qvalue']
    """

    _schedulable_buffers = frozenset({"diversity_weight"})

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        diversity_weight: float = 1.0,
        alpha_init: float = 1.0,
        target_entropy: float | Literal["auto"] = "auto",
        **options: Any,
    ) -> None:
        super().__init__(**options)
        networks = actor_network, qvalue_network
        self.register_soft_actor_critic(*networks, alpha_init, target_entropy)
        check_at_least(2, "num_qvalue_nets", self.num_qvalue_nets)
        self.register_coefficient("diversity_weight", diversity_weight)
        self.declare_soft_actor_critic("diversity")

    def losses(self, batch: Transitions) -> Losses:
        policy = self.policy(batch)
        objective, log_prob = self.soft_policy_objective(batch, policy, "clean")
        losses, metrics = self.soft_actor_losses(batch, objective, log_prob)
        gradients, q_data = self.gradients_and_values(batch)
        diversity = gradient_diversity(gradients)
        error, values = self.td_error(batch, q_data, self.soft_target(batch, policy))
        qvalue = self.reduce(error + self.diversity_weight * diversity, batch)
        metrics["diversity"] = self.mean(diversity, batch)
        return losses | {"loss_qvalue": qvalue}, metrics | values

    def gradients_and_values(self, batch: Transitions) -> tuple[Tensor, Tensor]:
        """Return each critic's gradient by the data's action, and value, ``[N, R]``."""
        number, keys = self.num_qvalue_nets, self.tensor_keys
        mode, apart = self.vmap_randomness, self.deactivate_vmap
        network, params = self.qvalue_network, self.qvalue_network_params
        states = batch.s.select(*state_keys(network.in_keys), strict=False)
        states = states.expand(number, *states.batch_size)
        # Each critic at actions of its own, for its own gradient.
        critics = _vmap_func(network, (0, 0), pseudo_vmap=apart, randomness=mode)

        def total(action: Tensor) -> tuple[Tensor, Tensor]:
            rows = critics(states.copy().set(keys.action, action), params)
            value = full_precision(rows).get(keys.state_action_value).squeeze(-1)
            return value.sum(), value

        # torch.func, unlike torch.autograd.grad, can be compiled; both can be
        # differentiated once more.
        actions = batch.a.expand(number, -1, -1)
        return torch.func.grad(total, has_aux=True)(actions)


class RORLLoss(ActorCriticLoss):
    r"""Robust Offline Reinforcement Learning (RORL).

    SAC-N, and around each state draws :math:`\hat s_j = s + \delta_j` from a box:

    .. math::
        L_\pi &= L_\pi^{SAC} + \beta_P\, \mathbb E_D \max_j
            [KL(\pi(s) \| \pi(\hat s_j)) + KL(\pi(\hat s_j) \| \pi(s))] \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2
            + \beta_Q\, \mathbb E_D\, \mathcal L_{smooth}
            + \beta_{ood}\, \mathbb E_{D, j}\, \mathcal L_{ood}(\hat s_j, \hat a_j)

    with :meth:`value_smoothness` and :meth:`uncertainty_penalty` of the policy's
    actions. "RORL: Robust Offline Reinforcement Learning via Conservative Smoothing",
    https://arxiv.org/abs/2206.02829, and its released code, whose names the options
    have. As there, the ``M`` draws of a term are shared by all rows of the batch. A
    term with weight 0 is left out for good.

    Call :meth:`decay_uncertainty` after each update.

    Keyword Args:
        num_samples: ``M``. Default 20.
        policy_smooth_reg, q_smooth_reg, q_ood_reg: the weights :math:`\beta_P`,
            :math:`\beta_Q` and :math:`\beta_{ood}`. Default 0.1, 1e-4 and 0.5.
        policy_smooth_eps, q_smooth_eps, q_ood_eps: half-widths, 0.005, 0.005 and 0.01.
        q_smooth_tau: weight of values that fall against those that rise. Default 0.2.
        q_ood_uncertainty_reg, q_ood_uncertainty_reg_min, q_ood_uncertainty_decay:
            :math:`\lambda` at first, at last, and its fall an update: 0.1, 0, 1e-6.
        alpha_init, target_entropy: see :class:`~torchrl_osr.CQLLoss`.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Examples:
        >>> from torchrl_osr.lab.losses import RORLLoss
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> critics = critic_ensemble(11, 3, num_qvalue_nets=4)
        >>> loss = RORLLoss(tanh_gaussian_actor(11, 3), critics)
        >>> loss.decay_uncertainty()
        >>> loss.uncertainty_weight
        tensor(0.1000)
    """

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
        target_entropy: float | Literal["auto"] = "auto",
        **options: Any,
    ) -> None:
        for name, value in list(locals().items()):
            if name.endswith(("_reg", "_eps", "_min", "_decay")):
                check_weight(name, value)
                setattr(self, name, value)
        check_at_least(1, "num_samples", num_samples)
        super().__init__(**options)
        networks = actor_network, qvalue_network
        self.register_soft_actor_critic(*networks, alpha_init, target_entropy)
        if q_ood_reg:  # one critic has no deviation
            check_at_least(2, "num_qvalue_nets", self.num_qvalue_nets)
        self.num_samples, self.q_smooth_tau = num_samples, q_smooth_tau
        self.register_buffer("num_updates", self.scalar(0))
        terms = {
            "policy_smoothness": policy_smooth_reg,
            "value_smoothness": q_smooth_reg,
            "uncertainty_penalty": q_ood_reg,
        }
        self.declare_soft_actor_critic(*(name for name in terms if terms[name]))

    def decay_uncertainty(self) -> None:
        """Lower the weight of the uncertainty by one update's decay."""
        self.num_updates += 1

    @property
    def uncertainty_weight(self) -> Tensor:
        """Weight of the uncertainty after the updates so far."""
        # Of the number of updates: small steps of a float32 would add up wrongly.
        fallen = self.num_updates.double() * self.q_ood_uncertainty_decay
        weight: Tensor = self.q_ood_uncertainty_reg - fallen
        return weight.clamp(min=self.q_ood_uncertainty_reg_min).to(self.num_updates)

    def losses(self, batch: Transitions) -> Losses:
        policy = self.policy(batch)
        objective, log_prob = self.soft_policy_objective(batch, policy, "clean")
        terms: dict[str, Tensor] = {}
        if self.policy_smooth_reg:
            terms["policy_smoothness"] = term = self.policy_smoothness(batch, policy)
            objective = objective + self.policy_smooth_reg * term
        losses, metrics = self.soft_actor_losses(batch, objective, log_prob)
        q_data = self.q(batch.s, batch.a)
        error, values = self.td_error(batch, q_data, self.soft_target(batch, policy))
        if self.q_smooth_reg:
            terms["value_smoothness"] = term = self.value_smoothness(batch, q_data)
            error = error + self.q_smooth_reg * term
        if self.q_ood_reg:
            terms["uncertainty_penalty"] = term = self.uncertainty_penalty(batch)
            error = error + self.q_ood_reg * term
        losses["loss_qvalue"] = self.reduce(error, batch)
        metrics |= {name: self.mean(term, batch) for name, term in terms.items()}
        return losses, metrics | values

    def policy_smoothness(self, batch: Transitions, policy: StatePolicy) -> Tensor:
        """Return the largest divergence of the policy around a state, ``[R]``."""
        pi, around = policy["clean"], self.around(batch, self.policy_smooth_eps)
        other = distribution(self.actor_network, self.actor_network_params, around)
        ours, theirs = (pi.loc, pi.scale), (other.loc, other.scale)
        both = F.gaussian_kl(*ours, *theirs) + F.gaussian_kl(*theirs, *ours)
        return both.sum(-1).amax(0)

    def value_smoothness(self, batch: Transitions, q_data: Tensor) -> Tensor:
        r"""Return the change of the values around a state, ``[R]``.

        :math:`\max_j \frac1N \sum_i (1 - \tau) \max(d_{ij}, 0)^2 + \tau \min(d_{ij},
        0)^2` with :math:`d_{ij} = Q_i(\hat s_j, a) - Q_i(s, a)`, as in RORL's code.
        """
        around = self.around(batch, self.q_smooth_eps)
        action = batch.a.expand(self.num_samples, *batch.a.shape)
        difference = self.q(around, action) - q_data.unsqueeze(1)
        rise, fall = difference.clamp(min=0).square(), difference.clamp(max=0).square()
        tau = self.q_smooth_tau
        return ((1 - tau) * rise + tau * fall).mean(0).amax(0)

    def uncertainty_penalty(self, batch: Transitions) -> Tensor:
        r"""Return the penalty of the policy's actions around a state, ``[R]``.

        :math:`\frac1N \sum_i (Q_i - [Q_i - \lambda\, \text{std}_i Q_i])^2`. The bracket
        has no gradient: the more the critics disagree, the further each falls.
        """
        around = self.around(batch, self.q_ood_eps)
        with torch.no_grad():
            pi = distribution(self.actor_network, self.actor_network_params, around)
            action, _ = rsample_and_log_prob(pi)
        qvalue = self.q(around, action)
        target = (qvalue - self.uncertainty_weight * qvalue.std(0)).detach()
        return (qvalue - target).square().mean(0).mean(0)

    def around(self, batch: Transitions, epsilon: float) -> TensorDictBase:
        """Return perturbed states ``[M, R]``; the draws are the same for all rows."""
        states, number = batch.s, self.num_samples
        around = states.expand(number, *states.batch_size).copy()
        for key in self.observation_keys:
            state: Tensor = states.get(key)
            size = state.shape[1:]
            draws = state.new_empty((number, 1, *size)).uniform_(-epsilon, epsilon)
            around.set(key, state + draws)
        return around
