"""Losses and gradients that are not finite: caught before they reach the parameters.

One NaN in one gradient makes the parameter a NaN, and Adam's moments with it: the run
is lost, and what led to it too, unless the update is kept from the parameters.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl import torchrl_logger

if TYPE_CHECKING:
    from torchrl_osr.trainers.offline import OfflineTrainer

FOLDER = "nonfinite"
"""Below the folder of the checkpoints: what led to a loss that is not finite."""

SHOWN = 5
"""At most so many names stand in a message."""

Layout = list[tuple[NestedKey, torch.Size, torch.dtype]]


def pack(tensors: TensorDictBase) -> tuple[Tensor, Layout]:
    """Return the bytes of all tensors in one, and how to read them again.

    On a GPU that is one kernel for all of them, and choosing between two is another.
    """
    items = [(k, v) for k, v in tensors.items(True, True) if isinstance(v, Tensor)]
    flat = [value.detach().reshape(-1).view(torch.uint8) for _, value in items]
    return torch.cat(flat), [(key, value.shape, value.dtype) for key, value in items]


def unpack(packed: Tensor, layout: Layout) -> dict[str, Any]:
    """Return what :func:`pack` was given, as nested dictionaries on the host."""
    sizes = [shape.numel() * dtype.itemsize for _, shape, dtype in layout]
    # A copy of each, for numbers of four bytes cannot begin anywhere.
    pieces = [piece.clone() for piece in torch.split(packed.cpu(), sizes)]
    tensors = TensorDict()
    for (key, shape, dtype), piece in zip(layout, pieces, strict=True):
        tensors[key] = piece.view(dtype).reshape(shape)
    nested: dict[str, Any] = tensors.to_dict()
    return nested


class FiniteGuard:
    """Steps a trainer's optimizer, but not by what is not finite.

    An update is bad if a loss, a metric or the norm of a gradient is a NaN or infinite.
    A bad one leaves the parameters and the optimizer's state as they are, to the bit.
    Target networks take their usual step, towards parameters that have not changed.

    On a CPU every update is looked at before its step. On a GPU looking would have the
    host wait for each update, and cannot be a part of a CUDA graph. There the verdict
    stays on the device: a fused optimizer reads it there (``found_inf``, by which
    :class:`torch.amp.GradScaler` has steps left out), the first bad update of a tick is
    kept there, and the host asks at the end of the tick. With ``"stop"``, all updates
    after the first bad one are left out too.

    Args:
        trainer: whose updates.
        mode: ``"stop"`` or ``"skip"``.

    Attributes:
        skipped: updates left out since the beginning of the run.

    Raises:
        ValueError: if there is no such mode, or the optimizer cannot skip on a GPU.
    """

    def __init__(self, trainer: OfflineTrainer, mode: Literal["stop", "skip"]) -> None:
        if mode not in ("stop", "skip"):
            raise ValueError(f"nonfinite must be 'stop' or 'skip', got {mode!r}.")
        self.trainer, self.skips, self.skipped = trainer, mode == "skip", 0
        device = next(trainer.loss_module.parameters()).device
        self._at_once = device.type == "cpu" and not trainer.cudagraph
        optimizer = trainer.optimizer
        self._obeys = getattr(optimizer, "_step_supports_amp_scaling", False)
        if self.skips and not (self._at_once or self._obeys):
            raise ValueError(
                f"nonfinite='skip' on a GPU needs an optimizer that leaves a step out "
                f"by itself, such as torch.optim.Adam(..., fused=True); got "
                f"{type(optimizer).__name__} without. Use that, or nonfinite='stop'."
            )
        parameters = trainer.loss_module.named_parameters()
        self._names = {parameter: name for name, parameter in parameters}
        self._bad = torch.zeros((), dtype=torch.int64, device=device)
        self._updates = torch.zeros_like(self._bad)
        self._kept, self._layout = torch.empty(0), Layout()
        self._start = 0

    def restart(self, skipped: int) -> None:
        """Go on from the trainer's step, with so many updates left out before it."""
        self.skipped, self._start = skipped, self.trainer.step
        self._bad.zero_()
        self._updates.zero_()

    def step(self, batch: TensorDictBase, losses: TensorDictBase) -> TensorDictBase:
        """Step the optimizer if all is finite; return the losses to be averaged.

        Args:
            batch: what the losses are of.
            losses: detached; those of an update that is skipped come back as zeros.
        """
        groups = self.trainer.optimizer.param_groups
        found = [p for each in groups for p in each["params"] if p.grad is not None]
        # An eighth of the time of the largest magnitudes. A square that overflows is as
        # bad: it would be one of Adam's second moments.
        norms = torch._foreach_norm([each.grad for each in found])
        values = torch.stack([*losses.values(), *norms])
        self._updates.add_(1)
        if self._at_once and all(map(math.isfinite, values.tolist())):
            self.trainer.optimizer.step()
            return losses
        bad = values.isfinite().all().logical_not()
        names = [self._names.get(each, "unnamed") for each in found]
        gradients = dict(zip(names, norms, strict=True))
        self._note(bad, {"batch": batch, "losses": losses, "gradients": gradients})
        if not self._at_once:
            self._step_unless(bad if self.skips else self._bad > 0)
        elif not self.skips:
            self.settle()
        if not self.skips:
            return losses
        return losses.apply(lambda value: value.masked_fill(bad, 0))

    def _note(self, bad: Tensor, evidence: dict[str, Any]) -> None:
        """Count an update that may be bad, and keep the first one that is."""
        targets = {
            name: value for name, value in self.trainer.loss_module.named_buffers()
            if name.startswith("target_")
        }  # fmt: skip
        evidence |= {"targets": targets, "updates": self._updates}
        packed, layout = pack(TensorDict(evidence))
        # A first batch, or one of another size, for which the host waits.
        if layout != self._layout and not self._bad:
            self._kept, self._layout = packed.clone(), layout
        if layout == self._layout:
            first = bad & (self._bad == 0)
            torch.where(first, packed, self._kept, out=self._kept)
        self._bad.add_(bad)

    def _step_unless(self, left_out: Tensor) -> None:
        """Step the optimizer; what leaves the step out is a number on the device."""
        optimizer: Any = self.trainer.optimizer
        if not self._obeys:
            optimizer.step()
            return
        optimizer.found_inf = left_out.float()
        try:
            optimizer.step()
        finally:
            del optimizer.found_inf

    def settle(self, *, whole: bool = True) -> float:
        """Read what there was since the last time; on a GPU the host waits here.

        Keyword Args:
            whole: whether a tick is over, in which something must have been learnt.

        Returns:
            What a mean over all updates is multiplied by to be one over those done.

        Raises:
            FloatingPointError: if an update was bad; with ``"skip"``, if all were.
        """
        bad, updates = torch.stack([self._bad, self._updates]).tolist()
        self._bad.zero_()
        self._updates.zero_()
        start, self._start = self._start, self._start + updates
        if not bad:
            return 1.0
        if not self.skips or (whole and bad == updates):
            self._stop(start, bad, updates)
        self.skipped += bad
        torchrl_logger.warning(
            f"{self.trainer.description}: {bad} of the {updates} updates up to step "
            f"{self._start} were skipped, {self.skipped} since the beginning: a loss "
            "or a gradient was not finite. Parameters and optimizer are as they were."
        )
        return updates / (updates - bad) if bad < updates else 1.0

    def _stop(self, start: int, bad: int, updates: int) -> NoReturn:
        """Save what the first bad update was made of, and raise."""
        trainer, record = self.trainer, unpack(self._kept, self._layout)
        step = start + int(record.pop("updates"))
        record["losses"] = {k: float(v) for k, v in record["losses"].items()}
        losses = [k for k, v in record["losses"].items() if not math.isfinite(v)]
        gradients = [k for k, v in record["gradients"].items() if not v.isfinite()]
        network = trainer.loss_module.state_dict() | record.pop("targets", {})
        record |= {"step": step, "gradients": gradients, "loss_module": network}
        path = Path(trainer.rotation.directory) / FOLDER / f"step-{step:012d}.pt"
        every = f" All {bad} updates since were skipped." if self.skips else ""
        when = "before" if self._at_once or self._obeys else f"{updates} updates after"
        raise FloatingPointError(
            f"{trainer.description}: step {step}: not finite: "
            f"{_shown(losses, 'losses')}; {_shown(gradients, 'gradients')}.{every} The "
            f"batch, the losses and the parameters {when} {_saved(path, record)}. Look "
            "at the batch, lower the learning rates, or leave such updates out with "
            f"nonfinite='skip' (trainer.nonfinite=skip). The last checkpoint is "
            f"{trainer.rotation.latest()}."
        )


def _shown(names: list[str], kind: str) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return f"{kind} {', '.join(names[:SHOWN]) or 'none'}{more}"


def _saved(path: Path, record: dict[str, Any]) -> str:
    """Write a record, beside its place first; say where it is, or why it is not."""
    beside = path.with_name(f".{path.name}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("wb") as file:
            torch.save(record, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    # torch.save turns a full disk into a RuntimeError. What stops the run is the loss.
    except (OSError, RuntimeError) as error:
        beside.unlink(missing_ok=True)
        return f"could not be written to {path} ({error})"
    return f"are in {path}: torch.load('{path}', weights_only=True)"
