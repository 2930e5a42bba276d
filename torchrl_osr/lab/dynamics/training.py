"""Train the models of a run's dynamics, and roll its policy out in them.

A trained ensemble is kept in the cache folder: runs with the same data, settings and
seed train it once. Every run has a copy in its folder.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import torch
from filelock import FileLock
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    set_interaction_type,
)
from torch import Tensor, nn
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer, Storage

from torchrl_osr import __version__
from torchrl_osr._files import write_json
from torchrl_osr.lab.data.store.cache import cache_root
from torchrl_osr.lab.data.store.multi_step import take_multi_step
from torchrl_osr.lab.data.store.validation import DATASET_KEYS
from torchrl_osr.lab.dynamics.conditional_vae import ConditionalVAE
from torchrl_osr.lab.dynamics.conditional_vae_loss import ConditionalVAELoss
from torchrl_osr.lab.dynamics.dynamics_loss import DynamicsLoss
from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble
from torchrl_osr.lab.dynamics.fit import describe_dynamics, dynamics_report
from torchrl_osr.lab.dynamics.model_adversary import ModelAdversary
from torchrl_osr.lab.dynamics.options import DynamicsOptions
from torchrl_osr.lab.dynamics.rollout import (
    Imagined,
    any_action,
    disturbed,
    imagine,
    imagine_backwards,
    turned,
)
from torchrl_osr.lab.dynamics.rollout_buffer import ImaginedReplayBuffer
from torchrl_osr.lab.dynamics.termination import Termination
from torchrl_osr.objectives import BaseLoss
from torchrl_osr.policy.tensor_file import read_tensors, write_tensors
from torchrl_osr.trainers import OfflineTrainer
from torchrl_osr.trainers.checkpoints import safe_checkpoint

log = logging.getLogger(__name__)

FILE, REPORT = "dynamics.safetensors", "dynamics.json"
"""The model and what is known of its errors, in the folder of a run."""

KIND = "dynamics model"

ROWS_FOR_STATISTICS = 50_000
"""Rows from which a model's inputs and targets are standardised."""

FITTED = ("num_networks", "num_elites", "num_cells", "lr", "batch_size", "steps")
"""Options that decide what a trained model is."""


@dataclass(frozen=True)
class ModelData:
    """Transitions that dynamics models learn from, and the units that they are in.

    Attributes:
        storage: rows to train on.
        held_out: rows to judge models by.
        pieces: of trajectories, ``[n, L]``, to judge roll-outs by.
        loc, scale: what was subtracted from the task's observations, and what they were
            divided by.
        reward_scale, reward_shift: rewards are ``scale * r + shift``.
        env_id: Gymnasium id of the task.
        backward: whether state and next state are exchanged in batches, held-out rows
            and pieces.
    """

    storage: Storage
    held_out: TensorDict
    pieces: TensorDict | None
    loc: Tensor
    scale: Tensor
    reward_scale: float
    reward_shift: float
    env_id: str
    backward: bool = False

    def buffer(self, batch_size: int | None = None) -> ReplayBuffer:
        """Return a buffer that samples the rows to train on, without transforms."""
        buffer = ReplayBuffer(
            storage=self.storage,
            writer=ImmutableDatasetWriter(),
            collate_fn=lambda batch: batch,
            batch_size=batch_size,
        )
        if self.backward:
            buffer.append_transform(turned)
        return buffer

    def reverse(self) -> ModelData:
        """Return the same transitions against the direction of time."""
        return replace(
            self,
            held_out=turned(self.held_out),
            pieces=None if self.pieces is None else turned(self.pieces.flip(1)),
            backward=True,
        )

    def facts(self) -> dict[str, Any]:
        """Return what a model shares with its data, JSON-compatible."""
        digest = hashlib.sha256()
        held_out = self.held_out.cpu()
        for key in DATASET_KEYS:
            values = held_out[key].contiguous().view(torch.uint8)
            digest.update(values.numpy().tobytes())
        return {
            "environment": self.env_id,
            "rows": len(self.storage),
            "observation mean": self.loc.tolist(),
            "observation scale": self.scale.tolist(),
            "reward scale": self.reward_scale,
            "reward shift": self.reward_shift,
            "held-out rows": digest.hexdigest(),
            "direction of time": "backward" if self.backward else "forward",
        }

    def standardized(self, rule: Termination) -> Termination:
        """Return a rule for standardised observations, from one in the task's units."""
        return lambda state: rule(state * self.scale + self.loc)


@dataclass(frozen=True)
class Phase:
    """What all phases of a run's training share.

    Attributes:
        folder: of the run; each phase has checkpoints of its own.
        new_trainer: makes the trainer of a phase.
        adam: makes an optimizer from parameters.
        seed: of the run.
    """

    folder: Path
    new_trainer: Callable[..., OfflineTrainer]
    adam: Callable[..., torch.optim.Optimizer]
    seed: int


