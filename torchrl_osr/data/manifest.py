"""What the manifests of all data sets say alike.

Shapes: ``E`` complete episodes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from torchrl_osr._files import parse_json

SEAL = "seal"
"""Where a record has the SHA-256 of all that is in it besides."""


def describe_episodes(returns: NDArray[Any], lengths: NDArray[Any]) -> dict[str, Any]:
    """Return how the episodes went that were played to their end.

    Args:
        returns, lengths: of each, ``[E]``.

    Returns:
        ``num_complete_episodes``, ``return`` and ``episode_length`` (mean, std, min and
        max; ``None`` without an episode), ``episode_returns`` and ``episode_lengths``.
    """
    return {
        **summarize_episodes(returns, lengths),
        "episode_returns": returns.tolist(),
        "episode_lengths": lengths.tolist(),
    }


def summarize_episodes(returns: NDArray[Any], lengths: NDArray[Any]) -> dict[str, Any]:
    """Return the same without the single episodes, of which there may be millions."""
    return {
        "num_complete_episodes": len(returns),
        "return": _summary(returns),
        "episode_length": _summary(lengths),
    }


def sealed(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a JSON-compatible record with a checksum of itself in it.

    Examples:
        >>> import json
        >>> from torchrl_osr.data.manifest import sealed, unsealed
        >>> text = json.dumps(sealed({"rows": 7}))
        >>> unsealed(text, "card.json")["rows"]
        7
        >>> unsealed(text.replace("7", "8", 1), "card.json")
        Traceback (most recent call last):
            ...
        ValueError: the seal of its card.json is wrong
    """
    return dict(record) | {SEAL: _checksum(record)}


def unsealed(text: str, name: str) -> dict[str, Any]:
    """Read a record that :func:`sealed` has sealed.

    Args:
        text: JSON, as Python writes it: on one line, or with ``indent=1``.
        name: of its file, for the message.

    Raises:
        ValueError: it was changed, or never sealed.
    """
    record = parse_json(text, name)
    check_seal(record, text, name)
    return record


def check_seal(record: Mapping[str, Any], text: str, name: str) -> None:
    """Raise as :func:`unsealed` does, of a record that was read already."""
    flaw = "is wrong" if SEAL in record else "is missing"
    if record.get(SEAL) != _checksum(record):
        raise ValueError(f"the seal of its {name} {flaw}")
    # 1e-05 and 1E-05 are one number, but somebody or something has been at the file.
    if text.strip() not in (json.dumps(record), json.dumps(record, indent=1)):
        raise ValueError(f"its {name} is not as it was written")


def _checksum(record: Mapping[str, Any]) -> str:
    # Sorted: the order of a JSON object's keys says nothing.
    rest = {key: value for key, value in record.items() if key != SEAL}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _summary(values: NDArray[Any]) -> dict[str, float] | None:
    if not len(values):
        return None
    names = ("mean", "std", "min", "max")
    return {name: float(getattr(values, name)()) for name in names}


def sha256_of(path: Path) -> str:
    """Return the checksum of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
