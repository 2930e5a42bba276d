"""The laboratory: what experiments with the plug-in need."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_osr.lab.run.fit import fit

__all__ = ["fit"]


def __getattr__(name: str) -> Any:
    if name == "fit":  # on first use: it needs Hydra
        from torchrl_osr.lab.run.fit import fit

        return fit
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
