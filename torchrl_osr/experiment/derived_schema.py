"""Hydra schemas that are derived from a class's own signature and defaults.

An option of a loss is declared once, in the loss; its configuration knows the same
names, types and defaults without repeating them.
"""

from __future__ import annotations

import functools
import inspect
import operator
from collections.abc import Callable, Iterator
from dataclasses import make_dataclass
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints


def schema_of(target: Callable[..., Any]) -> type:
    """A structured config with the keyword options of ``target``.

    Args:
        target: a class whose keyword-only parameters, and those of the bases that its
            ``**options`` reach, are the fields; or a dataclass.

    Returns:
        A dataclass whose ``_target_`` is the public name of ``target``.

    Examples:
        >>> from torchrl_osr import OSRLoss
        >>> schema = schema_of(OSRLoss)
        >>> schema().recovery_weight, schema()._target_
        (0.5, 'torchrl_osr.OSRLoss')
    """
    name = f"torchrl_osr.{target.__name__}"
    options: dict[str, tuple[str, Any, Any]] = {"_target_": ("_target_", str, name)}
    for parameter, annotation in keyword_options(target):
        field = parameter.name, config_type(annotation), parameter.default
        options.setdefault(parameter.name, field)
    return make_dataclass(f"{target.__name__}Config", options.values())


def keyword_options(
    target: Callable[..., Any],
) -> Iterator[tuple[inspect.Parameter, Any]]:
    """Parameters with a default that a configuration can set, and their types."""
    classes = target.__mro__ if inspect.isclass(target) else ()
    for each in classes:
        initialize = vars(each).get("__init__")
        if initialize is None:
            continue
        hints = get_type_hints(initialize, vars(inspect.getmodule(each)))
        parameters = inspect.signature(initialize).parameters.values()
        is_dataclass = "__dataclass_fields__" in vars(each)
        for parameter in parameters:
            if parameter.kind is parameter.KEYWORD_ONLY or (
                is_dataclass and parameter.default is not parameter.empty
            ):
                yield parameter, hints[parameter.name]
        if not any(each.kind is each.VAR_KEYWORD for each in parameters):
            return


def config_type(annotation: Any) -> Any:
    """The annotation as OmegaConf knows it: a ``Literal`` is the literals' type."""
    if get_origin(annotation) is Literal:
        (kind,) = {type(value) for value in get_args(annotation)}
        return kind
    parts = get_args(annotation)
    if not parts:
        return annotation
    kinds = dict.fromkeys(config_type(part) for part in parts if part is not NoneType)
    if float in kinds and len(kinds) > 1:
        kinds[int] = None  # in a union OmegaConf does not make a float of an int
    if NoneType in parts:
        kinds[None] = None
    return functools.reduce(operator.or_, kinds)
