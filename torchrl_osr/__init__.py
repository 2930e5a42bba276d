"""Out-of-sample State Recovery for offline reinforcement learning, on TorchRL.

"Recovering from Out-of-sample States via Inverse Dynamics in Offline Reinforcement
Learning" (Jiang et al., NeurIPS 2023), https://openreview.net/forum?id=4gLWjSaw4o
"""

from torchrl_osr.objectives import (
    Adversary,
    BCLoss,
    ConditionalVAELoss,
    DiscreteOSRLoss,
    DynamicsLoss,
    EDACLoss,
    InverseDynamicsLoss,
    IQLLoss,
    OSRLoss,
    OSRVLoss,
    ReBRACLoss,
    RORLLoss,
    SCASLoss,
    SDCLoss,
    StateRecoveryLoss,
    TD3BCLoss,
)
from torchrl_osr.policy import Policy, load_policy
from torchrl_osr.transforms import StatePerturbation

__version__ = "0.1.0"

__all__ = [
    "Adversary",
    "BCLoss",
    "ConditionalVAELoss",
    "DiscreteOSRLoss",
    "DynamicsLoss",
    "EDACLoss",
    "IQLLoss",
    "InverseDynamicsLoss",
    "OSRLoss",
    "OSRVLoss",
    "Policy",
    "RORLLoss",
    "ReBRACLoss",
    "SCASLoss",
    "SDCLoss",
    "StatePerturbation",
    "StateRecoveryLoss",
    "TD3BCLoss",
    "__version__",
    "load_policy",
]
