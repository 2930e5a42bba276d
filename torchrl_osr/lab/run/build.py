"""Data, networks and loss as a configuration has them, to train or to be loaded."""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple

import torch
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict import NestedKey, TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.modules import TanhNormal
from torchrl.objectives import LossModule

from torchrl_osr._checks import check_choice
from torchrl_osr.lab.data import ReferenceReturns, reference_returns
from torchrl_osr.lab.dynamics import DynamicsOptions
from torchrl_osr.lab.losses import IQLLoss
from torchrl_osr.lab.run.limits import check_networks
from torchrl_osr.modules import state_value
from torchrl_osr.objectives import ActorCriticLoss, WithRecovery
from torchrl_osr.objectives.networks import head_of, is_categorical


def read_environment(cfg: DictConfig) -> None:
    """Compare a run with its environment, and keep the action bounds with the run.

    Args:
        cfg: a whole configuration; ``env.action_low`` and ``env.action_high`` are set.

    Raises:
        ValueError: there is no such environment, or it cannot be acted in, see
            :func:`~torchrl_osr.lab.data.make_environment`; the policy's actions are of
            another kind; the bounds are set to other numbers already; or
            :func:`references_of` refuses the references.
        ImportError: a package that the environment needs is not installed.
    """
    from torchrl_osr.lab.data import environment_spec  # needs Gymnasium

    references_of(cfg)
    spec = environment_spec(cfg.env.id)
    actor = instantiate(cfg.network.actor, 1, 1, num_cells=[1])
    if is_categorical(actor) != spec.discrete:
        kind = "discrete" if spec.discrete else "real"
        other = "loss=discrete_osr" if spec.discrete else "loss=osr"
        raise ValueError(
            f"{cfg.env.id} has {kind} actions, and the policy of "
            f"{cfg.loss._target_} has not: take {other}."
        )
    for name in ("action_low", "action_high"):
        given, read = cfg.env[name], getattr(spec, name)
        if given is not None and given != read:
            raise ValueError(
                f"env.{name}={given}, but it is read from {cfg.env.id}, where it is "
                f"{read}: leave it out."
            )
        cfg.env[name] = read


def references_of(cfg: DictConfig) -> ReferenceReturns | None:
    """What a run's returns are normalised by, ``None`` if they stay as they are."""
    given = cfg.env.get("random_return"), cfg.env.get("expert_return")
    return reference_returns(cfg.env.name, *given)


def load_data(
    cfg: DictConfig, *, progress: bool = True
) -> tuple[TensorDict, dict[str, Any]]:
    """Data set and manifest of a run, see :func:`~torchrl_osr.lab.data.load_dataset`.

    Rewards are the task's own: :mod:`~torchrl_osr.lab.run.training_data` scales
    them.
    """
    from torchrl_osr.lab.data import load_dataset  # needs Gymnasium; networks do not

    options: Any = OmegaConf.to_container(cfg.data)
    return load_dataset(
        cfg.env.name,
        cfg.data.source,
        env_id=cfg.env.id,
        references=references_of(cfg),
        path=options["path"],
        columns=options["columns"],
        action_bounds=options["action_bounds"],
        clip_actions=cfg.data.clip_actions,
        missing=cfg.data.missing,
        download=cfg.data.download,
        random_share=cfg.data.random_share,
        num_transitions=cfg.data.num_transitions,
        seed=cfg.data.seed,
        progress=progress,
        on_disk=check_storage(cfg) == "disk",
    )


def check_storage(cfg: DictConfig) -> str:
    """Where the data are: ``"memory"`` or ``"disk"``.

    Raises:
        ValueError: it is no such place, or cannot be combined with the other options.
    """
    storage = str(cfg.data.storage)
    check_choice("data.storage", storage, ("memory", "disk"))
    return storage


def dynamics_options(cfg: DictConfig) -> DynamicsOptions:
    """Return ``dynamics`` of a configuration."""
    options: Any = OmegaConf.to_container(cfg.dynamics, resolve=True)
    return DynamicsOptions(**options)