def train_dynamics(
    options: DynamicsOptions,
    data: ModelData,
    loss: nn.Module,
    actor: ProbabilisticTensorDictSequential,
    phase: Phase,
    *,
    name: str,
    arithmetic: Mapping[str, Any],
    batch_size: int,
    gamma: float,
    n_steps: int,
    transform: Callable[[TensorDictBase], TensorDictBase],
) -> tuple[ImaginedReplayBuffer | None, ModelAdversary | None]:
    """Train a run's models of the dynamics, and give them to its loss.

    Args:
        options: of the models and their roll-outs.
        data: what models learn from.
        loss: of the policy.
        actor: the policy.
        phase: what trains a model.

    Keyword Args:
        name: of the data, for a model's file in the cache.
        arithmetic: other settings that decide what a trained model is.
        batch_size, gamma, n_steps: of the policy's training.
        transform: of the policy's batches.

    Returns:
        The buffer of real and synthetic rows, and what trains the model against the
        policy; ``None`` for what the options do not ask for.
    """
    model_data = data if options.reverse_policy is None else data.reverse()
    model = dynamics_model(options, model_data, phase, name=name, arithmetic=arithmetic)
    sizes = model.observation_dim, model.action_dim
    if hasattr(loss, "dynamics_network"):
        cast(BaseLoss, loss).load_network("dynamics_network", model)
    if hasattr(loss, "transition_network"):
        vae = options.transition_vae(sizes[0])
        train_vae(vae, options, data, phase)
        cast(BaseLoss, loss).load_network("transition_network", vae)
    if options.real_ratio == 1:
        return None, None
    policy: nn.Module = actor
    if options.reverse_policy == "cvae":
        policy = options.reverse_vae(*sizes)
        train_vae(policy, options, data, phase)
    adversary = None
    if options.adversarial_steps and options.adversarial_weight:
        adversary = ModelAdversary(
            model,
            cast(BaseLoss, loss),
            actor,
            data.buffer(),
            phase.adam(model.parameter_groups(), lr=options.adversarial_lr),
            steps=options.adversarial_steps,
            weight=options.adversarial_weight,
            rollout_steps=options.rollout_steps,
            batch_size=options.batch_size,
            gamma=gamma,
            terminated=data.standardized(options.termination(data.env_id)),
            seed=phase.seed,
        )
    buffer = imagined_replay_buffer(
        options,
        data,
        model,
        policy,
        transform,
        adversary,
        batch_size=batch_size,
        gamma=gamma,
        n_steps=n_steps,
        seed=phase.seed,
    )
    return buffer, adversary


def dynamics_model(
    options: DynamicsOptions,
    data: ModelData,
    phase: Phase,
    *,
    name: str,
    arithmetic: Mapping[str, Any],
) -> DynamicsEnsemble:
    """Return the frozen model of a run, with a report in its folder.

    Args:
        options: of the model.
        data: what it learns from.
        phase: what trains it.

    Keyword Args:
        name: of the data, for the file in the cache.
        arithmetic: other settings that decide what a trained model is.

    Raises:
        ValueError: ``options.path`` names another file, or a model of other data.
    """
    facts, given = data.facts(), options.path
    here = phase.folder / FILE
    if not here.exists() and given is not None:
        write_dynamics(here, load_dynamics(given, facts), facts)
    elif not here.exists():
        chosen = {key: asdict(options)[key] for key in FITTED}
        stamp = {"version": __version__, "seed": phase.seed} | chosen
        everything = {"data": facts, "settings": stamp | dict(arithmetic)}
        text = json.dumps(everything, sort_keys=True).encode()
        digest = hashlib.sha256(text).hexdigest()[:16]
        cached = cache_root() / "dynamics" / f"{name}-{digest}.safetensors"
        cached.parent.mkdir(parents=True, exist_ok=True)
        # Other runs that need the same model wait for it.
        with FileLock(f"{cached}.lock"):
            try:
                model = load_dynamics(cached, facts)
                log.info(f"dynamics: the model is {cached}")
            except (OSError, ValueError) as flaw:
                if cached.exists():
                    log.warning(f"Training {cached} anew: {flaw}")
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
    """Train a model; the weights of its best evaluation are taken."""
    held_out = data.held_out
    sizes = held_out["observation"].shape[-1], held_out["action"].shape[-1]
    torch.manual_seed(phase.seed)
    model = options.ensemble(*sizes)
    model.to(held_out.device or "cpu")
    model.standardize_(_rows_for_statistics(data, phase))
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


def train_vae(
    model: ConditionalVAE, options: DynamicsOptions, data: ModelData, phase: Phase
) -> None:
    """Train a conditional autoencoder for ``vae_steps``, and freeze it."""
    held_out = data.held_out
    model.to(held_out.device or "cpu")
    if model.change:
        model.standardize_(_rows_for_statistics(data, phase))
    loss = ConditionalVAELoss(model)

    @torch.no_grad()
    def evaluate() -> dict[str, float]:
        return {"vae_error": loss(held_out)["loss_vae"].item()}

    phase.new_trainer(
        loss,
        phase.adam(model.parameters(), lr=options.lr),
        replay_buffer=data.buffer(options.batch_size),
        total_steps=options.vae_steps,
        folder=phase.folder / "checkpoint" / "vae",
        seed=phase.seed,
        evaluate=evaluate,
        metric=("vae_error", "min"),
        eval_interval=options.vae_steps,
        description="vae",
    ).train()
    model.requires_grad_(False)


