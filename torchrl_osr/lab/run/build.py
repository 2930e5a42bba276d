"""The task, networks and loss of a configuration, to train or to be loaded."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.wrappers import TimeLimit
from hydra.utils import get_class, instantiate
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.objectives import LossModule

from torchrl_osr import OSRVLoss
from torchrl_osr.lab.data import environment_spec, make_environment
from torchrl_osr.lab.data.record import record_episodes
from torchrl_osr.lab.dynamics import TransitionVAE
from torchrl_osr.lab.losses import IQLLoss
from torchrl_osr.lab.run.schema import EnvConfig, TrainConfig
from torchrl_osr.modules import state_value
from torchrl_osr.objectives import ActorCriticLoss, WithRecovery
from torchrl_osr.objectives.networks import is_categorical


class Learner(NamedTuple):
    """A policy's loss and the networks in it."""

    actor: ProbabilisticTensorDictSequential
    model: ProbabilisticTensorDictSequential | None  # inverse dynamics, if used
    loss: LossModule  # holds the tensors of the actor, and of the critics if any
    objective: LossModule  # what is trained: the loss, with a recovery term added to it


def make_learner(config: TrainConfig, device: torch.device | str = "cpu") -> Learner:
    """Build networks and loss, drawn from torch's global generator.

    A loss gets the networks that its constructor names: ``actor_network``,
    ``qvalue_network``, ``value_network``, ``inverse_dynamics_network``,
    ``dynamics_network``, ``transition_network``.

    The configuration is checked and has the sizes of its environment. A ValueError
    names options that do not fit each other or the environment.
    """
    env, network, cells = config.env, config.network, config.network.num_cells
    sizes: Any = env.observation_size, env.action_size
    layers: dict[str, Any] = {"num_cells": cells, "layer_norm": network.layer_norm}
    actor = instantiate(network.actor, *sizes, num_cells=cells).to(device)
    kind, name = ("discrete", "discrete_osr") if env.discrete else ("continuous", "osr")
    if is_categorical(actor) != env.discrete:
        raise ValueError(
            f"{env.id or env.name} has {kind} actions, and {config.loss['_target_']} "
            f"is for others: choose loss={name}, for example."
        )
    number = config.loss.get("num_qvalue_nets", 2)
    critics = instantiate(network.critic, *sizes, num_qvalue_nets=number, **layers)
    model = instantiate(config.inverse_dynamics.network, *sizes, num_cells=cells)
    model.to(device)
    vae_cells = config.dynamics.vae_num_cells
    networks: dict[str, Callable[[], Any]] = {
        "actor_network": lambda: actor,
        "qvalue_network": lambda: critics,
        "inverse_dynamics_network": lambda: model,
        "dynamics_network": lambda: config.dynamics.ensemble(*sizes),
        "transition_network": lambda: TransitionVAE(sizes[0], num_cells=vae_cells),
        "value_network": lambda: state_value(sizes[0], **layers),
    }

    def built(part: dict[str, Any]) -> LossModule:
        wanted = inspect.signature(get_class(part["_target_"])).parameters
        given = {name: make() for name, make in networks.items() if name in wanted}
        return instantiate(part, _partial_=True)(**given).to(device)

    objective = built(config.loss)
    loss = objective.loss if isinstance(objective, WithRecovery) else objective
    if hasattr(loss, "qvalue_network"):
        loss.make_value_estimator(gamma=config.optim.gamma)
    parts = [loss]
    if config.recovery is not None:
        # That of OSR-v is a term of the critics.
        if config.loss.get("recovery_weight") and not isinstance(loss, OSRVLoss):
            raise ValueError(
                f"{config.loss['_target_']} has a recovery term of its own: leave out "
                "recovery=..., or set loss.recovery_weight=0."
            )
        parts.append(built(config.recovery))
        objective = WithRecovery(*parts)
    used = any(hasattr(each, "inverse_dynamics_network") for each in parts)
    learner = Learner(actor, model if used else None, loss, objective)
    _check_combination(config, learner)
    return learner


def _check_combination(config: TrainConfig, learner: Learner) -> None:
    """Raise a ValueError for options that would be ignored, or train nonsense."""
    dynamics, loss, name = config.dynamics, learner.loss, type(learner.loss).__name__
    modules = learner.objective.modules()
    rolled_out = dynamics.use and dynamics.real_ratio < 1
    reads_data = ("next", "action") in learner.objective.in_keys
    critics = isinstance(loss, ActorCriticLoss) and hasattr(loss, "qvalue_network")
    why = ""
    differentiated = any(hasattr(each, "dynamics_network") for each in modules)
    if not dynamics.use and differentiated:
        why = f"{name} needs a model of the dynamics: choose dynamics=ensemble"
    elif rolled_out and (reads_data or isinstance(loss, IQLLoss)):
        why = f"{name} learns from actions of the data alone, which rollouts lack:"
        why += " choose dynamics=none"
    elif dynamics.use and dynamics.adversarial_steps and not (rolled_out and critics):
        why = "dynamics.adversarial_steps needs rollouts and critics: set it to 0"
    elif dynamics.xml and (dynamics.adversarial_steps or differentiated):
        why = f"{name} needs gradients of the model, and a body has none:"
        why += " choose dynamics=ensemble"
    elif config.optim.policy_delay > config.trainer.steps:
        why = "optim.policy_delay is above trainer.steps: the policy would not move"
    if why:
        raise ValueError(f"{why}.")
    if dynamics.use:
        batch_size, gamma = config.trainer.batch_size, config.optim.gamma
        dynamics.check(batch_size=batch_size, gamma=gamma)


def set_sizes_from_environment(env: EnvConfig) -> None:
    """Set sizes and action bounds of a configuration from its environment.

    A ValueError names those that have changed since the training.
    """
    if env.id is None:
        raise ValueError(
            f"{env.name} has no simulator (env=none): nothing can be played there. "
            "torchrl-osr evaluate-offline estimates the policy's value."
        )
    for name, found in environment_spec(env.id)._asdict().items():
        given = getattr(env, name)
        if given is not None and given != found:
            raise ValueError(
                f"the run has env.{name}={given}, but {env.id} has {found}: use the "
                "environment that it was trained for."
            )
        setattr(env, name, found)


def try_out(env_id: str) -> None:
    """Reset an environment and take ten steps: find a broken one before training.

    The actions are the middle ones: others may end in states that no data have.
    """
    with closing(TimeLimit(make_environment(env_id), 10)) as env:
        actions: Any = env.action_space
        taken: list[Any] = []

        def act(_: Any) -> Any:
            taken.append(np.zeros(actions.shape, actions.dtype))
            return taken[-1]

        try:
            record_episodes(env, act, 1, progress=False)
        except Exception as error:
            raise RuntimeError(
                f"{env_id} cannot be played: step {len(taken)} ended with "
                f"{type(error).__name__}: {error}. Without a simulator, use env=none."
            ) from error