class Learner(NamedTuple):
    """A policy's loss and the networks in it.

    Attributes:
        actor: the policy.
        model: the inverse dynamics model, ``None`` if nothing uses it.
        loss: holds the actor's tensors, and the critics if it has any.
        objective: what is trained: the loss, with the recovery term that is added to
            it. Holds the model's tensors too, frozen: what it learns, this knows.
    """

    actor: ProbabilisticTensorDictSequential
    model: ProbabilisticTensorDictSequential | None
    loss: LossModule
    objective: LossModule


def make_learner(
    cfg: DictConfig,
    observation_size: int,
    action_size: int,
    device: torch.device | str = "cpu",
) -> Learner:
    """Networks and loss, drawn anew from torch's global generator.

    A loss is given those networks that its constructor names: ``actor_network``,
    ``qvalue_network``, ``value_network``, ``inverse_dynamics_network``,
    ``dynamics_network``, ``transition_network``.

    Raises:
        ValueError: if an option of a loss is out of its range, the loss has a recovery
            term already, or the networks do not fit into the memory.
    """
    _check_recovery(cfg)
    check_networks(cfg, observation_size, action_size, device)
    sizes, cells = (observation_size, action_size), list(cfg.network.num_cells)
    actor = instantiate(cfg.network.actor, *sizes, num_cells=cells).to(device)
    critics = instantiate(
        cfg.network.critic,
        *sizes,
        num_qvalue_nets=cfg.loss.get("num_qvalue_nets", 2),
        num_cells=cells,
        layer_norm=cfg.network.layer_norm,
    )
    model = instantiate(cfg.inverse_dynamics.network, *sizes, num_cells=cells)
    networks = {
        "actor_network": actor,
        "qvalue_network": critics,
        "inverse_dynamics_network": model.to(device),
    }

    def built(part: DictConfig) -> LossModule:
        wanted = inspect.signature(get_class(part._target_)).parameters
        if "dynamics_network" in wanted:
            ensemble = dynamics_options(cfg).ensemble(*sizes)
            networks["dynamics_network"] = ensemble.to(device)
        if "transition_network" in wanted:
            vae = dynamics_options(cfg).transition_vae(observation_size)
            networks["transition_network"] = vae.to(device)
        if "value_network" in wanted:
            networks["value_network"] = state_value(
                observation_size, num_cells=cells, layer_norm=cfg.network.layer_norm
            ).to(device)
        given = {name: each for name, each in networks.items() if name in wanted}
        loss: LossModule = instantiate(part, _partial_=True)(**given).to(device)
        return loss

    objective = built(cfg.loss)
    loss = objective.loss if isinstance(objective, WithRecovery) else objective
    if hasattr(loss, "qvalue_network"):
        loss.make_value_estimator(gamma=cfg.optim.gamma)
    parts = [loss]
    if cfg.recovery is not None:
        if is_categorical(actor):
            raise ValueError(
                f"recovery=... is for real actions, and those of {cfg.loss._target_} "
                "are discrete: take loss=discrete_osr, which has a term of its own."
            )
        parts.append(built(cfg.recovery))
        objective = WithRecovery(*parts)
    used = any(hasattr(each, "inverse_dynamics_network") for each in parts)
    return Learner(actor, model if used else None, loss, objective)


def _check_adversary(objective: str, learner: Learner) -> None:
    """Raise a ValueError unless an adversary can ask a loss's networks."""
    loss, head = learner.loss, head_of(learner.actor)[0]
    if not (isinstance(loss, ActorCriticLoss) and hasattr(loss, "qvalue_network")):
        raise ValueError(
            f"perturbation=adversarial asks a loss with critics and perturbed states, "
            f"and {type(loss).__name__} has none: take perturbation=gaussian."
        )
    if objective == "action_diff" and head is not TanhNormal:
        raise ValueError(
            "perturbation.adversary.objective=action_diff compares tanh-Gaussian "
            f"policies, and that of {type(loss).__name__} is none: take min_Q, or "
            "perturbation=gaussian."
        )


