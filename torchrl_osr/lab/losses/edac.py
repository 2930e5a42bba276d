r"""EDAC: an ensemble of critics whose action gradients are kept apart.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics. The equations
are in :mod:`torchrl_osr.functional`.
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
from torchrl.objectives.utils import _vmap_func

from torchrl_osr import functional
from torchrl_osr._checks import check_literals, check_weight
from torchrl_osr.objectives.base import BaseLoss, Terms, TransitionKeys
from torchrl_osr.objectives.step import Step, actor_critic_in_keys, critic_inputs


class EDACLoss(BaseLoss):
    r"""Ensemble-Diversified Actor-Critic (EDAC).

    .. math::
        L_\pi &= \mathbb E_D
            [\alpha_e \log\pi(\hat a \mid s) - \min_i Q_i(s, \hat a)] \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2 + \eta\, \mathbb E_D
            \frac{1}{N - 1} \sum_{i \ne j} \Big\langle
            \frac{\nabla_a Q_i}{\|\nabla_a Q_i\|},
            \frac{\nabla_a Q_j}{\|\nabla_a Q_j\|} \Big\rangle \\
        T &= r + \gamma\,(1 - \text{terminated})
            [\min_i \bar Q_i(s', a') - \alpha_e \log\pi(a' \mid s')]

    Presented in "Uncertainty-Based Offline Reinforcement Learning with Diversified
    Q-Ensemble", https://arxiv.org/abs/2110.01548. With ``diversity_weight=0`` it is
    SAC-N. ``loss_qvalue`` holds both terms of :math:`L_Q`.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.TanhNormal`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights (:func:`~torchrl_osr.modules.critic_ensemble`).

    Keyword Args:
        diversity_weight: :math:`\eta`. Default 1.0. May be assigned later.
        alpha_init: initial entropy temperature :math:`\alpha_e`. Default 1.0.
        fixed_alpha: keep the temperature. Default ``False``.
        target_entropy: in nats; ``"auto"`` (default) is minus the action's size.
        options: of every loss, see :class:`~torchrl_osr.objectives.BaseLoss`.

    Raises:
        TypeError: if the actor's distribution is not a ``TanhNormal``.
        ValueError: if an option is out of its range or there is a single critic; in the
            call, if the batch is empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr.lab.losses import EDACLoss
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> critics = critic_ensemble(11, 3, num_qvalue_nets=4)
        >>> loss = EDACLoss(tanh_gaussian_actor(11, 3), critics)
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3),
        ...     "next": {"observation": torch.randn(4, 11), "reward": torch.ones(4, 1),
        ...              "done": no, "terminated": no}}, [4])
        >>> sorted(key for key in loss(batch).keys() if key.startswith("loss_"))
        ['loss_actor', 'loss_alpha', 'loss_qvalue']
    """

    _schedulable_buffers = frozenset({"diversity_weight"})

    _AcceptedKeys = TransitionKeys
    default_keys = TransitionKeys
    tensor_keys: TransitionKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        diversity_weight: float = 1.0,
        alpha_init: float = 1.0,
        fixed_alpha: bool = False,
        target_entropy: float | Literal["auto"] = "auto",
        **options: Any,
    ) -> None:
        check_literals(EDACLoss.__init__, locals())
        check_weight("diversity_weight", diversity_weight)
        super().__init__(**options)
        self._hold_action_bounds(actor_network)
        self._hold_actor_critic(actor_network, qvalue_network)
        if self.num_qvalue_nets < 2:
            raise ValueError(
                "EDACLoss compares critics with each other: it needs num_qvalue_nets "
                "of at least 2."
            )
        self._hold_temperature(alpha_init, fixed_alpha, target_entropy)
        self.register_coeff_buffer("diversity_weight", float(diversity_weight))
        self.make_value_estimator()

    def _make_vmap(self) -> None:
        super()._make_vmap()
        # Each critic at actions of its own, for its own gradient.
        self._vmap_qvalue_each = _vmap_func(
            self.qvalue_network,
            (0, 0),
            randomness=self.vmap_randomness,
            pseudo_vmap=self.deactivate_vmap,
        )

    def _input_keys(self) -> list[NestedKey]:
        return actor_critic_in_keys(self, perturbed=False)

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        metrics = ["alpha", "entropy", "pred_value", "target_value", "diversity"]
        return ["loss_actor", "loss_alpha", "loss_qvalue"], metrics

    def _terms(self, tensordict: TensorDictBase) -> Terms:
        step = Step(self, tensordict, perturbed=False)
        objective, log_prob = step.soft_objective("clean")
        actor, alpha = step.reduce(objective), step.temperature_loss(log_prob)
        params = self.qvalue_network_params
        pred_value = step.qvalue(step.states[0], step.data_action, params)
        diversity = functional.gradient_diversity(self._action_gradients(step))
        target_value = step.soft_target()
        distance = step.td_distance(pred_value, target_value)
        qvalue = step.reduce(distance + self.diversity_weight * diversity)
        step.write_priority(pred_value, target_value)
        losses = {"loss_actor": actor, "loss_alpha": alpha, "loss_qvalue": qvalue}
        metrics = {
            "alpha": self._alpha,
            "entropy": -step.mean(log_prob),
            "pred_value": step.mean(pred_value),
            "target_value": step.mean(target_value),
            "diversity": step.mean(diversity),
        }
        return losses, metrics

    def _action_gradients(self, step: Step) -> Tensor:
        """Gradient of each critic by the data's action, ``[N, B, A]``."""
        number, action = self.num_qvalue_nets, step.data_action
        states = critic_inputs(self, step.states[0])
        states = states.expand(number, *states.batch_size)
        params = self.qvalue_network_params

        def total(action: Tensor) -> Tensor:
            batch = states.copy().set(self.tensor_keys.action, action)
            batch = self._vmap_qvalue_each(batch, params)
            value: Tensor = batch.get(self.tensor_keys.state_action_value)
            return value.sum()

        # torch.func, unlike torch.autograd.grad, can be compiled; both can be
        # differentiated once more.
        gradient: Tensor = torch.func.grad(total)(action.expand(number, *action.shape))
        return gradient