def _rows_for_statistics(data: ModelData, phase: Phase) -> TensorDictBase:
    rows, device = data.buffer(), data.held_out.device or "cpu"
    rows.set_rng(torch.Generator(device).manual_seed(phase.seed))
    sample: TensorDictBase = rows.sample(ROWS_FOR_STATISTICS)
    return sample


# -- files ---------------------------------------------------------------------------


def write_dynamics(
    path: Path, model: DynamicsEnsemble, facts: Mapping[str, Any]
) -> None:
    """Write a model and the facts of its data to one file of tensors."""
    write_tensors(path, model.state_dict(), {"kind": KIND, "data": dict(facts)})


def load_dynamics(
    path: Path | str, facts: Mapping[str, Any] | None = None
) -> DynamicsEnsemble:
    """Load a model that a run has trained; nothing is unpickled.

    torch's global generator is left as it was.

    Args:
        path: of the file, ``dynamics.safetensors`` in the folder of a run.
        facts: :meth:`ModelData.facts` of the data that it has to fit. Default: any.

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
    options: DynamicsOptions,
    data: ModelData,
    model: DynamicsEnsemble,
    policy: nn.Module,
    transform: Callable[[TensorDictBase], TensorDictBase],
    adversary: ModelAdversary | None = None,
    *,
    batch_size: int,
    gamma: float,
    n_steps: int,
    seed: int,
) -> ImaginedReplayBuffer:
    """Batches of which the share ``options.real_ratio`` is real.

    Args:
        options: of the roll-outs.
        data: the real rows.
        model: of the dynamics, or with ``options.reverse_policy`` of their reverse.
        policy: whose actions are drawn: an actor, or of a reverse model a
            :class:`~torchrl_osr.lab.dynamics.ConditionalVAE`.
        transform: applied to each batch.
        adversary: trains the model before each generation. Default: none.

    Keyword Args:
        batch_size: rows of a batch.
        gamma: discount factor.
        n_steps: of the data's rows; synthetic rows are single steps.
        seed: of the roll-outs.
    """
    real = data.buffer()
    sizes = data.scale.expand(model.observation_dim)
    units = torch.cat([sizes, sizes.new_tensor([1 / data.reward_scale])])
    bounds: dict[str, Any] = {
        "terminated": data.standardized(options.termination(data.env_id)),
        **_unknown(options, data, model, gamma),
    }
    backward = options.reverse_policy is not None

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
        rows = data.storage.get(torch.randint(len(real), [options.rollout_starts]))
        starts: Tensor = rows["observation"]
        if steps := options.disturbed_steps:
            starts = disturbed(inside, starts, steps=steps, **bounds)
        rows, refused = (imagine_backwards if backward else imagine)(
            inside, act, starts, steps=options.rollout_steps, units=units, **bounds
        )
        penalty = options.penalty * data.reward_scale
        rows["next", "reward"] -= penalty * rows["uncertainty"]
        rows = rows.select(*DATASET_KEYS)
        if n_steps > 1:  # of the data's rows; these are single steps
            ones = torch.ones_like(rows["next", "done"], dtype=torch.long)
            rows["multi_step"] = rows["next"].copy().set("steps", ones)
        return Imagined(rows, refused)

    def finished(batch: TensorDictBase) -> TensorDictBase:
        batch = transform(batch)
        if not backward:  # the policy's own actions, which teach it nothing as labels
            number = torch.arange(len(batch), device=batch.device).unsqueeze(-1)
            batch["imagined"] = number >= round(options.real_ratio * len(batch))
        return take_multi_step(batch) if n_steps > 1 else batch

    return ImaginedReplayBuffer(
        real,
        policy if adversary is None else nn.ModuleList([policy, model]),
        rows_of,
        real_ratio=options.real_ratio,
        batch_size=batch_size,
        interval=options.rollout_interval,
        generations=options.generations,
        seed=seed,
        transform=finished,
        before=adversary,
    )


@torch.no_grad()
def _unknown(
    options: DynamicsOptions, data: ModelData, model: DynamicsEnsemble, gamma: float
) -> dict[str, float]:
    """Options of :func:`imagine` for rows on which the networks disagree."""
    held_out = data.held_out
    if options.unknown == "take":
        return {}
    mean, _ = model.predict(held_out["observation"], held_out["action"])
    known = model.disagreement(mean).quantile(options.known_share)
    bounds = {"max_disagreement": known.item()}
    if options.unknown == "halt":
        # An end must not be better than what the data's worst rewards add up to.
        worst = held_out["next", "reward"].quantile(0.01).clamp(max=0)
        bounds["halt_reward"] = worst.item() / (1 - gamma)
    return bounds
