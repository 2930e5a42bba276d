"""Train and evaluate the dynamics models of a run; roll its policy out in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import nn
from torchrl.data import TensorStorage

from torchrl_osr._files import read_tensors, write_json, write_tensors
from torchrl_osr.lab.dynamics.body import Body, fitted_body
from torchrl_osr.lab.dynamics.model_adversary import ModelAdversary
from torchrl_osr.lab.dynamics.models import (
    DynamicsEnsemble,
    DynamicsLoss,
    TransitionVAE,
    TransitionVAELoss,
    gaussian_error,
)
from torchrl_osr.lab.dynamics.options import DynamicsOptions, ModelData
from torchrl_osr.lab.dynamics.rollout_buffer import RolloutReplayBuffer
from torchrl_osr.lab.dynamics.rollouts import known_rule, task_limits
from torchrl_osr.objectives import ActorCriticLoss
from torchrl_osr.trainers import Evaluation, OfflineTrainer
from torchrl_osr.trainers.checkpoints import safe_checkpoint

MODEL, REPORT = "dynamics.safetensors", "dynamics.json"
"""The model and its errors, in the folder of a run."""

Fit = Callable[..., OfflineTrainer]
"""Trains a phase: ``fit(name, loss, parameters, **options of the trainer)``."""


def train_dynamics(
    options: DynamicsOptions,
    data: ModelData,
    loss: nn.Module,
    actor: ProbabilisticTensorDictSequential,
    fit: Fit,
    folder: Path,
    **batches: Any,
) -> RolloutReplayBuffer | None:
    """Train a run's dynamics models, and load them into the parts of its loss.

    Returns:
        The policy's buffer with rollouts, with the options ``batches``; ``None`` if
        ``options.real_ratio`` is 1.
    """
    model = dynamics_model(options, data, fit, folder)
    parts = [each for each in loss.modules() if isinstance(each, ActorCriticLoss)]
    for each in parts:
        if hasattr(each, "dynamics_network"):
            each.from_stateful_net("dynamics_network", model)
        if hasattr(each, "transition_network"):
            vae = _trained_vae(options, data, fit)
            each.from_stateful_net("transition_network", vae)
    if options.real_ratio == 1:
        return None
    adversary = None
    if options.adversarial_steps and options.adversarial_weight:
        adversary = ModelAdversary(options, data, model, parts[0], actor)
    return RolloutReplayBuffer(options, data, model, actor, adversary, **batches)


def dynamics_model(
    options: DynamicsOptions, data: ModelData, fit: Fit, folder: Path
) -> DynamicsEnsemble:
    """Train a run's ensemble or load it; write file and report to the run's folder."""
    file = folder / MODEL
    if not file.exists():
        # The rest of the run draws the same numbers with a model from a file.
        with torch.random.fork_rng(devices=[]):
            write_dynamics(file, _trained(options, data, fit))
    # Always from the file: a continued run must have the same model.
    model = load_dynamics(file)
    model.to(data.held_out.device or "cpu").requires_grad_(False)
    report = dynamics_report(model, data.held_out)
    write_json(folder / REPORT, report)
    print(
        "dynamics, {rows} held-out rows: NLL {nll:.2f}, R2 {r2_mean:.2f}, within one "
        "sigma {within_1_sigma:.0%}, rank correlation of disagreement and error "
        "{disagreement_rank:.2f}".format(**report)
    )
    return model


def _trained(options: DynamicsOptions, data: ModelData, fit: Fit) -> DynamicsEnsemble:
    """Train a model; return the weights of its best evaluation."""
    held_out = data.held_out
    torch.manual_seed(data.seed)
    sizes = (held_out[key].shape[-1] for key in ("observation", "action"))
    model = options.ensemble(*sizes)
    if options.real_ratio != 1 and known_rule(data.env_id) is None:
        model.limits.copy_(task_limits(data.storage[:], data.loc, data.scale))
    if options.xml is not None:
        data = _with_body(model, options, data)
    _standardize(model, data)
    loss = DynamicsLoss(model)

    def evaluate() -> dict[str, Any]:
        model.calibrate_(held_out)
        return dynamics_report(model, held_out)

    trainer = fit(
        "dynamics",
        loss,
        model.parameter_groups(),
        replay_buffer=data.buffer(options.num_networks * options.batch_size),
        total_steps=options.steps,
        evaluation=Evaluation(evaluate, max(1, options.steps // 10), "mse", "min"),
    )
    path = trainer.checkpoints.best_path
    safe_checkpoint(loss_module=loss).load(path, map_location="cpu")
    model.calibrate_(held_out)
    return model


def _trained_vae(options: DynamicsOptions, data: ModelData, fit: Fit) -> TransitionVAE:
    """Train an autoencoder of the states that follow a state in the data."""
    size = data.held_out["observation"].shape[-1]
    model = TransitionVAE(size, num_cells=options.vae_num_cells)
    _standardize(model, data)
    fit(
        "vae",
        TransitionVAELoss(model),
        model.parameters(),
        replay_buffer=data.buffer(options.batch_size),
        total_steps=options.vae_steps,
    )
    return model


def _with_body(
    model: DynamicsEnsemble, options: DynamicsOptions, data: ModelData
) -> ModelData:
    """Give a model its body; return rows with what the body predicts."""
    bounds = {"low": data.action_low, "high": data.action_high}
    body = options.body(loc=data.loc.tolist(), scale=data.scale.tolist(), **bounds)
    rows = data.storage[:].select("observation", "action", "next")
    model.body, rows = fitted_body(body, rows, seed=data.seed)
    device = data.held_out.device or "cpu"
    return replace(data, storage=TensorStorage(rows.to(device), device=device))


def _standardize(model: DynamicsEnsemble | TransitionVAE, data: ModelData) -> None:
    """Move a model to the data, and standardise by 50,000 of their rows."""
    rows, device = data.buffer(), data.held_out.device or "cpu"
    rows.set_rng(torch.Generator(device).manual_seed(data.seed))
    model.to(device).standardize_(rows.sample(50_000))


@torch.no_grad()
def dynamics_report(model: DynamicsEnsemble, data: TensorDictBase) -> dict[str, Any]:
    """Measure an ensemble's errors on rows ``[N]``, and its calibration.

    Returns:
        ``"nll"`` of the elites, in nats, summed over entries. ``"mse"`` of all
        networks, in standardised targets. ``"r2"`` of the elites' mean for each entry,
        the reward last. The share of errors ``"within_1_sigma"``, 0.683 if calibrated.
        Spearman's correlation of disagreement and error, ``"disagreement_rank"``.
    """
    rows = data[model.is_whole(data)]
    _, targets = model.inputs_and_targets(rows)
    mean, scale = model.predict(rows["observation"], rows["action"])
    unit = model.target_scale
    mse = ((mean - targets) / unit).square().mean().item()
    disagreement = model.disagreement(mean)
    mean, scale = mean[model.elites], scale[model.elites]
    deviation = (mean - targets).abs() / scale
    error = mean.mean(0) - targets
    r2 = 1 - error.square().sum(0) / (targets - targets.mean(0)).square().sum(0)
    varied = targets.amax(0) > targets.amin(0)
    twice_nll = gaussian_error(mean, 2 * scale.log(), targets) + math.log(2 * math.pi)
    both = torch.stack([disagreement, (error / unit).norm(dim=-1)])
    ranks = both.argsort().argsort().double()
    return {
        "nll": targets.shape[-1] * twice_nll.mean().item() / 2,
        "mse": mse,
        "r2_mean": r2[varied].mean().item(),
        "r2": r2.tolist(),
        "within_1_sigma": (deviation < 1).float().mean().item(),
        "disagreement_rank": torch.corrcoef(ranks)[0, 1].item(),
        "rows": len(rows),
    }


def write_dynamics(path: Path, model: DynamicsEnsemble) -> None:
    """Write a model to one file of tensors."""
    names = "observation_dim", "action_dim", "num_networks", "num_elites", "num_cells"
    sizes = {name: getattr(model, name) for name in names}
    body = None if model.body is None else asdict(model.body)
    write_tensors(path, model.state_dict(), {"sizes": sizes, "body": body})


def load_dynamics(path: Path) -> DynamicsEnsemble:
    """Load ``dynamics.safetensors`` of a run; torch's global generator stays."""
    tensors, record = read_tensors(path)
    with torch.random.fork_rng(devices=[]):
        model = DynamicsEnsemble(**record["sizes"])
    model.load_state_dict(tensors)
    model.body = record["body"] and Body(**record["body"])
    return model
