"""Loss of an ensemble of dynamics models.

Shapes: ``B`` batch (any leading dimensions), ``E`` networks, ``D`` predicted entries.
"""

from __future__ import annotations

from typing import Literal

from tensordict import NestedKey, TensorDictParams
from torch import Tensor

from torchrl_osr._checks import check_weight
from torchrl_osr._entries import nested
from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble, has_next_state
from torchrl_osr.objectives import ActorCriticLoss
from torchrl_osr.objectives.actor_critic import Losses
from torchrl_osr.objectives.transitions import Transitions, check_single_steps


def gaussian_error(mean: Tensor, log_variance: Tensor, target: Tensor) -> Tensor:
    r"""Return :math:`\frac1D \sum_d (\mu_d - y_d)^2 / \sigma_d^2 + \log \sigma_d^2`.

    This is twice the negative log-likelihood without its constant, ``[B]``.
    """
    return ((mean - target).square() * (-log_variance).exp() + log_variance).mean(-1)


class DynamicsLoss(ActorCriticLoss):
    r"""Negative log-likelihood of next state and reward, and bounds of the variance.

    .. math::
        L = \sum_{i=1}^{E} \frac1{D} \sum_d \mathbb E \Big[
            \frac{(\mu_{i,d} - y_d)^2}{\sigma_{i,d}^2} + \log \sigma_{i,d}^2 \Big]
            + w \sum_d \big( v^{max}_d - v^{min}_d \big)

    with the standardised targets :math:`y = (s' - s, r)` and the learned bounds
    :math:`v` of the log-variance, as in MOPO's code (https://arxiv.org/abs/2005.13239,
    tianheyu927/mopo). MOPO's weight decay is in
    :meth:`~torchrl_osr.lab.dynamics.DynamicsEnsemble.parameter_groups`. The batch is
    divided among the networks, where MOPO draws bootstrap samples. Rows without a next
    state do not count.

    Args:
        dynamics_network: to be trained, standardised already.

    Keyword Args:
        bound_weight: ``w``. Default 0.01, MOPO's.
        reduction: of the likelihood, ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.lab.dynamics import DynamicsEnsemble, DynamicsLoss
        >>> loss = DynamicsLoss(DynamicsEnsemble(11, 3, num_networks=2, num_elites=1))
        >>> batch = TensorDict({
        ...     "observation": torch.randn(6, 11), "action": torch.rand(6, 3),
        ...     "next": {"observation": torch.randn(6, 11), "reward": torch.ones(6, 1),
        ...              "terminated": torch.zeros(6, 1, dtype=torch.bool)}}, [6])
        >>> sorted(loss(batch).keys())
        ['loss_bounds', 'loss_dynamics']
    """

    dynamics_network: DynamicsEnsemble
    dynamics_network_params: TensorDictParams
    target_dynamics_network_params: TensorDictParams

    def __init__(
        self,
        dynamics_network: DynamicsEnsemble,
        *,
        bound_weight: float = 0.01,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        check_weight("bound_weight", bound_weight)
        super().__init__(
            reduction=reduction,
            use_prioritized_weights=False,
            scalar_output_mode="exclude",
        )
        self.convert_to_functional(dynamics_network, "dynamics_network")
        self.bound_weight = bound_weight
        self.declare(["loss_dynamics", "loss_bounds"], [])

    def input_keys(self) -> list[NestedKey]:
        key, action = self.dynamics_network.in_keys
        following = [nested("next", each) for each in (key, "reward", "terminated")]
        return [key, action, *following]

    def losses(self, batch: Transitions) -> Losses:
        check_single_steps(batch, "the model of the dynamics")
        tensordict, model = batch.one_step, self.dynamics_network
        rows = tensordict.batch_size.numel()
        if rows % model.num_networks:
            raise ValueError(
                f"The batch has {rows} rows for {model.num_networks} networks, each of "
                "which has rows of its own: expected a multiple."
            )
        with self.dynamics_network_params.to_module(model):
            inputs, targets = model.inputs_and_targets(tensordict)
            targets = (targets - model.target_loc) / model.target_scale
            inputs, targets = (
                each.reshape(model.num_networks, -1, each.shape[-1])
                for each in (inputs, targets)
            )
            mean, log_variance = model.standardized(inputs)
            width = model.highest_log_variance - model.lowest_log_variance
            bounds = self.bound_weight * width.sum()
        error = gaussian_error(mean, log_variance, targets)
        # Of the mean over E times as many rows as each network has.
        value = error.reshape(tensordict.batch_size) * (
            model.num_networks if self.reduction == "mean" else 1
        )
        valid = has_next_state(tensordict, model.in_keys[0])
        loss = self.reduce(value, batch, valid)
        if self.reduction == "none":
            bounds = bounds.expand(batch.tensordict.batch_size) / rows
        losses = {"loss_dynamics": loss, "loss_bounds": bounds}
        return losses, {}
