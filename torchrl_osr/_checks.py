"""Checks of arguments, with the messages that users see."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints


def check_choice(name: str, value: Any, choices: tuple[Any, ...]) -> None:
    """Raise a ValueError that lists the ``choices`` unless ``value`` is among them."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {choices}, got {value!r}.")


def check_literals(function: Callable[..., Any], values: Mapping[str, Any]) -> None:
    """Raise a ValueError unless arguments are what their ``Literal`` annotations list.

    Args:
        function: whose annotations count. In ``int | Literal["auto"]`` only a string
            is held against the list.
        values: the arguments by name; others are passed over.
    """
    for name, hint in get_type_hints(function).items():
        options = get_args(hint) if get_origin(hint) is not Literal else (hint,)
        literals = [each for each in options if get_origin(each) is Literal]
        if not literals or name not in values:
            continue
        others = [each for each in options if get_origin(each) is not Literal]
        known = tuple(choice for each in literals for choice in get_args(each))
        known = (None, *known) if NoneType in others else known
        value = values[name]
        plain = [each for each in others if isinstance(each, type)]
        # An int is welcome where a float is.
        if isinstance(value, str) or not any(
            isinstance(value, (int, float) if each is float else each) for each in plain
        ):
            check_choice(name, value, known)


def check_weight(name: str, weight: float) -> None:
    """Raise a ValueError unless the weight of a term is finite and at least 0."""
    if not 0 <= weight < math.inf:
        raise ValueError(f"{name} must be at least 0, got {weight}.")


def check_positive(name: str, value: float, *, minimum: float | None = None) -> None:
    """Raise a ValueError unless 0 < ``value`` < inf, or ``value`` >= ``minimum``."""
    if minimum is None and not 0 < value < math.inf:
        raise ValueError(f"{name} must be above 0, got {value}.")
    if minimum is not None and not value >= minimum:
        raise ValueError(f"{name} must be at least {minimum}, got {value}.")
