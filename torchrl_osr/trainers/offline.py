"""TorchRL's :class:`~torchrl.trainers.Trainer`, driven by a data set.

TorchRL 0.14.1 has no offline trainer: every trainer asks a collector for frames. Here
the collector is a clock, so that frames count gradient steps, and the trainer's own
loop, hooks and optimization stepper are used as they are.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.checkpoint import GlobalRNGState
from torchrl.data import ReplayBuffer
from torchrl.objectives import LossModule, TargetNetUpdater
from torchrl.record.loggers import CSVLogger, Logger
from torchrl.trainers import OptimizationStepper, Trainer

from torchrl_osr._checks import check_choice, check_positive
from torchrl_osr._files import finite_or_none
from torchrl_osr.fast import fuse_critics
from torchrl_osr.fast.traced_update import LossGradients
from torchrl_osr.trainers.checkpoints import Checkpoints, GeneratorState
from torchrl_osr.trainers.csv_rows import cut_back
from torchrl_osr.trainers.cudagraph import captured, check_capturable
from torchrl_osr.trainers.hardware import check_cudagraph
from torchrl_osr.trainers.interruption import (
    EXIT_CODES,
    Interrupted,
    StopRequest,
    signals_noted,
)
from torchrl_osr.trainers.nonfinite import NonfiniteCheck
from torchrl_osr.trainers.progress import Progress

log = logging.getLogger(__name__)


class StepClock:
    """Stands in for a collector: an empty batch of n rows is n gradient steps.

    A batch ends wherever something is due: a log entry, an evaluation, a checkpoint.

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


class SumOfLosses(OptimizationStepper):
    """One backward and one step on the sum of the ``loss_*`` entries, if it is finite.

    TorchRL 0.14.1's default stepper hands back losses with their graph attached and
    reads the gradient norm back to the host at every step; this one does neither.

    Args:
        check: steps the optimizer, unless a loss or a gradient is not finite.
        gradients: maps a batch to its detached losses, and puts the gradients of their
            sum where the optimizer looks.
        between: the same for the updates between those of ``gradients``. Default: those
            are all.
        delay: every how many updates ``gradients`` has its turn. Default 1.
    """

    def __init__(
        self,
        check: NonfiniteCheck,
        gradients: LossGradients,
        between: LossGradients | None = None,
        delay: int = 1,
    ) -> None:
        self.check, self.gradients = check, gradients
        self.between, self.delay = between, delay
        self.run: Callable[[TensorDictBase], TensorDictBase] = self.update

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """Run one update and return the detached losses and metrics."""
        if self.between is None or self.is_whole(trainer):
            return self.run(sub_batch)
        return self.update(sub_batch, self.between)

    def is_whole(self, trainer: Trainer) -> bool:
        """Whether the running update is one of ``gradients``."""
        count: int = trainer._optim_count
        return count % self.delay == 0

    def update(
        self, batch: TensorDictBase, gradients: LossGradients | None = None
    ) -> TensorDictBase:
        """Losses of a batch, their gradients, and the optimizer's step."""
        try:
            losses = (gradients or self.gradients)(batch)
            self.check.step(batch, losses)
            return losses
        finally:
            # Also after an error: the next backward must not add to these gradients.
            self.check.optimizer.zero_grad(set_to_none=True)

    def capture(self) -> None:
        """Let updates be replayed as a CUDA graph from now on."""
        self.run = captured(self.update, self.check.loss_module)


