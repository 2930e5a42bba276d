r"""SDC: a model of the dynamics leads the policy back to the data.

Shapes: ``R`` rows, ``S`` observation, ``A`` action, ``N`` critics, ``n`` samples.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictParams
from torch import Tensor, nn
from torchrl.modules.distributions.utils import rsample_and_log_prob

from torchrl_osr import functional as F
from torchrl_osr._checks import check_at_least, check_positive, check_weight
from torchrl_osr._entries import nested, state_keys
from torchrl_osr.lab.dynamics.models import DynamicsEnsemble, TransitionVAE
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses
from torchrl_osr.objectives.networks import distribution
from torchrl_osr.objectives.transitions import Transitions


def maximum_mean_discrepancy(first: Tensor, second: Tensor, width: float) -> Tensor:
    r"""Return the squared maximum mean discrepancy of two samples, Gaussian kernel.

    The biased estimate of https://jmlr.org/papers/v13/gretton12a.html, with the kernel
    :math:`\exp(-\|x - y\|^2 / (2 h^2 S))` of width :math:`h`, in units of one entry.
    ``[n, R, S]`` and ``[m, R, S]`` give ``[R]``, between 0 and 2.
    """

    def kernel(x: Tensor, y: Tensor) -> Tensor:
        """Return the mean over all pairs, ``[R]``."""
        distance = (x.unsqueeze(1) - y.unsqueeze(0)).square().mean(-1)
        return (distance / (-2 * width**2)).exp().mean((0, 1))

    return kernel(first, first) + kernel(second, second) - 2 * kernel(first, second)


class StateDeviationLoss(ActorCriticLoss):
    r"""State Deviation Correction (SDC): a constraint on the actor of another loss.

    .. math::
        \mathbb E_D\, MMD^2\big( M(\cdot \mid \hat s, \pi(\cdot \mid \hat s)),\,
        U(\cdot \mid s) \big) \le \eta

    with perturbed states :math:`\hat s`, a frozen model :math:`M` of the dynamics and a
    frozen model :math:`U` of the data's next states. ``loss_deviation`` moves the
    policy, ``loss_multiplier`` a Lagrange multiplier. "State Deviation Correction for
    Offline Reinforcement Learning" (AAAI 2022,
    https://doi.org/10.1609/aaai.v36i8.20886) adds it to CQL(H), see
    :class:`~torchrl_osr.objectives.WithRecovery`.

    **This is our reading**: we found neither code nor settings of the authors. The
    kernel, its width, :math:`\eta` and the number of samples are ours.

    Keyword Args:
        num_samples: ``n`` of :math:`M` and of :math:`U`. Default 4.
        kernel_width: in units of the observation. Default 1.
        threshold: :math:`\eta`. Default 0.05.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Examples:
        >>> from torchrl_osr.lab.dynamics import DynamicsEnsemble, TransitionVAE
        >>> from torchrl_osr.lab.losses import StateDeviationLoss
        >>> from torchrl_osr.modules import tanh_gaussian_actor
        >>> loss = StateDeviationLoss(
        ...     tanh_gaussian_actor(11, 3), DynamicsEnsemble(11, 3), TransitionVAE(11))
        >>> loss.out_keys
        ['loss_deviation', 'loss_multiplier', 'deviation', 'multiplier']
    """

    dynamics_network: DynamicsEnsemble
    dynamics_network_params: TensorDictParams
    target_dynamics_network_params: TensorDictParams
    transition_network: TransitionVAE
    transition_network_params: TensorDictParams
    target_transition_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        dynamics_network: DynamicsEnsemble,
        transition_network: TransitionVAE,
        *,
        num_samples: int = 4,
        kernel_width: float = 1.0,
        threshold: float = 0.05,
        **options: Any,
    ) -> None:
        check_at_least(1, "num_samples", num_samples)
        check_positive("kernel_width", kernel_width)
        check_weight("threshold", threshold)
        super().__init__(**options)
        self.convert_to_functional(actor_network, "actor_network")
        self.register_frozen("dynamics_network", dynamics_network)
        self.register_frozen("transition_network", transition_network)
        self.num_samples, self.kernel_width = num_samples, kernel_width
        self.threshold = threshold
        self.log_multiplier = nn.Parameter(self.scalar(0))
        self.declare(["loss_deviation", "loss_multiplier"], ["deviation", "multiplier"])

    def input_keys(self) -> list[NestedKey]:
        states = state_keys([*self.actor_network.in_keys, "observation"])
        return [*states, *(nested(self.tensor_keys.perturbed, key) for key in states)]

    def losses(self, batch: Transitions) -> Losses:
        value, valid = self.deviation(batch), batch.is_data
        policy, dual = F.lagrange_terms(value, self.log_multiplier, self.threshold)
        return {
            "loss_deviation": self.reduce(policy, batch, valid),
            "loss_multiplier": self.reduce(dual, batch, valid),
        }, {
            "deviation": self.mean(value, batch, valid),
            "multiplier": self.log_multiplier.detach().exp(),
        }

    def deviation(self, batch: Transitions) -> Tensor:
        """Return the discrepancy of the next states of policy and data, ``[R]``."""
        model, aims = self.dynamics_network, self.transition_network
        number, keys = self.num_samples, state_keys(self.actor_network.in_keys)
        states = batch.states_of(keys, "perturbed")
        pi = distribution(self.actor_network, self.actor_network_params, states)
        action, _ = rsample_and_log_prob(pi, (number,))
        action = action.squeeze(1)  # of the one set of states
        observed = batch.states_of(["observation"], "both").get("observation")
        clean, start = observed.unsqueeze(1).expand(-1, number, -1, -1)
        with self.dynamics_network_params.to_module(model, preserve_module_state=False):
            change = model.sample(*model.predict(start, action))[..., :-1]
        held = self.transition_network_params
        with torch.no_grad(), held.to_module(aims, preserve_module_state=False):
            aim = aims.sample(clean)
        return maximum_mean_discrepancy(start + change, aim, self.kernel_width)
