"""Losses and gradients that are not finite: kept away from the parameters.

One NaN in one gradient makes the parameter a NaN, and Adam's moments with it: without
this check the run is lost, and so is the batch that caused it.
"""

from __future__ import annotations

import math
from typing import Any, NoReturn

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_osr._files import whole_file
from torchrl_osr.trainers.checkpoints import Checkpoints

NUM_NAMED = 5
"""Losses and gradients that are named in a message, at most."""


def leaves_steps_out(optimizer: torch.optim.Optimizer) -> bool:
    """Whether a number on the device can tell ``optimizer`` to leave a step out."""
    return bool(getattr(optimizer, "_step_supports_amp_scaling", False))


class NonfiniteCheck:
    """Steps an optimizer until a loss or a gradient is not finite.

    An update is bad if a loss, a metric or the norm of a gradient is NaN or infinite.
    The first bad one ends the run, and leaves the parameters and the optimizer's state
    as they are, to the bit.

    Every update is checked before its step. With a fused optimizer on a GPU the check
    is ``deferred``, because to read each verdict would stall the host and cannot be
    part of a CUDA graph. The verdict stays on the device. The optimizer reads it there,
    as ``found_inf`` of :class:`torch.amp.GradScaler`, and leaves out the bad update and
    all later ones. The first bad batch is kept, and the host looks at the end of the
    log interval.

    Args:
        loss_module: whose updates.
        optimizer: of its parameters.
        checkpoints: of the run; a bad update is saved in a folder beside them.
        description: names the phase in messages.

    Attributes:
        deferred: whether the host looks at the end of the log interval only.
    """

    def __init__(
        self,
        loss_module: LossModule,
        optimizer: torch.optim.Optimizer,
        checkpoints: Checkpoints,
        description: str,
    ) -> None:
        self.loss_module, self.optimizer = loss_module, optimizer
        self.checkpoints, self.description = checkpoints, description
        device = next(loss_module.parameters()).device
        self.deferred = device.type != "cpu" and leaves_steps_out(optimizer)
        self._names = {each: name for name, each in loss_module.named_parameters()}
        # Since the host last looked: bad updates, all updates, the first bad one.
        self._bad = torch.zeros((), dtype=torch.int64, device=device)
        self._updates = torch.zeros_like(self._bad)
        self._evidence: TensorDict | None = None
        self._losses: list[str] = []
        self._gradients: list[str] = []
        self._start = 0

    def restart(self, step: int) -> None:
        """Continue after a step of the run."""
        self._start = step
        self._bad.zero_()
        self._updates.zero_()

    def step(self, batch: TensorDictBase, losses: TensorDictBase) -> None:
        """Step the optimizer if everything is finite.

        Raises:
            FloatingPointError: if something is not, unless that is ``deferred``.
        """
        groups = self.optimizer.param_groups
        trained = [p for each in groups for p in each["params"] if p.grad is not None]
        # An eighth of the time of the largest magnitudes. A square that overflows is as
        # bad: it would be one of Adam's second moments.
        norms = list(torch._foreach_norm([each.grad for each in trained]))
        if self.deferred:
            # As many numbers every time, also where not all parameters have their turn.
            found = dict(zip(trained, norms, strict=True))
            trained = [p for each in groups for p in each["params"]]
            norms = [found.get(each, torch.zeros_like(norms[0])) for each in trained]
        values = torch.stack([*losses.values(), *norms])
        self._updates.add_(1)
        if not self.deferred and all(map(math.isfinite, values.tolist())):
            self.optimizer.step()
            return
        bad = values.isfinite().all().logical_not()
        self._losses = list(map(str, losses.keys()))
        self._gradients = [self._names.get(each, "unnamed") for each in trained]
        self._keep_first(bad, batch, values)
        self._bad.add_(bad)
        if self.deferred:
            optimizer: Any = self.optimizer
            optimizer.found_inf = (self._bad > 0).float()
            optimizer.step()
            del optimizer.found_inf
        else:
            self.settle()

    def _keep_first(self, bad: Tensor, batch: TensorDictBase, values: Tensor) -> None:
        """Keep the batch and the values of the first bad update on the device."""
        new = TensorDict({"batch": batch, "values": values, "update": self._updates})
        kept = self._evidence
        # The host waits for a first batch, or one of another size, only.
        fits = kept is not None and new["batch"].shape == kept["batch"].shape
        if kept is None or not (fits or self._bad):
            self._evidence = new.clone()
        elif fits:
            first = bad & (self._bad == 0)
            for key, value in kept.items(include_nested=True, leaves_only=True):
                if isinstance(value, Tensor):
                    torch.where(first, new[key], value, out=value)

    def settle(self) -> None:
        """Read the verdicts since the last call; on a GPU the host waits here.

        Raises:
            FloatingPointError: if an update was bad.
        """
        bad, updates = torch.stack([self._bad, self._updates]).tolist()
        if bad:
            self._stop(self._start)
        self.restart(self._start + updates)

    def _stop(self, start: int) -> NoReturn:
        """Save the first bad update, and raise."""
        assert self._evidence is not None
        evidence = self._evidence.cpu()
        step, values = start + int(evidence["update"]), evidence["values"].tolist()
        losses = dict(zip(self._losses, values, strict=False))
        norms = zip(self._gradients, values[len(losses) :], strict=True)
        gradients = [name for name, value in norms if not math.isfinite(value)]
        nonfinite = [name for name, value in losses.items() if not math.isfinite(value)]
        record = {
            "step": step,
            "batch": evidence["batch"].to_dict(),
            "losses": losses,
            "gradients": gradients,
            "loss_module": self.loss_module.state_dict(),
        }
        raise FloatingPointError(
            f"{self.description}: step {step}: not finite: "
            f"{_listed(nonfinite, 'losses')}; {_listed(gradients, 'gradients')}."
            f" The batch, the losses and the parameters before "
            f"{self._saved(step, record)}. Look at the batch, and lower the learning "
            f"rates. The last checkpoint is {self.checkpoints.latest()}."
        )

    def _saved(self, step: int, record: dict[str, Any]) -> str:
        """Save the record; return where it is, or why it is not."""
        path = self.checkpoints.folder / "nonfinite" / f"step-{step:012d}.pt"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(path) as file:
                torch.save(record, file)
        except OSError as error:  # a full disk must not hide why the run stops
            return f"could not be written: {error}"
        return f"are in {path}: torch.load('{path}', weights_only=True)"


def _listed(names: list[str], kind: str) -> str:
    more = f" and {len(names) - NUM_NAMED} more" if len(names) > NUM_NAMED else ""
    return f"{kind} {', '.join(names[:NUM_NAMED]) or 'none'}{more}"