class OfflineTrainer(Trainer):
    """Train a loss module on a replay buffer, with evaluation, checkpoints and resume.

    It knows no algorithm: any :class:`~torchrl.objectives.LossModule` whose ``loss_*``
    entries may be summed. One step is: sample a batch, compute the losses, backward on
    their sum, optimizer, target networks; TorchRL's hooks (:meth:`register_op`) come in
    between.

    A killed run continues from its newest whole checkpoint and ends with the same bits
    as one that was never killed (on the same machine and libraries, on a CPU):
    networks, optimizer, targets, random generators and ``components`` are restored.

    Args:
        loss_module: what to train.
        optimizer: over the loss module's parameters.
        replay_buffer: sampled once a step, with a generator that the trainer puts in.
        total_steps: gradient steps of the whole run.
        folder: where checkpoints go; made if need be.

    Keyword Args:
        seed: of the sampling. Default 0.
        target_net_updater: stepped after each update. Default: none.
        policy_delay: ``policy_params`` and the target networks move only at every
            ``policy_delay``-th update, as in TD3. At the other updates they and their
            optimizer's state stay as they are. Default 1.
        policy_params: see there; needed with a ``policy_delay`` above 1.
        evaluate: returns JSON-compatible results, of which numbers are logged and all
            are kept in ``history``, with their ``"step"``. Called before the first step
            of a new run, every ``eval_interval`` steps and at the end. Default: none.
        metric: which result decides the best checkpoint, and whether ``"max"`` or
            ``"min"`` is best. Default ``("score", "max")``.
        components: more state to checkpoint, by name: a transform with a generator,
            observation statistics, a sampler without replacement.
        loggers: TorchRL loggers; all get every number. Default: none.
        log_interval: steps between log entries, which are means over them. Default 200.
        eval_interval: steps between evaluations. Default 5000.
        checkpoint_interval: steps between checkpoints. Default: ``eval_interval``.
        checkpoints_kept: how many of the newest regular ones stay, beside the newest of
            all and the best. Default 2.
        description: names the phase in the progress bar and the logs. Default "train".
        progress: show a progress bar when on a terminal. Without one, a line is logged
            every half minute. Default ``True``.
        autocast_dtype: compute the losses' matrix products in this precision
            (``torch.bfloat16``). Default: that of the parameters.
        record: repeat a recording of the losses' tensor operations, and of their
            gradients', from the 101st update on: the same bits in less time, on a CPU.
            Python code in the losses, such as a hook, is not run again. Default
            ``False``.
        compile: call the loss module through :func:`torch.compile`, in place. It draws
            other random numbers then. Default ``False``.
        cudagraph: replay each update, from the batch to the optimizer's step, as one
            CUDA graph. Default ``False``.
        value_limits: largest plausible magnitude of a logged mean, by its name; warns
            once for each that is exceeded. Default: none.

    Raises:
        ValueError: if an option is unknown or needs another device or optimizer; while
            training, if the folder's checkpoint is beyond ``total_steps``, or the
            results of ``evaluate`` lack the metric.
        FloatingPointError: while training, if a loss or a gradient is not finite; the
            batch that caused it is saved beside the checkpoints.
        Interrupted: while training, after SIGTERM, SIGHUP or Ctrl-C, when a checkpoint
            is written.
        CheckpointError: if a checkpoint in ``folder`` does not fit.
        OSError: if there is no room for the checkpoints, or their folder is removed.
    """

    def __init__(
        self,
        loss_module: LossModule,
        optimizer: torch.optim.Optimizer,
        replay_buffer: ReplayBuffer,
        total_steps: int,
        folder: Path | str,
        *,
        seed: int = 0,
        target_net_updater: TargetNetUpdater | None = None,
        policy_delay: int = 1,
        policy_params: Sequence[nn.Parameter] = (),
        evaluate: Callable[[], dict[str, Any]] | None = None,
        metric: tuple[str, Literal["min", "max"]] = ("score", "max"),
        components: Mapping[str, Any] | None = None,
        loggers: Sequence[Logger] = (),
        log_interval: int = 200,
        eval_interval: int = 5000,
        checkpoint_interval: int | None = None,
        checkpoints_kept: int = 2,
        description: str = "train",
        progress: bool = True,
        autocast_dtype: torch.dtype | None = None,
        record: bool = False,
        compile: bool = False,
        cudagraph: bool = False,
        value_limits: Mapping[str, float] | None = None,
    ) -> None:
        device = next(loss_module.parameters()).device
        if checkpoint_interval is None:
            checkpoint_interval = eval_interval
        clock = StepClock(
            total_steps, (log_interval, eval_interval, checkpoint_interval)
        )
        self._metric, best_is = metric
        check_choice("metric[1]", best_is, ("max", "min"))
        self._choose = max if best_is == "max" else min
        check_positive("policy_delay", policy_delay, minimum=1)
        if cudagraph:
            check_cudagraph(device, policy_delay)
            check_capturable(optimizer)
        if compile:
            loss_module.compile()
        elif device.type == "cpu":
            fuse_critics(loss_module)

        # Not handed to Trainer: it would put the whole data set into checkpoints.
        generator = torch.Generator(device).manual_seed(seed)
        replay_buffer.set_rng(generator)
        components = components or {}
        self.history: list[dict[str, Any]] = []
        self._saved = {"step": 0}
        self._model_components = ("loss_module", *components)
        own = {
            "loss_module": loss_module,
            "optimizer": optimizer,
            "sampler": GeneratorState(generator),
            "global_rng": GlobalRNGState(),
            "history": self.history,
            "progress": self._saved,
        }
        if taken := sorted(own.keys() & components):
            raise ValueError(f"components have names of the trainer's own: {taken}.")
        self.checkpoints = Checkpoints(
            folder,
            own | dict(components),
            interval=checkpoint_interval,
            kept=checkpoints_kept,
        )
        self.nonfinite_check = NonfiniteCheck(
            loss_module, optimizer, self.checkpoints, description
        )
        record = record and not (compile or cudagraph)
        new_gradients = partial(
            LossGradients, loss_module, autocast_dtype, record=record
        )
        between = None
        if policy_delay > 1:
            delayed = set(policy_params)
            rest = [each for each in loss_module.parameters() if each not in delayed]
            if not delayed:
                raise ValueError(
                    f"policy_delay={policy_delay} needs the parameters that it delays: "
                    "give policy_params."
                )
            if not rest:
                raise ValueError(
                    f"policy_delay={policy_delay} leaves nothing to train in between, "
                    "without critics: use policy_delay=1 (optim.policy_delay=1)."
                )
            between = new_gradients(parameters=rest)
        self._stepper = SumOfLosses(
            self.nonfinite_check, new_gradients(), between, policy_delay
        )
        super().__init__(
            collector=clock,
            total_frames=total_steps,
            frame_skip=1,
            optim_steps_per_batch=1,
            loss_module=loss_module,
            optimizer=optimizer,
            optimization_stepper=self._stepper,
            progress_bar=False,
            auto_log_optim_steps=False,
        )
        self.buffer, self.cudagraph = replay_buffer, cudagraph
        self.evaluate, self.eval_interval = evaluate, eval_interval
        self.loggers, self.description = loggers, description
        self._limits = dict(value_limits or {})
        self._progress = Progress(description, total_steps, progress)
        self._stop_request = StopRequest()

        self.register_op("process_optim_batch", self._sample)
        if target_net_updater is not None:
            self.register_op(
                "post_optim", self._move_targets, updater=target_net_updater
            )
        self.register_op("post_optim_complete_log", self._log_losses)
        self.register_op("post_steps_log", self._evaluate_if_due)

    @property
    def step(self) -> int:
        """Gradient steps since the run's beginning; the running one counts."""
        return int(self._optim_count)

    def best(self) -> dict[str, Any] | None:
        """Best evaluation so far, the first of equals; one without a value is none."""
        rows = [row for row in self.history if row[self._metric] is not None]
        if not rows:
            return None
        return self._choose(rows, key=lambda row: row[self._metric])

    def train(self) -> None:
        """Run, or continue, to the last step; a finished run returns at once."""
        self.resume()
        if self.step == self.total_frames and self._is_evaluated():
            return
        self.checkpoints.check_room(self.loss_module, self.optimizer)
        if self.cudagraph:  # only now: resuming has replaced the optimizer's tensors
            self._stepper.capture()
        # tensordict 0.14.3 searches the disk for pandas in every module call until that
        # is imported: 0.3 ms each, a tenth of a small update.
        with suppress(ImportError):
            import_module("pandas")
        shown = self._progress.shown(self.step)
        with shown, signals_noted() as self._stop_request:
            if not self.history:
                self._evaluate()
            super().train()
            if not self._is_evaluated():  # the last checkpoint is of a longer run
                self._evaluate()
                self._save(self.step)
        if self._stop_request.signal is not None:  # in the last evaluation
            raise self._interrupted(self.step)

    def _is_evaluated(self) -> bool:
        """Whether there is, or need be, no evaluation at this step any more."""
        steps = [row["step"] for row in self.history]
        return self.evaluate is None or self.step in steps

    def resume(self) -> Path | None:
        """Restore the newest whole checkpoint of the folder, if there is one.

        What a CSV logger wrote after it is cut off: these steps are done once more.
        """
        path = self.checkpoints.restore()
        step = self._saved["step"]
        if step > self.total_frames:
            raise ValueError(
                f"{path} is at step {step}, beyond the {self.total_frames} steps of "
                "this run: ask for at least as many, or start in another folder."
            )
        for logger in self.loggers:
            if isinstance(logger, CSVLogger):
                folder = Path(logger.experiment.log_dir, "scalars", self.description)
                cut_back(folder, step if path else -1)
        if path and step < self.total_frames:
            log.info(f"{self.description}: goes on from {path}")
        self.collected_frames = self._optim_count = self.collector.step = step
        self.nonfinite_check.restart(step)
        return path

    def optim_steps(self, batch: TensorDictBase) -> None:
        """Do as many updates as the clock's batch has rows, and log their means."""
        self.optim_steps_per_batch = batch.numel()
        super().optim_steps(batch)

    def save_trainer(self, force_save: bool = False) -> None:
        """Write a checkpoint where one is due, and at the end."""
        step = self.collected_frames
        if force_save or step % self.checkpoints.interval == 0:
            self._save(step)

    def _save(self, step: int) -> None:
        self._saved["step"] = step
        self.checkpoints.save(step)

    def _sample(self, _: TensorDictBase) -> TensorDictBase:
        """Next batch; TorchRL's loop begins an update here, having counted it."""
        if self._stop_request.signal is not None:
            raise self._interrupted(self.step - 1)
        batch: TensorDictBase = self.buffer.sample()
        return batch

    def _move_targets(self, updater: TargetNetUpdater) -> None:
        if self._stepper.is_whole(self):
            updater.step()

    def _interrupted(self, step: int) -> Interrupted:
        """Save a run that was asked to end after a step; return what to raise.

        The continued run logs means over the rest of the log interval.
        """
        number = self._stop_request.signal
        assert number is not None
        self._optim_count = self.collected_frames = step
        self.nonfinite_check.settle()
        if step != self._saved["step"]:
            self._save(step)
        reason = (
            f"{self.description}: stopped by {number.name} at step {step}; the last "
            f"checkpoint is {self.checkpoints.latest()}. Run again to continue."
        )
        log.warning(reason)
        return Interrupted(reason, EXIT_CODES[number])

    def _log_losses(self, _: int, losses: TensorDictBase) -> None:
        """Log the means over a log interval; one copy to the host for all of them."""
        self.nonfinite_check.settle()
        names = list(losses.keys())
        values = torch.stack([losses[name].float() for name in names]).tolist()
        means = dict(zip(names, values, strict=True))
        self._warn_of_divergence(means)
        self._send(means)
        self._progress.update(self.collected_frames)

    def _warn_of_divergence(self, means: Mapping[str, float]) -> None:
        """Warn once of each mean that exceeds its limit."""
        for name in [each for each in self._limits if each in means]:
            if abs(means[name]) > self._limits[name]:
                log.warning(
                    f"{self.description}, step {self.collected_frames}: the mean "
                    f"{name} is {means[name]:.4g}; a magnitude above "
                    f"{self._limits.pop(name):.4g} means that the values diverge. "
                    "Lower the critics' learning rate (optim.qvalue_lr), or check the "
                    "rewards and the discount. The run continues."
                )

    def _evaluate_if_due(self, _: TensorDictBase) -> None:
        step = self.collected_frames
        if step % self.eval_interval == 0 or step == self.total_frames:
            self._evaluate()

    def _evaluate(self) -> None:
        """Evaluate, log the numbers, and save the best model so far."""
        if self.evaluate is None:
            return
        step, name = self.collected_frames, self._metric
        results = {"step": step, **self.evaluate()}
        if name not in results:
            raise ValueError(
                f"evaluate() returned {', '.join(results.keys() - {'step'})}, without "
                f"the {name!r} that decides the best checkpoint: name one of its "
                "results, as in metric=('score', 'max')."
            )
        # As a checkpoint restores them: sorted, lists for tuples.
        results = json.loads(json.dumps(finite_or_none(results), sort_keys=True))
        self.history.append(results)
        numbers = {
            key: value for key, value in results.items()
            if isinstance(value, (int, float)) and key != "step"
        }  # fmt: skip
        self._send(numbers)
        metric = results[name]
        self._progress.result(
            step, f"{name} {'-' if metric is None else f'{metric:.4g}'}"
        )
        if self.best() is results:
            metadata = {"step": step, name: metric}
            self.checkpoints.save_best(self._model_components, metadata)

    def _send(self, numbers: Mapping[str, float]) -> None:
        step = self.collected_frames
        self.checkpoints.check_folder()
        with self.checkpoints.write_errors_explained("the log"):
            for logger in self.loggers:
                for name, value in numbers.items():
                    logger.log_scalar(f"{self.description}/{name}", value, step=step)


def largest_value(largest_reward: float, gamma: float) -> float:
    r"""Magnitude that learned values exceed only where they diverge.

    No policy's value is above :math:`\max|r| / (1 - \gamma)`, the discounted sum of the
    largest reward for ever. Learned values may be: the conservative penalty pushes them
    down, and errors are bootstrapped. Ten times as much is neither.

    Args:
        largest_reward: largest magnitude of a reward in the data.
        gamma: discount factor; with 1 there is no such magnitude.

    Examples:
        >>> from torchrl_osr.trainers import largest_value
        >>> round(largest_value(2.0, 0.99))
        2000
    """
    return 10 * largest_reward / (1 - gamma) if gamma < 1 else math.inf
