"""Losses and gradients that are not finite: kept away from the parameters.

One NaN in one gradient makes the parameter a NaN, and Adam's moments with it: without
this check the run is lost, and so is the batch that caused it.
"""

from __future__ import annotations

import logging
import math
from typing import Any, Literal, NoReturn

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_osr._checks import check_choice
from torchrl_osr._files import whole_file
from torchrl_osr.trainers.checkpoints import Checkpoints

log = logging.getLogger(__name__)

NUM_NAMED = 5
"""Losses and gradients that are named in a message, at most."""


def leaves_steps_out(optimizer: torch.optim.Optimizer) -> bool:
    """Whether a number on the device can tell ``optimizer`` to leave a step out."""
    return bool(getattr(optimizer, "_step_supports_amp_scaling", False))


class NonfiniteCheck:
    """Steps an optimizer, unless a loss or a gradient is not finite.

    An update is bad if a loss, a metric or the norm of a gradient is NaN or infinite. A
    bad one leaves the parameters and the optimizer's state as they are, to the bit.
    Target networks take their usual step, towards parameters that have not changed.

    Every update is checked before its step. With a fused optimizer on a GPU, where the
    host would have to wait for each update and a CUDA graph could not contain the
    check, it is ``deferred``: the verdict stays on the device, where the optimizer
    reads it (``found_inf``, by which :class:`torch.amp.GradScaler` has steps left out),
    the first bad batch is kept there, and the host looks at the end of the log
    interval. With ``"stop"``, all updates after the first bad one are left out too.

    Args:
        loss_module: whose updates.
        optimizer: of its parameters.
        mode: ``"stop"`` or ``"skip"``.
        checkpoints: of the run; a bad update is saved in a folder beside them.
        description: names the phase in messages.

    Attributes:
        deferred: whether the host looks at the end of the log interval only.
        skipped: updates left out since the beginning of the run.
    """

    def __init__(
        self,
        loss_module: LossModule,
        optimizer: torch.optim.Optimizer,
        mode: Literal["stop", "skip"],
        checkpoints: Checkpoints,
        description: str,
    ) -> None:
        check_choice("nonfinite", mode, ("stop", "skip"))
        self.loss_module, self.optimizer = loss_module, optimizer
        self.skips, self.skipped = mode == "skip", 0
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

    def restart(self, step: int, skipped: int) -> None:
        """Continue after a step of the run, with so many updates left out before."""
        self.skipped, self._start = skipped, step
        self._bad.zero_()
        self._updates.zero_()

    def step(self, batch: TensorDictBase, losses: TensorDictBase) -> TensorDictBase:
        """Step the optimizer if everything is finite; return the losses to average.

        Args:
            batch: what the losses are of.
            losses: detached; those of an update that is skipped come back as zeros.
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
            return losses
        bad = values.isfinite().all().logical_not()
        self._losses = list(map(str, losses.keys()))
        self._gradients = [self._names.get(each, "unnamed") for each in trained]
        self._keep_first(bad, batch, values)
        self._bad.add_(bad)
        if self.deferred:
            optimizer: Any = self.optimizer
            optimizer.found_inf = (bad if self.skips else self._bad > 0).float()
            optimizer.step()
            del optimizer.found_inf
        elif not self.skips:
            self.settle()
        if not self.skips:
            return losses
        return losses.apply(lambda value: value.masked_fill(bad, 0))

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

    def settle(self, *, whole: bool = True) -> float:
        """Read the verdicts since the last call; on a GPU the host waits here.

        Keyword Args:
            whole: whether a log interval is over, in which at least one update must
                have been done.

        Returns:
            Factor that turns a mean over all updates into one over those done.

        Raises:
            FloatingPointError: if an update was bad; with ``"skip"``, if all were.
        """
        bad, updates = torch.stack([self._bad, self._updates]).tolist()
        start = self._start
        self.restart(start + updates, self.skipped)
        if not bad:
            return 1.0
        if not self.skips or (whole and bad == updates):
            self._stop(start, bad, updates)
        self.skipped += bad
        log.warning(
            f"{self.description}: {bad} of the {updates} updates up to step "
            f"{self._start} were skipped, {self.skipped} since the beginning: a loss "
            "or a gradient was not finite. Parameters and optimizer are as they were."
        )
        return updates / (updates - bad) if bad < updates else 1.0

    def _stop(self, start: int, bad: int, updates: int) -> NoReturn:
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
        every = f" All {bad} updates since were skipped." if self.skips else ""
        raise FloatingPointError(
            f"{self.description}: step {step}: not finite: "
            f"{_listed(nonfinite, 'losses')}; {_listed(gradients, 'gradients')}."
            f"{every} The batch, the losses and the parameters before "
            f"{self._saved(step, record)}. Look at the batch, lower the learning "
            "rates, or leave such updates out with nonfinite='skip' "
            f"(trainer.nonfinite=skip). The last checkpoint is "
            f"{self.checkpoints.latest()}."
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
