"""The dynamics model of a run, trained or from a file, and what is imagined with it.

A trained model is kept in the cache folder, where the data are, too: runs with the same
data, settings and seed train it once. Every run has a copy in its folder.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import torch
from filelock import FileLock
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    set_interaction_type,
)
from torch import Tensor, nn

from torchrl_osr import __version__
from torchrl_osr._files import write_json
from torchrl_osr.lab.data.store.cache import cache_root
from torchrl_osr.lab.data.store.multi_step import take_multi_step
from torchrl_osr.lab.data.store.validation import DATASET_KEYS
from torchrl_osr.lab.dynamics import (
    ConditionalVAE,
    DynamicsEnsemble,
    DynamicsLoss,
    Imagined,
    ImaginedReplayBuffer,
    ModelAdversary,
    Termination,
    any_action,
    disturbed,
    imagine,
    imagine_backwards,
)
from torchrl_osr.lab.evaluation import describe_dynamics, dynamics_report
from torchrl_osr.lab.run.build import make_dynamics, termination_of
from torchrl_osr.lab.run.training_data import ROWS_FOR_STATISTICS, TrainingData
from torchrl_osr.objectives import BaseLoss
from torchrl_osr.policy.tensor_file import read_tensors, write_tensors
from torchrl_osr.trainers import OfflineTrainer
from torchrl_osr.trainers.checkpoints import safe_checkpoint

log = logging.getLogger(__name__)

FILE, REPORT = "dynamics.safetensors", "dynamics.json"
"""The model and what is known of its errors, in the folder of a run."""

KIND = "dynamics model"

FITTED = ("num_networks", "num_elites", "num_cells", "lr", "batch_size", "steps")
"""Settings of ``dynamics`` that decide what a trained model is."""


def dynamics_model(
    cfg: DictConfig,
    data: TrainingData,
    folder: Path,
    new_trainer: Callable[..., OfflineTrainer],
    adam: Callable[..., torch.optim.Optimizer],
) -> DynamicsEnsemble:
    """The frozen model of a run, with a report in its folder.

    Args:
        cfg: a whole configuration of ``torchrl-osr train``.
        data: what the run trains on.
        folder: of the run.
        new_trainer: makes the trainer of a phase.
        adam: makes an optimizer from parameters.

    Raises:
        ValueError: ``dynamics.path`` names another file, or a model of other data.
    """
    fits, settings = facts_of(cfg, data), settings_of(cfg)
    here, given = folder / FILE, cfg.dynamics.path
    if not here.exists() and given is not None:
        write_dynamics(here, load_dynamics(given, fits), fits)
    elif not here.exists():
        everything = {"data": fits, "settings": settings}
        text = json.dumps(everything, sort_keys=True).encode()
        name = f"{cfg.env.name}-{cfg.data.source}-{hashlib.sha256(text).hexdigest()}"
        cached = cache_root() / "dynamics" / f"{name[:-48]}.safetensors"
        cached.parent.mkdir(parents=True, exist_ok=True)
        # Other runs that need the same model wait for it.
        with FileLock(f"{cached}.lock"):
            try:
                model = load_dynamics(cached, fits)
                log.info(f"dynamics: the model is {cached}")
            except (OSError, ValueError) as flaw:
                if cached.exists():
                    log.warning(f"Training {cached} anew: {flaw}")
                # The rest of the run draws the same numbers with a model from a file.
                with torch.random.fork_rng(devices=[]):
                    model = _trained(cfg, data, folder, new_trainer, adam)
                write_dynamics(cached, model, fits)
        write_dynamics(here, model, fits)
    # From the file in any case, so that a continued run has the very same model.
    model = load_dynamics(here, fits)
    model.to(data.held_out.device or "cpu").requires_grad_(False)
    report = dynamics_report(model, data.held_out, data.pieces)
    write_json(folder / REPORT, report)
    print(describe_dynamics(report))
    return model


def facts_of(cfg: DictConfig, data: TrainingData) -> dict[str, Any]:
    """What a model shares with the data that it was trained on, JSON-compatible."""
    digest = hashlib.sha256()
    held_out = data.held_out.cpu()
    for key in DATASET_KEYS:
        digest.update(held_out[key].contiguous().view(torch.uint8).numpy().tobytes())
    return {
        "environment": cfg.env.id,
        "rows": len(data.buffer),
        "observation mean": data.norm.loc.tolist(),
        "observation scale": data.norm.scale.tolist(),
        "reward scale": cfg.data.reward_scale,
        "reward shift": cfg.data.reward_shift,
        "held-out rows": digest.hexdigest(),
        "direction of time": "backward" if data.backwards else "forward",
    }


def settings_of(cfg: DictConfig) -> dict[str, Any]:
    """What decides a model beside the data, JSON-compatible."""
    options: Any = OmegaConf.to_container(cfg.dynamics)
    chosen = {name: options[name] for name in FITTED}
    arithmetic = "device", "precision", "matmul_precision", "compile"
    where = {name: cfg.trainer[name] for name in arithmetic}
    return {"version": __version__, "seed": cfg.seed} | chosen | where


def _trained(
    cfg: DictConfig,
    data: TrainingData,
    folder: Path,
    new_trainer: Callable[..., OfflineTrainer],
    adam: Callable[..., torch.optim.Optimizer],
) -> DynamicsEnsemble:
    """Train a model; the weights of its best evaluation are taken."""
    options, held_out = cfg.dynamics, data.held_out
    sizes = held_out["observation"].shape[-1], held_out["action"].shape[-1]
    torch.manual_seed(cfg.seed)
    model = make_dynamics(cfg, *sizes)
    model.to(held_out.device or "cpu")
    rows = data.alone()
    rows.set_rng(torch.Generator(held_out.device or "cpu").manual_seed(cfg.seed))
    model.standardize_(rows.sample(ROWS_FOR_STATISTICS))
    loss = DynamicsLoss(model)

    def evaluate() -> dict[str, Any]:
        model.calibrate_(held_out)
        return dynamics_report(model, held_out)

    trainer = new_trainer(
        loss,
        adam(model.parameter_groups(), lr=options.lr),
        replay_buffer=data.alone(options.num_networks * options.batch_size),
        total_steps=options.steps,
        folder=folder / "checkpoint" / "dynamics",
        seed=cfg.seed,
        evaluate=evaluate,
        metric=("mse", "min"),
        eval_interval=max(1, options.steps // 10),
        description="dynamics",
    )
    trainer.train()
    best = safe_checkpoint(loss_module=loss)
    best.load(trainer.checkpoints.best_path, map_location="cpu")
    model.calibrate_(held_out)
    return model


# -- files ---------------------------------------------------------------------------


def write_dynamics(
    path: Path, model: DynamicsEnsemble, facts: Mapping[str, Any]
) -> None:
    """Write a model and :func:`facts_of` its data to one file of tensors."""
    write_tensors(path, model.state_dict(), {"kind": KIND, "data": dict(facts)})


def load_dynamics(
    path: Path | str, facts: Mapping[str, Any] | None = None
) -> DynamicsEnsemble:
    """Load a model that a run has trained; nothing is unpickled.

    torch's global generator is left as it was.

    Args:
        path: of the file, ``dynamics.safetensors`` in the folder of a run.
        facts: :func:`facts_of` the data that it has to fit. Default: any.

    Raises:
        OSError: it cannot be read.
        ValueError: it holds something else, or was trained on other data; what differs
            is named.
    """
    path = Path(path)
    try:
        tensors, record = read_tensors(path)
        if record.get("kind") != KIND:
            raise ValueError("it holds no dynamics model")
        with torch.random.fork_rng(devices=[]):
            model = _model_of(tensors)
    except (KeyError, IndexError, RuntimeError, ValueError) as error:
        raise ValueError(
            f"{path}: {error}. Take {FILE} from the folder of a run."
        ) from error
    there = record.get("data") or {}
    others = [
        f"{name}: {_short(there.get(name))} there, {_short(wanted)} here"
        for name, wanted in json.loads(json.dumps(facts or {})).items()
        if there.get(name) != wanted
    ]
    if others:
        raise ValueError(
            f"{path} was trained on other data than this run's ({'; '.join(others)}): "
            "take a model of the same data, or leave dynamics.path out to train one."
        )
    return model


def _model_of(tensors: Mapping[str, Tensor]) -> DynamicsEnsemble:
    """A model of the sizes that its tensors have."""
    observation_dim = len(tensors["target_loc"]) - 1
    weights = [
        each
        for name, each in sorted(tensors.items(), key=lambda item: _layer(item[0]))
        if name.endswith(".weight")
    ]
    networks, inputs = len(weights[0]), len(tensors["input_loc"])
    widths = [inputs, *(each.shape[-1] for each in weights)]
    # Before it is built: a small file shall not ask for a large model.
    if [tuple(each.shape) for each in weights] != [
        (networks, *sizes) for sizes in pairwise(widths)
    ]:
        raise ValueError("its layers do not fit together")
    model = DynamicsEnsemble(
        observation_dim,
        inputs - observation_dim,
        num_networks=networks,
        num_elites=len(tensors["elites"]),
        num_cells=widths[1:-1],
    )
    model.load_state_dict(tensors)
    if not bool(((model.elites >= 0) & (model.elites < model.num_networks)).all()):
        raise ValueError("its elites are none of its networks")
    return model


def _layer(name: str) -> int:
    """Number of the layer in a name such as ``layers.10.weight``."""
    return next((int(part) for part in name.split(".") if part.isdigit()), -1)


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


# -- roll-outs -----------------------------------------------------------------------


def imagined_replay_buffer(
    cfg: DictConfig,
    data: TrainingData,
    model: DynamicsEnsemble,
    policy: nn.Module,
    transform: Callable[[TensorDictBase], TensorDictBase],
    adversary: ModelAdversary | None = None,
) -> ImaginedReplayBuffer:
    """Batches of ``trainer.batch_size`` rows, of which ``dynamics.real_ratio`` real.

    Args:
        cfg: a whole configuration of ``torchrl-osr train``.
        data: what the run trains on.
        model: of the dynamics, or with ``dynamics.reverse_policy`` of their reverse.
        policy: whose actions are drawn: an actor, or of a reverse model a
            :class:`~torchrl_osr.lab.dynamics.ConditionalVAE`.
        transform: applied to each batch.
        adversary: trains the model before each generation. Default: nobody.
    """
    options, norm, ends = cfg.dynamics, data.norm, termination_of(cfg)
    real, scale = data.alone(), cfg.data.reward_scale
    sizes = norm.scale.expand(model.observation_dim)
    units = torch.cat([sizes, sizes.new_tensor([1 / scale])])
    bounds: dict[str, Any] = {
        "terminated": _in_units_of(data, ends),
        **_unknown(cfg, data, model),
    }
    backwards = options.reverse_policy is not None

    def rows_of(copied: nn.Module) -> Imagined:
        # What is trained is copied, for a generation can be imagined again.
        policy, inside = (copied, model) if adversary is None else copied.children()

        def act(state: Tensor) -> Tensor:
            if options.reverse_policy == "uniform":
                return any_action(model)(state)
            if isinstance(policy, ConditionalVAE):
                return policy.sample(state)
            batch = TensorDict({"observation": state}, state.shape[:-1])
            with set_interaction_type(InteractionType.RANDOM):
                action: Tensor = policy(batch)["action"]
            if noise := options.action_noise:
                scale = noise * torch.rand(len(action), 1, device=action.device)
                action = (action + scale * torch.randn_like(action)).clamp(-1, 1)
            return action

        inside = cast(DynamicsEnsemble, inside)
        rows = data.rows(torch.randint(len(real), [options.rollout_starts]))
        starts: Tensor = rows["observation"]
        if steps := options.disturbed_steps:
            starts = disturbed(inside, starts, steps=steps, **bounds)
        rows, refused = (imagine_backwards if backwards else imagine)(
            inside, act, starts, steps=options.rollout_steps, units=units, **bounds
        )
        rows["next", "reward"] -= options.penalty * scale * rows["uncertainty"]
        rows = rows.select(*DATASET_KEYS)
        if cfg.optim.n_steps > 1:  # of the data's rows; these are single steps
            ones = torch.ones_like(rows["next", "done"], dtype=torch.long)
            rows["multi_step"] = rows["next"].copy().set("steps", ones)
        return Imagined(rows, refused)

    def finished(batch: TensorDictBase) -> TensorDictBase:
        batch = transform(batch)
        if not backwards:  # the policy's own actions, which teach it nothing as labels
            number = torch.arange(len(batch), device=batch.device).unsqueeze(-1)
            batch["imagined"] = number >= round(options.real_ratio * len(batch))
        return take_multi_step(batch) if cfg.optim.n_steps > 1 else batch

    return ImaginedReplayBuffer(
        real,
        policy if adversary is None else nn.ModuleList([policy, model]),
        rows_of,
        real_ratio=options.real_ratio,
        batch_size=cfg.trainer.batch_size,
        interval=options.rollout_interval,
        generations=options.generations,
        seed=cfg.seed,
        transform=finished,
        before=adversary,
    )


def model_adversary(
    cfg: DictConfig,
    data: TrainingData,
    model: DynamicsEnsemble,
    actor: ProbabilisticTensorDictSequential,
    loss: BaseLoss,
    adam: Callable[..., torch.optim.Optimizer],
) -> ModelAdversary:
    """What trains a run's model against its policy, as ``dynamics`` has it.

    Args:
        cfg: a whole configuration of ``torchrl-osr train``.
        data: what the run trains on.
        model: of the dynamics.
        actor: the policy.
        loss: the policy's, with critics.
        adam: makes an optimizer from parameters.
    """
    options = cfg.dynamics
    return ModelAdversary(
        model,
        loss,
        actor,
        data.alone(),
        adam(model.parameter_groups(), lr=options.adversarial_lr),
        steps=options.adversarial_steps,
        weight=options.adversarial_weight,
        rollout_steps=options.rollout_steps,
        batch_size=options.batch_size,
        gamma=cfg.optim.gamma,
        terminated=_in_units_of(data, termination_of(cfg)),
        seed=cfg.seed,
    )


@torch.no_grad()
def _unknown(
    cfg: DictConfig, data: TrainingData, model: DynamicsEnsemble
) -> dict[str, float]:
    """What :func:`imagine` does with rows on which the networks disagree."""
    options, held_out = cfg.dynamics, data.held_out
    if options.unknown == "take":
        return {}
    mean, _ = model.predict(held_out["observation"], held_out["action"])
    known = model.disagreement(mean).quantile(options.known_share)
    bounds = {"max_disagreement": known.item()}
    if options.unknown == "halt":
        # An end must not be better than what the data's worst rewards add up to.
        worst = held_out["next", "reward"].quantile(0.01).clamp(max=0)
        bounds["halt_reward"] = worst.item() / (1 - cfg.optim.gamma)
    return bounds


def _in_units_of(data: TrainingData, ends: Termination) -> Termination:
    """A rule for the task's own units, as one for those of the data."""
    return lambda state: ends(state * data.norm.scale + data.norm.loc)
