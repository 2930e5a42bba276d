"""Data, networks and loss as a configuration has them.

The trainer's script builds them to be trained; whoever loads a trained run builds them
once more and fills them from its checkpoint.
"""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple

import torch
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.objectives import LossModule

from torchrl_osr._checks import check_choice
from torchrl_osr.data import TransitionsOnDisk, load_dataset
from torchrl_osr.modules import critic_ensemble


def load_data(
    cfg: DictConfig, *, progress: bool = True
) -> tuple[TensorDict | TransitionsOnDisk, dict[str, Any]]:
    """Load the run's data set, see :func:`~torchrl_osr.data.load_dataset`.

    Its rewards become ``data.reward_scale * r + data.reward_shift``; the manifest has
    the task's own, and so has a set on disk (``data.storage=disk``), of which the
    batches are scaled.

    Args:
        cfg: a whole configuration of ``examples/offline_osr.py``; that of an older run
            may lack the newer keys.

    Keyword Args:
        progress: show a progress bar when on a terminal. Default: ``True``.
    """
    data, manifest = load_dataset(
        cfg.env.name,
        cfg.data.level,
        env_id=cfg.env.id,
        path=cfg.data.get("path"),
        download=cfg.data.get("download", False),
        random_share=cfg.data.get("random_share", 0.0),
        num_transitions=cfg.data.num_transitions,
        seed=cfg.data.seed,
        progress=progress,
        on_disk=check_storage(cfg) == "disk",
    )
    scale = cfg.data.get("reward_scale", 1.0)
    shift = cfg.data.get("reward_shift", 0.0)
    if (scale, shift) != (1.0, 0.0) and isinstance(data, TensorDict):
        data["next", "reward"] = scale * data["next", "reward"] + shift
    return data, manifest


def check_storage(cfg: DictConfig) -> str:
    """Return where the data shall be.

    Raises:
        ValueError: it is no such place, or cannot be had with the other options.
    """
    # The configuration of an older run has no such key.
    storage = str(cfg.data.get("storage", "memory"))
    check_choice("data.storage", storage, ("memory", "disk"))
    if storage == "disk" and cfg.trainer.cudagraph:
        raise ValueError(
            "trainer.cudagraph=true cannot be had with data.storage=disk: a CUDA graph "
            "repeats kernels, and reading a file is none. Take data.storage=memory, or "
            "trainer.cudagraph=false."
        )
    return storage


class Learner(NamedTuple):
    """A policy's loss and the networks in it.

    Attributes:
        actor: the policy.
        model: the inverse dynamics model, whether the loss uses it or not.
        loss: holds the tensors of both, the model's frozen: what either learns, the
            loss knows.
    """

    actor: ProbabilisticTensorDictSequential
    model: ProbabilisticTensorDictSequential
    loss: LossModule


def make_learner(
    cfg: DictConfig,
    observation_size: int,
    action_size: int,
    device: torch.device | str = "cpu",
) -> Learner:
    """Networks and loss, drawn anew from torch's global generator.

    A loss is given those networks that its constructor names: ``actor_network``,
    ``qvalue_network``, ``inverse_dynamics_network``.

    Args:
        cfg: a whole configuration of ``examples/offline_osr.py``.
        observation_size, action_size: of the data.
        device: where they shall be. Default CPU.

    Raises:
        ValueError: if an option of the loss is out of its range.
    """
    sizes, cells = (observation_size, action_size), list(cfg.network.num_cells)
    actor = instantiate(cfg.network.actor, *sizes, num_cells=cells).to(device)
    critics = critic_ensemble(
        *sizes,
        num_qvalue_nets=cfg.loss.num_qvalue_nets,
        num_cells=cells,
        layer_norm=cfg.network.layer_norm,
    )
    model = instantiate(cfg.inverse_dynamics.network, *sizes, num_cells=cells)
    networks = {
        "actor_network": actor,
        "qvalue_network": critics,
        "inverse_dynamics_network": model.to(device),
    }
    wanted = inspect.signature(get_class(cfg.loss._target_)).parameters
    given = {name: each for name, each in networks.items() if name in wanted}
    loss = instantiate(cfg.loss, _partial_=True)(**given).to(device)
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    return Learner(actor, model, loss)
