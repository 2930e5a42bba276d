"""Data, networks and loss as a configuration has them, to train or to be loaded."""

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
from torchrl_osr.modules import critic_ensemble


def load_data(
    cfg: DictConfig, *, progress: bool = True
) -> tuple[TensorDict, dict[str, Any]]:
    """Data set and manifest of a run, see :func:`~torchrl_osr.data.load_dataset`.

    Rewards are the task's own: :mod:`~torchrl_osr.experiment.training_data` scales
    them.
    """
    from torchrl_osr.data import load_dataset  # needs Gymnasium; networks do not

    return load_dataset(
        cfg.env.name,
        cfg.data.quality,
        env_id=cfg.env.id,
        path=cfg.data.path,
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
        ValueError: it is no such place, or cannot be had with the other options.
    """
    storage = str(cfg.data.storage)
    check_choice("data.storage", storage, ("memory", "disk"))
    if storage == "disk" and cfg.trainer.cudagraph:
        raise ValueError(
            "trainer.cudagraph=true cannot be had with data.storage=disk: a CUDA graph "
            "reads no files. Take data.storage=memory, or trainer.cudagraph=false."
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
        cfg: a whole configuration of ``torchrl-osr train``.
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
