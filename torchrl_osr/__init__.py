"""Out-of-sample State Recovery for offline reinforcement learning, on TorchRL.

"Recovering from Out-of-sample States via Inverse Dynamics in Offline Reinforcement
Learning" (Jiang et al., NeurIPS 2023), https://openreview.net/forum?id=4gLWjSaw4o
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
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


def __getattr__(name: str) -> object:
    """Import a name at its first use: the command line's help needs no torch."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    homes = {"load_policy": "policy", "StatePerturbation": "transforms"}
    return getattr(import_module(f"{__name__}.{homes.get(name, 'objectives')}"), name)


def __dir__() -> list[str]:
    """List the names that wait for their first use, too."""
    return sorted({*globals(), *__all__})
