"""The inverse dynamics model: which action leads from a state to the next one?"""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal

from torchrl_osr._entries import nested
from torchrl_osr.modules.actor import SCALE_MAPPING
from torchrl_osr.modules.initial_weights import remember_weights


def tanh_gaussian_inverse_dynamics(
    observation_dim: int,
    action_dim: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    activation_class: type[nn.Module] = nn.ReLU,
    low: float | Tensor = -1.0,
    high: float | Tensor = 1.0,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> ProbabilisticActor:
    r"""Return a tanh-Gaussian model of :math:`I(a \mid s, s')`, section 4.2.

    It has the policy's distribution family and bounds, so that the divergence between
    the two is exact (:func:`~torchrl_osr.functional.gaussian_kl`).

    Args:
        observation_dim: size of the observation, ``S``.
        action_dim: size of the action, ``A``.
        num_cells: width of each hidden layer.
        activation_class: activation between the layers.
        low, high: action bounds, a number or ``[A]``.
        observation_key: the state it reads, and the next state below ``"next"``.
            Default ``"observation"``.
        action_key: the action it writes. Default ``"action"``.

    Returns:
        A module that reads ``"observation"`` and ``("next", "observation")`` and
        writes ``"loc"``, ``"scale"`` (before the tanh), ``"action"`` and
        ``"action_log_prob"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> model = tanh_gaussian_inverse_dynamics(11, 3, num_cells=[32])
        >>> s = torch.zeros(4, 11)
        >>> batch = TensorDict({"observation": s, "next": {"observation": s + 1}}, [4])
        >>> model.get_dist(batch).loc.shape
        torch.Size([4, 3])
    """
    # MLP joins its two inputs; nn.Sequential, as the actor uses it, takes one only.
    joint_mlp = TensorDictModule(
        MLP(
            in_features=2 * observation_dim,
            out_features=2 * action_dim,
            num_cells=list(num_cells),
            activation_class=activation_class,
        ),
        [observation_key, nested("next", observation_key)],
        ["param"],
    )
    extractor = TensorDictModule(
        NormalParamExtractor(SCALE_MAPPING), ["param"], ["loc", "scale"]
    )
    model = ProbabilisticActor(
        TensorDictSequential(joint_mlp, extractor),
        in_keys=["loc", "scale"],
        out_keys=[action_key],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": high},
        return_log_prob=True,
    )
    return remember_weights(model)
