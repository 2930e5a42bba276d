r"""IQL: TorchRL's, with the settings of its authors.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from torchrl import objectives

from torchrl_osr._checks import check_literals, check_positive, check_weight
from torchrl_osr._entries import column, nested, state_keys
from torchrl_osr.objectives.mixed_states import next_state


class IQLLoss(objectives.IQLLoss):
    r"""Implicit Q-learning (IQL).

    .. math::
        u &= \min_i \bar Q_i(s, a) - V(s) \\
        L_V &= \mathbb E_D |\tau - 1(u < 0)|\, u^2, \quad
        L_Q = \sum_i \mathbb E_D
            (Q_i - r - \gamma\,(1 - \text{terminated}) V(s'))^2 \\
        L_\pi &= -\mathbb E_D \min(e^{\beta u}, 100) \log\pi(a \mid s)

    Presented in "Offline Reinforcement Learning with Implicit Q-Learning",
    https://arxiv.org/abs/2110.06169. This is :class:`torchrl.objectives.IQLLoss` but
    for the defaults, the order of ``in_keys``, and the metric, which is named ``"nll"``
    for what it is; nothing but the priority is written into the batch.

    Args:
        actor_network: the policy, any with a density; the authors' is
            :func:`~torchrl_osr.modules.gaussian_actor`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights (:func:`~torchrl_osr.modules.critic_ensemble`).
        value_network: :math:`V`, see :func:`~torchrl_osr.modules.state_value`.

    Keyword Args:
        temperature: :math:`\beta`, the inverse temperature of the advantages. Default
            3.0, the authors' for the robots; 10.0 for the mazes.
        expectile: :math:`\tau`, between 0 and 1. Default 0.7; 0.9 for the mazes.
        loss_function: distance of the TD error. Default ``"l2"``.
        num_qvalue_nets: number of critics ``N`` where a single one is given; a list
            has its own length. Default 2.
        deactivate_vmap: run the critics one by one. Default ``False``.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if an option is out of its range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr.lab.losses import IQLLoss
        >>> from torchrl_osr.modules import critic_ensemble, gaussian_actor, state_value
        >>> critics = critic_ensemble(11, 3)
        >>> loss = IQLLoss(gaussian_actor(11, 3), critics, state_value(11))
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3),
        ...     "next": {"observation": torch.randn(4, 11), "reward": torch.ones(4, 1),
        ...              "done": no, "terminated": no}}, [4])
        >>> [*loss(batch).keys()]
        ['loss_actor', 'loss_qvalue', 'loss_value', 'nll']
    """

    out_keys = ["loss_actor", "loss_qvalue", "loss_value", "nll"]  # noqa: RUF012

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        value_network: TensorDictModule,
        *,
        temperature: float = 3.0,
        expectile: float = 0.7,
        loss_function: Literal["l2", "l1", "smooth_l1"] = "l2",
        num_qvalue_nets: int = 2,
        deactivate_vmap: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        check_literals(IQLLoss.__init__, locals())
        check_weight("temperature", temperature)
        if not 0 < expectile < 1:
            raise ValueError(f"expectile must be between 0 and 1, got {expectile}.")
        check_positive("num_qvalue_nets", num_qvalue_nets, minimum=1)
        if isinstance(qvalue_network, Sequence):
            num_qvalue_nets = len(qvalue_network)
        super().__init__(
            actor_network,
            qvalue_network,
            value_network,
            temperature=temperature,
            expectile=expectile,
            loss_function=loss_function,
            num_qvalue_nets=num_qvalue_nets,
            deactivate_vmap=deactivate_vmap,
            reduction=reduction,
            scalar_output_mode="exclude" if reduction == "none" else None,
        )

    def _set_in_keys(self) -> None:
        keys, networks = self.tensor_keys, (self.actor_network, self.value_network)
        states = state_keys(key for each in networks for key in each.in_keys)
        found: list[NestedKey] = [*states, *self.qvalue_network.in_keys, keys.action]
        found += [nested("next", key) for key in states]
        found += [
            nested("next", key) for key in (keys.reward, keys.done, keys.terminated)
        ]
        self._in_keys = list(dict.fromkeys(found))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses and the metric of a batch, see ``out_keys``.

        Writes the largest squared TD error of the critics under the ``priority`` key,
        ``[B]``, and nothing else, into ``tensordict``.

        Args:
            tensordict: a batch ``[B]`` with the entries of ``in_keys``.
        """
        if "imagined" in tensordict:
            raise ValueError(
                "the batch has imagined rows, and IQL learns from the data's actions "
                "alone: leave out the roll-outs of a model."
            )
        own, keys = tensordict.copy(), self.tensor_keys
        # TorchRL 0.14.1 multiplies the value there by 0, which leaves a NaN one.
        terminated = column(own, nested("next", keys.terminated)).bool()
        for key in state_keys(self.value_network.in_keys):
            own.set(nested("next", key), next_state(own, key, terminated))
        losses: TensorDictBase = super().forward(own)
        tensordict.set(keys.priority, own.get(keys.priority))
        if "entropy" in losses:
            # TorchRL's name for minus the log-density of the data's action.
            losses.rename_key_("entropy", "nll")
        return losses
