"""What makes TorchRL's trainer run offline: a clock for a collector, and the update."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl import torchrl_logger
from torchrl.checkpoint import CheckpointRotation
from torchrl.trainers import OptimizationStepper, Trainer

from torchrl_osr.trainers.captured import CapturedUpdate
from torchrl_osr.trainers.finite_guard import FiniteGuard
from torchrl_osr.trainers.preemption import Preempted, Termination


class GradientSteps:
    """The clock that stands in for a collector: an empty batch of n rows is n steps.

    A tick ends wherever something is due (a log entry, an evaluation, a checkpoint).

    Args:
        total: steps of the whole run.
        intervals: steps between the things that may be due: log entries, evaluations,
            checkpoints.

    Raises:
        ValueError: if one of them is not at least 1.
    """

    init_random_frames = 0

    def __init__(self, total: int, intervals: Sequence[int]) -> None:
        if total < 1 or min(intervals) < 1:
            raise ValueError(
                "steps and intervals must be at least 1, got "
                f"total_steps={total} and log, eval and checkpoint intervals "
                f"{intervals}."
            )
        self.total = total
        self.intervals = intervals
        self.step = 0

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.step < self.total:
            due = min(
                (self.step // interval + 1) * interval for interval in self.intervals
            )
            steps = min(due, self.total) - self.step
            self.step += steps
            yield TensorDict({}, [steps])

    def shutdown(self) -> None:
        """Do nothing: the trainer calls this on its collector."""


@contextmanager
def pandas_settled() -> Iterator[None]:
    """Spare every module call a search of the disk for pandas.

    tensordict 0.14.3 asks :func:`importlib.util.find_spec` for it whenever a module
    returns a tensor, 0.3 ms each: a tenth of a small update. What is imported, or noted
    as missing, is not searched for.
    """
    try:
        import_module("pandas")
    except ImportError:
        sys.modules["pandas"] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        if sys.modules["pandas"] is None:
            del sys.modules["pandas"]


class SumOfLosses(OptimizationStepper):
    """One backward and one step on the sum of the ``loss_*`` entries, if it is finite.

    TorchRL 0.14.1's default stepper hands back losses with their graph attached and
    reads the gradient norm back to the host at every step; this one does neither.

    Args:
        autocast_dtype: of the matrix products of the losses. Default: that of the
            parameters.
    """

    def __init__(self, autocast_dtype: torch.dtype | None = None) -> None:
        self.autocast_dtype = autocast_dtype

    def step(self, trainer: TickTrainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """Run one update and return the detached losses and metrics."""
        device = next(trainer.loss_module.parameters()).device.type
        enabled = self.autocast_dtype is not None
        with torch.autocast(device, self.autocast_dtype, enabled=enabled):
            losses = trainer.compute_loss(sub_batch)
        total = sum(value for key, value in losses.items() if key.startswith("loss_"))
        try:
            total.backward()
            return trainer.guard.step(sub_batch, losses.detach())
        finally:
            # Also where this is broken off: the next one must not add to the rest.
            trainer.optimizer.zero_grad(set_to_none=True)

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: the stepper has no state."""
        return {}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Do nothing: the stepper has no state."""


class TickTrainer(Trainer):
    """Abstract base: a trainer that does as many updates as its batch has rows.

    Attributes:
        captured: runs an update in the place of TorchRL's loop, if it is there.
        guard: steps the optimizer.
        termination: whether to stop before the next update.
        description: names the phase.
        rotation: where checkpoints go.
    """

    captured: CapturedUpdate | None = None
    guard: FiniteGuard
    termination = Termination()
    description: str
    rotation: CheckpointRotation
    _progress: dict[str, int]

    @property
    def step(self) -> int:
        """Gradient steps so far, from the run's beginning; the running one counts."""
        return int(self._optim_count)

    def preempt(self, step: int) -> Preempted:
        """Save a run that shall end, between two updates; return what to raise.

        The rest of the tick is done by the run that goes on. The means that it logs are
        over that rest; nothing else differs.

        Args:
            step: the updates that were done.
        """
        self._optim_count = self.collected_frames = step
        self.guard.settle(whole=False)
        if step != self._progress["step"]:
            self.save_trainer(force_save=True, in_turn=False)
        reason = (
            f"{self.description}: stopped by SIGTERM at step {step}; the last "
            f"checkpoint is {self.rotation.latest()}. Run again to go on from there."
        )
        torchrl_logger.warning(reason)
        return Preempted(reason)

    def _stop_if_asked(self) -> None:
        """Raise before an update, which is counted already, if the run shall end."""
        if self.termination.asked:
            raise self.preempt(self._optim_count - 1)

    def _process_optim_batch_hook(self, batch: TensorDictBase | None) -> Any:
        # TorchRL's loop begins an update here. A captured one is not broken off.
        if self.captured is None:
            self._stop_if_asked()
        return super()._process_optim_batch_hook(batch)

    def update(self) -> TensorDictBase:
        """Do one update with its hooks; return the detached losses and metrics.

        TorchRL's loop calls the same three; alone they are what a graph captures.
        """
        batch = self._process_optim_batch_hook(None)
        losses: TensorDictBase = self.optimization_stepper.step(self, batch)
        self._post_optim_hook()
        return losses

    def optim_steps(self, batch: TensorDictBase) -> None:
        """Do the updates of a tick, and log their mean losses."""
        self.optim_steps_per_batch = batch.numel()
        if self.captured is None:
            super().optim_steps(batch)
            return
        self._pre_optim_hook()
        self._pre_epoch_log_hook(batch)
        self._pre_epoch_hook(batch)
        for _ in range(batch.numel()):
            self._optim_count += 1
            self._stop_if_asked()
            self.captured()
        self._post_epoch_log_hook(batch)
        self._post_epoch_hook()
        self._post_optim_complete_log_hook(self._optim_count, self.captured.means())
