"""Any loss and the recovery term of its actor, as one loss."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from torchrl.objectives import LossModule

from torchrl_osr.objectives.state_recovery import StateRecoveryLoss


class WithRecovery(LossModule):
    """A loss with the state-recovery term added to what it returns.

    What trains, checkpoints, logs or records a loss does so with both. Parameters that
    the two share count once. Reduction, masks and weights are each one's own.

    Args:
        loss: trains an actor, such as :class:`~torchrl_osr.lab.losses.ReBRACLoss` or
        TorchRL's
            ``IQLLoss``.
        recovery: of that very actor.

    Raises:
        ValueError: if ``recovery`` is of another actor.

    Examples:
        >>> from torchrl_osr import StateRecoveryLoss
        >>> from torchrl_osr.lab.losses import ReBRACLoss
        >>> from torchrl_osr.modules import (
        ...     critic_ensemble, deterministic_actor, tanh_gaussian_inverse_dynamics)
        >>> from torchrl_osr.objectives.with_recovery import WithRecovery
        >>> actor = deterministic_actor(11, 3)
        >>> rebrac = ReBRACLoss(actor, critic_ensemble(11, 3))
        >>> recovery = StateRecoveryLoss(actor, tanh_gaussian_inverse_dynamics(11, 3))
        >>> loss = WithRecovery(rebrac, recovery)
        >>> [key for key in loss.out_keys if key.startswith("loss_")]
        ['loss_actor', 'loss_qvalue', 'loss_recovery']
    """

    def __init__(self, loss: LossModule, recovery: StateRecoveryLoss) -> None:
        super().__init__()
        pair = loss.actor_network_params, recovery.actor_network_params
        ours, theirs = (set(map(id, each.parameters())) for each in pair)
        if ours != theirs:
            raise ValueError(
                "the recovery term is of another actor than the loss's: build both "
                "with the same actor_network."
            )
        self.loss, self.recovery = loss, recovery

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that one of the two reads."""
        return list(dict.fromkeys([*self.loss.in_keys, *self.recovery.in_keys]))

    @property
    def out_keys(self) -> list[NestedKey]:
        """The entries that the two write."""
        return [*self.loss.out_keys, *self.recovery.out_keys]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return losses and metrics of both, see ``out_keys``."""
        losses: TensorDictBase = self.loss(tensordict)
        return losses.update(self.recovery(tensordict))
