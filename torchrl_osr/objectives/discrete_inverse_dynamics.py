r"""The loss that trains the inverse dynamics model of discrete actions.

Shapes: ``B`` batch (any leading dimensions), ``n`` number of actions.
"""

from __future__ import annotations

from typing import Literal

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torchrl_osr.objectives.base import Reduction
from torchrl_osr.objectives.distributions import action_index, check_categorical
from torchrl_osr.objectives.inverse_dynamics import InverseDynamicsLoss


class DiscreteInverseDynamicsLoss(InverseDynamicsLoss):
    r"""Cross-entropy of the data's action given both states.

    .. math::
        L = -\mathbb E_{(\tilde s, a, s') \sim D_{tot}} \log I(a \mid \tilde s, s')

    :class:`~torchrl_osr.InverseDynamicsLoss` for a model that chooses among ``n``
    actions: the same entries, the same rows that are left out because they are
    ``done``. It knows the likelihood alone: no squared error, no latent variable.

    Args:
        inverse_dynamics_network: reads states and next states, ends in a
            :class:`~torchrl.modules.OneHotCategorical`, and then reads one-hot actions
            ``[B, n]`` from the batch, or in a
            :class:`torch.distributions.Categorical`, and reads indices ``[B]`` or
            ``[B, 1]``; see
            :func:`~torchrl_osr.modules.categorical_inverse_dynamics`.

    Keyword Args:
        states: ``"both"`` (default) for D_tot, which needs the ``"perturbed"`` entry
            of :class:`~torchrl_osr.StatePerturbation`; ``"clean"`` for the data alone.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``. The loss is in nats.

    Raises:
        TypeError: if the network does not end in a categorical distribution.
        ValueError: if an option is unknown; in the call, if the batch's actions are
            not of the network's kind or number.
        KeyError: in the call, if no perturbed entry is there, unless
            ``states="clean"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr import DiscreteInverseDynamicsLoss, StatePerturbation
        >>> from torchrl_osr.modules import categorical_inverse_dynamics
        >>> loss = DiscreteInverseDynamicsLoss(categorical_inverse_dynamics(4, 2))
        >>> batch = TensorDict({
        ...     "observation": torch.randn(3, 4), "action": torch.eye(2)[[0, 1, 0]],
        ...     "next": {"observation": torch.randn(3, 4),
        ...              "done": torch.zeros(3, 1, dtype=torch.bool)}}, [3])
        >>> batch = StatePerturbation(std=1e-3)(batch)
        >>> loss(batch)["loss_inverse_dynamics"].shape
        torch.Size([])
    """

    def __init__(
        self,
        inverse_dynamics_network: ProbabilisticTensorDictSequential,
        *,
        states: Literal["both", "clean"] = "both",
        reduction: Reduction = None,
    ) -> None:
        super().__init__(inverse_dynamics_network, states=states, reduction=reduction)

    def _check_distribution(self, network: ProbabilisticTensorDictSequential) -> None:
        check_categorical(network, "inverse_dynamics_network")

    def _action_loss(self, output: TensorDictBase, action: Tensor) -> Tensor:
        model = self.inverse_dynamics_network.build_dist_from_params(output)
        batch_size, key = output.batch_size[1:], self.tensor_keys.action
        index = action_index(action, model, batch_size, key)
        index = index.expand(output.batch_size).unsqueeze(-1)
        log_prob: Tensor = model.logits.gather(-1, index).squeeze(-1)
        return -log_prob
