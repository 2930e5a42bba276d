"""What tells a model that nobody has trained: the weights it was built with."""

from __future__ import annotations

import hashlib

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.modules import ProbabilisticActor


def digest_of_weights(params: TensorDictBase) -> str:
    """SHA-256 of a network's parameters and buffers, names and bytes.

    Args:
        params: of the network, as :meth:`tensordict.TensorDict.from_module` returns.
    """
    digest = hashlib.sha256()
    for name, tensor in sorted(params.flatten_keys(".").items()):
        digest.update(name.encode())
        values = tensor.detach().cpu().contiguous().reshape(-1)
        digest.update(values.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def remember_weights(model: ProbabilisticActor) -> ProbabilisticActor:
    """Return the model, with the digest of its weights as ``initial_digest``.

    The digest is no part of the state dict. Weights that were trained or loaded in
    whatever way have another one.
    """
    model.initial_digest = digest_of_weights(TensorDict.from_module(model))
    return model


def initial_digest(model: nn.Module) -> str | None:
    """What :func:`remember_weights` has noted of a model, or ``None``."""
    digest: str | None = getattr(model, "initial_digest", None)
    return digest
