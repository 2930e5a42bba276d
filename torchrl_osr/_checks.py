"""Checks of arguments and of optional packages, with the messages that users see."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


def check_choice(name: str, value: Any, choices: tuple[Any, ...]) -> None:
    """Raise a ValueError that lists the ``choices`` unless ``value`` is among them."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {choices}, got {value!r}.")


def check_weight(name: str, weight: float) -> None:
    """Raise a ValueError unless the weight of a term is finite and at least 0."""
    if not 0 <= weight < math.inf:
        raise ValueError(f"{name} must be finite and at least 0, got {weight}.")


def check_positive(name: str, value: float) -> None:
    """Raise a ValueError unless the value is finite and above 0."""
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be finite and above 0, got {value}.")


def check_at_least(minimum: float, name: str, value: float) -> None:
    """Raise a ValueError unless the value is at least ``minimum``."""
    if not value >= minimum:
        raise ValueError(f"{name} must be at least {minimum}, got {value}.")


@contextmanager
def needed_by(what: str, extra: str) -> Iterator[None]:
    """Add to an ImportError who needs the package, with a verb, and which extra has it.

    ``with needed_by("CSV files need", "train"): import pandas``
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"{what} {error.name!r}: pip install 'torchrl-osr[{extra}]'"
        ) from error
