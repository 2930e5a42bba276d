"""Out-of-sample State Recovery for offline reinforcement learning, on TorchRL.

"Recovering from Out-of-sample States via Inverse Dynamics in Offline Reinforcement
Learning" (Jiang et al., NeurIPS 2023), https://openreview.net/forum?id=4gLWjSaw4o
"""

from torchrl_osr.objectives import (
    CQLLoss,
    DiscreteOSRLoss,
    InverseDynamicsLoss,
    OSRLoss,
    OSRVLoss,
    StateRecoveryLoss,
)
from torchrl_osr.policy import load_policy
from torchrl_osr.transforms import StatePerturbation

__version__ = "0.1.0"

__all__ = [
    "CQLLoss",
    "DiscreteOSRLoss",
    "InverseDynamicsLoss",
    "OSRLoss",
    "OSRVLoss",
    "StatePerturbation",
    "StateRecoveryLoss",
    "__version__",
    "load_policy",
]
