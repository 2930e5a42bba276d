"""Train the dynamics models of a run, and roll its policy out in them.

A trained ensemble is kept in the cache folder: runs with the same data, settings and
seed train it once. Every run has a copy in its folder.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import nn

from torchrl_osr import __version__
from torchrl_osr._files import read_tensors, write_json, write_tensors
from torchrl_osr.lab.data.store import cache_root
from torchrl_osr.lab.dynamics.conditional_vae import ConditionalVAE, ConditionalVAELoss
from torchrl_osr.lab.dynamics.data import ModelData
from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble, DynamicsLoss
from torchrl_osr.lab.dynamics.fit import describe_dynamics, dynamics_report
from torchrl_osr.lab.dynamics.model_adversary import ModelAdversary
from torchrl_osr.lab.dynamics.options import DynamicsOptions
from torchrl_osr.lab.dynamics.rollout_buffer import RolloutReplayBuffer
from torchrl_osr.objectives import ActorCriticLoss
from torchrl_osr.trainers import Evaluation, OfflineTrainer
from torchrl_osr.trainers.checkpoints import safe_checkpoint

log = logging.getLogger(__name__)

FILE, REPORT = "dynamics.safetensors", "dynamics.json"
"""The model and its errors, in the folder of a run."""

ROWS_FOR_STATISTICS = 50_000  # a model's inputs and targets are standardised by them

FITTED = ("num_networks", "num_elites", "num_cells", "lr", "batch_size", "steps")
"""Options that decide what a trained model is."""


@dataclass(frozen=True)
class Phase:
    """Settings that all training phases of a run share."""

    folder: Path  # of the run
    new_trainer: Callable[..., OfflineTrainer]
    adam: Callable[..., torch.optim.Optimizer]  # of parameters
    seed: int
    name: str  # of the data, for a model's file in the cache
    arithmetic: Mapping[str, Any]  # other settings that decide what a trained model is


def train_dynamics(
    options: DynamicsOptions,
    data: ModelData,
    loss: nn.Module,
    actor: ProbabilisticTensorDictSequential,
    phase: Phase,
    *,
    gamma: float,
    **batches: Any,
) -> tuple[RolloutReplayBuffer | None, ModelAdversary | None]:
    """Train a run's dynamics models, and load them into the parts of its loss.

    ``batches`` are other options of :class:`RolloutReplayBuffer`.

    Returns:
        The policy's buffer with roll-outs, and the adversary that trains the model
        between them; ``None`` for what the options do not ask for.
    """
    reverse = options.reverse_policy is not None
    model = dynamics_model(options, data.reverse() if reverse else data, phase)
    sizes = model.observation_dim, model.action_dim
    parts = [each for each in loss.modules() if isinstance(each, ActorCriticLoss)]
    for each in parts:
        if hasattr(each, "dynamics_network"):
            each.load_frozen("dynamics_network", model)
        if hasattr(each, "transition_network"):
            vae = train_vae(options.transition_vae(sizes[0]), options, data, phase)
            each.load_frozen("transition_network", vae)
    if options.real_ratio == 1:
        return None, None
    policy: nn.Module = actor
    if options.reverse_policy == "cvae":
        policy = train_vae(options.reverse_vae(*sizes), options, data, phase)
    adversary = None
    if options.adversarial_steps and options.adversarial_weight:
        adam = phase.adam(model.parameter_groups(), lr=options.adversarial_lr)
        adversary = ModelAdversary(
            options, data, model, parts[0], actor, adam, gamma, phase.seed
        )
    batches |= {"gamma": gamma, "seed": phase.seed}
    return (
        RolloutReplayBuffer(options, data, model, policy, adversary, **batches),
        adversary,
    )


def dynamics_model(
    options: DynamicsOptions, data: ModelData, phase: Phase
) -> DynamicsEnsemble:
    """Train a run's ensemble or load it; write file and report to the run's folder."""
    facts, here = data.facts(), phase.folder / FILE
    if not here.exists() and options.path is not None:
        write_dynamics(here, load_dynamics(options.path, facts), facts)
    elif not here.exists():
        stamp = {"version": __version__, "seed": phase.seed} | dict(phase.arithmetic)
        stamp |= {key: getattr(options, key) for key in FITTED}
        text = json.dumps({"data": facts, "settings": stamp}, sort_keys=True).encode()
        name = f"{phase.name}-{hashlib.sha256(text).hexdigest()[:16]}"
        cached = cache_root() / "dynamics" / f"{name}.safetensors"
        cached.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{cached}.lock"):  # runs that need the same model wait for it
            try:
                model = load_dynamics(cached, facts)
                log.info(f"dynamics: the model is {cached}")
            except (OSError, ValueError) as error:
                if cached.exists():
                    log.warning(f"Training {cached} anew: {error}")
                # The rest of the run draws the same numbers with a model from a file.
                with torch.random.fork_rng(devices=[]):
                    model = _trained(options, data, phase)
                write_dynamics(cached, model, facts)
        write_dynamics(here, model, facts)
    # From the file in any case, so that a continued run has the very same model.
    model = load_dynamics(here, facts)
    model.to(data.held_out.device or "cpu").requires_grad_(False)
    report = dynamics_report(model, data.held_out, data.pieces)
    write_json(phase.folder / REPORT, report)
    print(describe_dynamics(report))
    return model


def _trained(
    options: DynamicsOptions, data: ModelData, phase: Phase
) -> DynamicsEnsemble:
    """Train a model; return the weights of its best evaluation."""
    held_out = data.held_out
    torch.manual_seed(phase.seed)
    sizes = (held_out[key].shape[-1] for key in ("observation", "action"))
    model = options.ensemble(*sizes)
    _standardize(model, data, phase)
    loss = DynamicsLoss(model)

    def evaluate() -> dict[str, Any]:
        model.calibrate_(held_out)
        return dynamics_report(model, held_out)

    trainer = phase.new_trainer(
        loss,
        phase.adam(model.parameter_groups(), lr=options.lr),
        replay_buffer=data.buffer(options.num_networks * options.batch_size),
        total_steps=options.steps,
        folder=phase.folder / "checkpoint" / "dynamics",
        seed=phase.seed,
        evaluation=Evaluation(evaluate, max(1, options.steps // 10), "mse", "min"),
        description="dynamics",
    )
    trainer.train()
    path = trainer.checkpoints.best_path
    safe_checkpoint(loss_module=loss).load(path, map_location="cpu")
    model.calibrate_(held_out)
    return model


def train_vae(
    model: ConditionalVAE, options: DynamicsOptions, data: ModelData, phase: Phase
) -> ConditionalVAE:
    """Train a conditional autoencoder for ``vae_steps``; return it frozen."""
    model.to(data.held_out.device or "cpu")
    if model.change:
        _standardize(model, data, phase)
    loss = ConditionalVAELoss(model)

    @torch.no_grad()
    def evaluate() -> dict[str, float]:
        return {"vae_error": loss(data.held_out)["loss_vae"].item()}

    phase.new_trainer(
        loss,
        phase.adam(model.parameters(), lr=options.lr),
        replay_buffer=data.buffer(options.batch_size),
        total_steps=options.vae_steps,
        folder=phase.folder / "checkpoint" / "vae",
        seed=phase.seed,
        evaluation=Evaluation(evaluate, options.vae_steps, "vae_error", "min"),
        description="vae",
    ).train()
    return model.requires_grad_(False)


def _standardize(
    model: DynamicsEnsemble | ConditionalVAE, data: ModelData, phase: Phase
) -> None:
    """Move a model to the data, and take their statistics."""
    rows, device = data.buffer(), data.held_out.device or "cpu"
    rows.set_rng(torch.Generator(device).manual_seed(phase.seed))
    model.to(device).standardize_(rows.sample(ROWS_FOR_STATISTICS))


def write_dynamics(
    path: Path, model: DynamicsEnsemble, facts: Mapping[str, Any]
) -> None:
    """Write a model and the facts on its data to one file of tensors."""
    names = "observation_dim", "action_dim", "num_networks", "num_elites", "num_cells"
    sizes = {name: getattr(model, name) for name in names}
    write_tensors(path, model.state_dict(), {"sizes": sizes, "data": dict(facts)})


def load_dynamics(
    path: Path | str, facts: Mapping[str, Any] | None = None
) -> DynamicsEnsemble:
    """Load ``dynamics.safetensors`` of a run; raise unless these facts agree.

    Torch's global generator stays.
    """
    try:
        tensors, record = read_tensors(Path(path))
        with torch.random.fork_rng(devices=[]):
            model = DynamicsEnsemble(**record["sizes"])
        model.load_state_dict(tensors)
        there = record["data"]
    except (KeyError, TypeError, RuntimeError, ValueError) as error:
        what = f"{path} holds no dynamics model: {error}"
        raise ValueError(f"{what}. Take {FILE} from the folder of a run.") from error
    wanted = json.loads(json.dumps(facts or {}))
    others = [name for name, value in wanted.items() if there.get(name) != value]
    if others:
        raise ValueError(
            f"{path} was trained on other data; these differ: {', '.join(others)}. "
            "Take a model of the same data, or leave dynamics.path out to train one."
        )
    return model
