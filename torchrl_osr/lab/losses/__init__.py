"""The losses that OSR is compared with.

All are built and called alike, from networks of :mod:`torchrl_osr.modules`:

    >>> from torchrl_osr.lab.losses import TD3BCLoss
    >>> from torchrl_osr.modules import critic_ensemble, deterministic_actor
    >>> loss = TD3BCLoss(deterministic_actor(11, 3), critic_ensemble(11, 3))
    >>> loss.out_keys
    ['loss_actor', 'loss_qvalue', 'cloning_error', 'pred_value', 'target_value']
"""

from torchrl_osr.lab.losses.cloning import BCLoss, IQLLoss
from torchrl_osr.lab.losses.ensembles import EDACLoss, RORLLoss
from torchrl_osr.lab.losses.evaluation import FQELoss
from torchrl_osr.lab.losses.state_correction import SCASLoss, StateDeviationLoss
from torchrl_osr.lab.losses.td3 import ReBRACLoss, TD3BCLoss

__all__ = [
    "BCLoss",
    "EDACLoss",
    "FQELoss",
    "IQLLoss",
    "RORLLoss",
    "ReBRACLoss",
    "SCASLoss",
    "StateDeviationLoss",
    "TD3BCLoss",
]
