"""An update as one CUDA graph, by :class:`tensordict.nn.CudaGraphModule`.

On a GPU an update of small networks is some hundreds of short kernels, which Python
takes longer to launch than the GPU to compute. A graph launches them together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule, ProbabilisticTensorDictModule
from torch import nn
from torchrl.objectives import LossModule

from torchrl_osr.trainers.nonfinite import leaves_steps_out

WARM_UP = 5
"""Updates before the capture, as in TorchRL's own scripts: the optimizer's state and
compiled code must exist by then."""


def check_capturable(optimizer: torch.optim.Optimizer) -> None:
    """Raise a ValueError unless the optimizer decides on the device what it does."""
    capturable = all(group.get("capturable") for group in optimizer.param_groups)
    if not (capturable and leaves_steps_out(optimizer)):
        raise ValueError(
            "cudagraph=True needs an optimizer that counts its steps, and leaves some "
            "out, on the device: torch.optim.Adam(..., fused=True, capturable=True); "
            f"got another {type(optimizer).__name__}."
        )


def captured(
    update: Callable[[TensorDictBase], TensorDictBase], loss_module: LossModule
) -> CudaGraphModule:
    """Update that runs as it is five times and is replayed as a CUDA graph afterwards.

    A graph repeats kernels, not Python: whatever ``update`` decides on the host stays
    as it was at the capture, and nothing in it may read a number back to the host.

    Args:
        update: maps a batch to its detached losses, and steps the optimizer. Its
            tensors must stay the same objects: load checkpoints first.
        loss_module: its networks' distributions get their bounds as tensors on the
            device; TorchRL 0.14.1 copies a number there at every call.
    """
    device = next(loss_module.parameters()).device
    for module in _networks(loss_module):
        if not isinstance(module, ProbabilisticTensorDictModule):
            continue
        options = module.distribution_kwargs
        # Bounds that are tensors already are TensorDictParams, which have moved along.
        if isinstance(options, dict):
            module.distribution_kwargs = options | {
                name: torch.as_tensor(options[name], device=device)
                for name in ("low", "high")
                if options.get(name) is not None
            }
    return CudaGraphModule(
        update, warmup=WARM_UP, in_keys=[], out_keys=[], device=device
    )


def _networks(loss_module: LossModule) -> Iterator[nn.Module]:
    """Yield all modules of a loss, and those of the networks that TorchRL hides."""
    for module in loss_module.modules():
        yield module
        for value in vars(module).values():
            if isinstance(value, nn.Module):
                yield from value.modules()
