"""OSR in TorchRL's own configuration system (``torchrl.trainers.algorithms.configs``).

:func:`register` adds :data:`OPTIONS` to TorchRL's own options, with the defaults of the
Python signatures. A nested key is a list, as in TorchRL: ``observation_key: [agent,
obs]``. ``docs/torchrl.md`` has a whole configuration.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.utils import get_object
from omegaconf import MISSING
from torchrl.objectives import LossModule

from torchrl_osr import InverseDynamicsLoss, OSRLoss, OSRVLoss, StatePerturbation
from torchrl_osr.modules import (
    critic_ensemble,
    cvae_inverse_dynamics,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.trainers import ReplayBufferCollector

OPTIONS: dict[tuple[str, str], Callable[..., Any]] = {
    ("loss", "osr"): OSRLoss,
    ("loss", "osr_v"): OSRVLoss,
    ("loss", "inverse_dynamics"): InverseDynamicsLoss,
    ("transform", "state_perturbation"): StatePerturbation,
    ("model", "tanh_gaussian_actor"): tanh_gaussian_actor,
    ("model", "critic_ensemble"): critic_ensemble,
    ("model", "tanh_gaussian_inverse_dynamics"): tanh_gaussian_inverse_dynamics,
    ("model", "cvae_inverse_dynamics"): cvae_inverse_dynamics,
    ("collector", "replay_buffer"): ReplayBufferCollector,
}
"""What is registered, by group and name."""

GIVEN_IN_THE_CALL = {
    "actor_network",
    "qvalue_network",
    "inverse_dynamics_network",
    "replay_buffer",
}
"""Arguments that are objects shared by several parts."""


def build(part: str, **options: Any) -> Any:
    """Build a part of :data:`OPTIONS` from the values of a configuration.

    Lists become keys where keys are expected. ``gamma`` goes to a loss's value
    estimator, as in TorchRL's own configurations of losses.
    """
    for name, value in options.items():
        if name == "perturbed" or name.endswith("_key"):
            options[name] = _key(value)
        elif name.endswith("_keys"):
            options[name] = [_key(key) for key in value]
    gamma = options.pop("gamma", None)
    built = get_object(part)(**options)
    if gamma is not None and isinstance(built, LossModule):
        built.make_value_estimator(gamma=gamma)
    return built


def _key(value: Any) -> Any:
    return value if isinstance(value, str) else tuple(value)


def option(part: Callable[..., Any]) -> dict[str, Any]:
    """Return a node of the config store: every argument of a part with its default.

    Objects are ``null`` and handed over in the call of ``instantiate``. Arguments
    without a default must be set.
    """
    parameters = _parameters(part)
    defaults = {name: _default(name, each) for name, each in parameters.items()}
    path = f"{part.__module__}.{part.__qualname__}"
    here = f"{build.__module__}.{build.__qualname__}"
    return {"_target_": here, "_partial_": False, "part": path} | defaults


def _parameters(part: Any) -> dict[str, inspect.Parameter]:
    """Return the parameters of a part, and those that its ``**options`` reach."""
    found = dict(inspect.signature(part).parameters)
    if found.pop("options", None):
        found = _parameters(part.__base__) | found
    return found


def _default(name: str, parameter: inspect.Parameter) -> Any:
    default = parameter.default
    if name in GIVEN_IN_THE_CALL:
        return None
    if default is parameter.empty:
        return MISSING
    if isinstance(default, type):
        path = f"{default.__module__}.{default.__qualname__}"
        return {"_target_": path, "_partial_": True}
    return list(default) if isinstance(default, tuple) else default


def register() -> None:
    """Register TorchRL's options and these with Hydra.

    Call it in a process of its own: Hydra refuses a registered option with the name of
    a file, such as ``loss/osr.yaml`` of ``torchrl-osr train``.
    """
    # TorchRL's own are registered when they are imported.
    from torchrl.trainers.algorithms import configs  # noqa: F401

    for (group, name), part in OPTIONS.items():
        ConfigStore.instance().store(group=group, name=name, node=option(part))
