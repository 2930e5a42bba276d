"""What the manifests of all data sets say alike.

Shapes: ``E`` complete episodes.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from numpy.typing import NDArray


def describe_episodes(returns: NDArray[Any], lengths: NDArray[Any]) -> dict[str, Any]:
    """Return how the episodes went that were played to their end.

    Args:
        returns, lengths: of each, ``[E]``.

    Returns:
        ``num_complete_episodes``, ``return`` and ``episode_length`` (mean, std, min and
        max; ``None`` without an episode), ``episode_returns`` and ``episode_lengths``.
    """
    return {
        "num_complete_episodes": len(returns),
        "return": _summary(returns),
        "episode_length": _summary(lengths),
        "episode_returns": returns.tolist(),
        "episode_lengths": lengths.tolist(),
    }


def _summary(values: NDArray[Any]) -> dict[str, float] | None:
    if not len(values):
        return None
    names = ("mean", "std", "min", "max")
    return {name: float(getattr(values, name)()) for name in names}


def sha256_of(path: Path) -> str:
    """Return the checksum of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