def _check_recovery(cfg: DictConfig) -> None:
    """Raise a ValueError if a recovery term is added to a loss that has its own."""
    own = cfg.loss.get("recovery_weight")
    if cfg.recovery is not None and own:
        raise ValueError(
            f"{cfg.loss._target_} has a recovery term of its own "
            f"(loss.recovery_weight={own}), to which recovery=... would add another: "
            "leave out recovery=..., or set loss.recovery_weight=0."
        )


def _check_model_adversary(cfg: DictConfig, loss: LossModule) -> None:
    """Raise a ValueError unless a model can be trained against a loss's policy."""
    steps = f"dynamics.adversarial_steps={cfg.dynamics.adversarial_steps}"
    if cfg.dynamics.reverse_policy or cfg.dynamics.real_ratio == 1:
        raise ValueError(
            f"{steps} trains the model that the policy is rolled out in, and here none "
            "is: set it to 0, or take dynamics=ensemble and dynamics.real_ratio below "
            "1."
        )
    if not (isinstance(loss, ActorCriticLoss) and hasattr(loss, "qvalue_network")):
        raise ValueError(
            f"{steps} asks for the values of critics, and {type(loss).__name__} has "
            "none: set it to 0."
        )


def check_parts(
    cfg: DictConfig, observation_size: int, action_size: int
) -> list[NestedKey]:
    """Build once what a run will need, so that a wrong option stops before its data.

    Returns:
        The entries that the policy's loss reads.

    Raises:
        ValueError: if an option is out of its range, or networks and batches do not fit
            into the memory.
    """
    sizes = observation_size, action_size
    check_networks(cfg, *sizes, cfg.trainer.device, training=True)
    learner = make_learner(cfg, *sizes)
    if cfg.data.held_out in (0, 1):
        raise ValueError(
            f"data.held_out={cfg.data.held_out} must be above 0 and below 1: models "
            "are judged on the held-out rows, and trained on the others."
        )
    if cfg.optim.policy_delay > 1 and not hasattr(learner.loss, "qvalue_network"):
        raise ValueError(
            f"optim.policy_delay={cfg.optim.policy_delay} updates critics in between, "
            f"and {type(learner.loss).__name__} has none: take optim.policy_delay=1."
        )
    if learner.model is not None:
        instantiate(cfg.inverse_dynamics.loss, _partial_=True)(learner.model)
    if cfg.perturbation.adversary is not None:
        adversary = instantiate(cfg.perturbation.adversary)
        _check_adversary(adversary.objective, learner)
    in_keys: list[NestedKey] = learner.objective.in_keys
    if hasattr(learner.loss, "dynamics_network") and not cfg.dynamics.use:
        raise ValueError(
            f"{cfg.loss._target_} needs a model of the dynamics: take "
            "dynamics=ensemble."
        )
    if hasattr(learner.loss, "dynamics_network") and cfg.dynamics.reverse_policy:
        raise ValueError(
            f"{cfg.loss._target_} asks where actions lead, and a model with "
            f"dynamics.reverse_policy={cfg.dynamics.reverse_policy} knows where states "
            "came from: take dynamics=ensemble."
        )
    if cfg.dynamics.use and cfg.dynamics.adversarial_steps:
        _check_model_adversary(cfg, learner.loss)
    if cfg.dynamics.use:
        dynamics_options(cfg).check(
            cfg.env.id, batch_size=cfg.trainer.batch_size, gamma=cfg.optim.gamma
        )
    if cfg.dynamics.use and cfg.dynamics.real_ratio < 1:
        if isinstance(learner.loss, IQLLoss):
            raise ValueError(
                f"{cfg.loss._target_} learns from the data's actions alone, and "
                "imagined rows have the policy's: take dynamics=none, or another loss."
            )
        if ("next", "action") in in_keys:
            raise ValueError(
                f"{cfg.loss._target_} reads the data's next action, which no imagined "
                "row has: choose another loss, or dynamics=none."
            )
    return in_keys
