"""Offline version of TorchRL's :class:`~torchrl.trainers.Trainer`.

Every trainer of TorchRL 0.14.1 asks a collector for frames. Here the collector counts
gradient steps, and TorchRL's own loop and hooks are used as they are.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from signal import Signals
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import PrioritizedSampler, ReplayBuffer
from torchrl.record.loggers import CSVLogger, Logger
from torchrl.trainers import OptimizationStepper, Trainer

from torchrl_osr._files import finite_or_none
from torchrl_osr.fast import FastUpdate, NonfiniteError
from torchrl_osr.trainers.checkpoints import (
    Checkpoints,
    GlobalGenerators,
    SamplerState,
)
from torchrl_osr.trainers.interruption import EXIT_CODES, Interrupted, signals_noted
from torchrl_osr.trainers.progress import progress_bar

log = logging.getLogger(__name__)

Hook = tuple[str, Callable[..., Any]]
"""A place in TorchRL's loop and a function, see ``Trainer.register_op``."""


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of a run, and its interval.

    Attributes:
        run: returns JSON-compatible results by name; its numbers are logged.
        interval: steps between two evaluations. Default 5000.
        metric: the result that decides the best checkpoint. Default ``"score"``.
        best: whether the ``"max"`` (default) or the ``"min"`` is best.
    """

    run: Callable[[], dict[str, Any]]
    interval: int = 5000
    metric: str = "score"
    best: Literal["max", "min"] = "max"


class OfflineTrainer(Trainer):
    """Train on a replay buffer, with evaluation, checkpoints and resume.

    One step is a batch and one ``update`` on it. A killed run continues from its newest
    whole checkpoint: networks, optimizer, targets, random generators, the sampler's
    order or priorities, and ``components``. On a CPU with the same libraries it ends
    with the same bits as one that was never killed, if the buffer does not prefetch.
    TorchRL's ``save_trainer`` and ``load_from_file`` do not apply.

    Args:
        update: one gradient step; :class:`~torchrl_osr.fast.FastUpdate` makes it of
            a loss module, an optimizer and a target updater.
        replay_buffer: sampled once a step, with a generator that the trainer puts in.
            The priorities of a prioritised buffer are updated after each step.
        total_steps: gradient steps of the whole run.
        folder: where checkpoints go; created if needed.

    Keyword Args:
        seed: of the sampling. Default 0.
        hooks: pairs of a place in TorchRL's loop and a function, see
            :meth:`~torchrl.trainers.Trainer.register_op`. They run before the
            checkpoint (``post_steps``) and the evaluation (``post_steps_log``).
        components: more state to checkpoint, by name: a transform with a generator, a
            schedule of learning rates or coefficients, an average of the weights.
        evaluation: run before the first step, at its interval and at the end, after the
            checkpoint. The results are in ``history``. Default: none.
        checkpoint_interval: in steps. Default: that of the evaluation, or 5000.
        checkpoints_kept: regular ones; the newest and the best stay too. Default 2.
        loggers: TorchRL loggers; all get every number. Default: none.
        log_interval: most steps between log entries, which are means. Default 200.
        description: name of the phase in progress bar and logs. Default "train".
        progress: show a progress bar on a terminal; elsewhere a line is logged every
            half minute. Default ``True``.

    Raises:
        ValueError: if the folder's checkpoint is beyond ``total_steps``.
        FloatingPointError: if a loss or a gradient is not finite.
        Interrupted: after SIGTERM, SIGHUP or Ctrl-C, when a checkpoint is written.
        CheckpointError: if a checkpoint in ``folder`` does not fit.
    """

    def __init__(
        self,
        update: FastUpdate,
        replay_buffer: ReplayBuffer,
        total_steps: int,
        folder: Path | str,
        *,
        seed: int = 0,
        hooks: Sequence[Hook] = (),
        components: Mapping[str, Any] | None = None,
        evaluation: Evaluation | None = None,
        checkpoint_interval: int | None = None,
        checkpoints_kept: int = 2,
        loggers: Sequence[Logger] = (),
        log_interval: int = 200,
        description: str = "train",
        progress: bool = True,
    ) -> None:
        own = [] if evaluation is None else [evaluation.interval]
        if checkpoint_interval is None:
            checkpoint_interval = own[0] if own else 5000
        intervals = [log_interval, checkpoint_interval, *own]
        super().__init__(
            collector=_StepCounter(total_steps, intervals),
            total_frames=total_steps,
            frame_skip=1,
            optim_steps_per_batch=1,
            loss_module=update.loss_module,
            optimizer=update.optimizer,
            optimization_stepper=_Stepper(),
            progress_bar=False,
            auto_log_optim_steps=False,
        )
        storage = getattr(replay_buffer, "storage", None)  # is sampled where it is
        device = getattr(storage, "device", None)
        device = device or next(update.loss_module.parameters()).device
        generator = torch.Generator(device).manual_seed(seed)
        replay_buffer.set_rng(generator)
        # The buffer is not handed to TorchRL's trainer, which would put the whole data
        # set into checkpoints.
        self.update, self.buffer, self.evaluation = update, replay_buffer, evaluation
        # TorchRL's losses would make theirs, and with it more state, in the first call.
        for module in update.loss_module.modules():
            if getattr(module, "default_value_estimator", None) is not None:
                module.value_estimator  # noqa: B018
        self.loggers, self.description = loggers, description
        self.history: list[dict[str, Any]] = []
        self.failed_evaluations: dict[int, str] = {}
        self._saved = {"step": 0}
        self._started = Path(folder).is_dir()  # or no logged row is this run's
        self._progress = progress
        self._signals: list[Signals] = []
        self._model = {"loss_module": update.loss_module, **(components or {})}
        parts = dict(
            **self._model,
            optimizer=update.optimizer,
            sampler=SamplerState(replay_buffer, generator),
            global_rng=GlobalGenerators(),
            history=self.history,
            progress=self._saved,
        )
        if hasattr(update.target_updater, "counter"):  # of a HardUpdate
            parts["target_updater"] = update.target_updater
        self.checkpoints = Checkpoints(
            folder, parts, checkpoint_interval, checkpoints_kept
        )
        self.register_op("process_optim_batch", self._sample)
        self.register_op("post_optim_complete_log", self._log_losses)
        for place, hook in hooks:
            self.register_op(place, hook)
        if isinstance(getattr(replay_buffer, "sampler", None), PrioritizedSampler):
            self.register_op("post_optim_log", self._update_priority)
        # The checkpoint is first: if the evaluation ends the process, no step is lost.
        self.register_op("post_steps", self._save_if_due)
        self.register_op("post_steps_log", self._evaluate_if_due)

    @property
    def step(self) -> int:
        """Gradient steps since the start of the run, with the current one."""
        return int(self._optim_count)

    def best(self) -> dict[str, Any] | None:
        """Return the best evaluation so far, the first of equals.

        Evaluations without a value do not count, and that of the untrained networks
        only if it is the only one.
        """
        if self.evaluation is None:
            return None
        name = self.evaluation.metric
        choose = {"max": max, "min": min}[self.evaluation.best]
        rows = [row for row in self.history if row[name] is not None]
        rows = [row for row in rows if row["step"]] or rows
        return choose(rows, key=lambda row: row[name], default=None)

    def train(self) -> None:
        """Run, or continue, to the last step; a finished run returns at once."""
        self.resume()
        if self.step == self.total_frames and self._is_evaluated():
            return
        # tensordict 0.14.3 searches the disk for pandas in every module call until that
        # is imported: 0.3 ms each, a tenth of a small update.
        with suppress(ImportError):
            import_module("pandas")
        shown = progress_bar(
            self.description, self.total_frames, first=self.step, bar=self._progress
        )
        with shown as self._bar, signals_noted() as self._signals:
            self._evaluate_if_due()  # a kill may fall between checkpoint and evaluation
            super().train()
        if self._signals:  # in the last evaluation
            raise self._interrupted(self.step)

    def resume(self) -> Path | None:
        """Restore the newest whole checkpoint of the folder, if there is one.

        Rows that a CSV logger wrote after it are cut off, and those of an evaluation at
        its step whose result it lacks: these are repeated.
        """
        path = self.checkpoints.restore()
        if path is None and self.step:
            raise RuntimeError("no checkpoint yet: build networks and trainer again.")
        step = self._saved["step"]
        if step > self.total_frames:
            raise ValueError(
                f"{path} is at step {step}, beyond the {self.total_frames} steps of "
                "this run: ask for at least as many, or start in another folder."
            )
        if path and step < self.total_frames:
            log.info(f"{self.description}: goes on from {path}")
        self.collected_frames = self._optim_count = self.collector.step = step
        self.update.count = step
        repeated = set[str]() if self._is_evaluated() else set().union(*self.history)
        for logger in self.loggers:
            if self._started and isinstance(logger, CSVLogger):
                folder = Path(logger.experiment.log_dir, "scalars", self.description)
                cut_back(folder, step if path else -1, repeated)
        return path

    def optim_steps(self, batch: TensorDictBase) -> None:
        """Do as many updates as the counter's batch has rows."""
        self.optim_steps_per_batch = batch.numel()
        super().optim_steps(batch)

    def _save_if_due(self) -> None:
        step = self.collected_frames
        if step % self.checkpoints.interval == 0 or step == self.total_frames:
            self._save(step)

    def _save(self, step: int) -> None:
        self._saved["step"] = step
        self.checkpoints.save(step)

    def _sample(self, _: TensorDictBase) -> TensorDictBase:
        """Return the next batch; TorchRL's loop has counted this update."""
        if self._signals:
            raise self._interrupted(self.step - 1)
        return self.buffer.sample()

    def _update_priority(self, batch: TensorDictBase) -> None:
        # TorchRL 0.14.1 gives rows without a new priority the largest there is.
        if batch.get(self.buffer.priority_key, None) is not None:
            self.buffer.update_tensordict_priority(batch)

    def _interrupted(self, step: int) -> Interrupted:
        """Save a run that was asked to end after a step; return what to raise.

        The continued run logs means over the rest of the log interval.
        """
        number = self._signals[0]
        self._optim_count = self.collected_frames = step
        if step != self._saved["step"]:
            self._save(step)
        reason = (
            f"{self.description}: stopped by {number.name} at step {step}; the last "
            f"checkpoint is {self.checkpoints.latest()}. Resume to continue."
        )
        log.warning(reason)
        return Interrupted(reason, EXIT_CODES[number])

    def _log_losses(self, _: int, losses: TensorDictBase) -> None:
        """Log the means over a log interval; one copy to the host for all of them."""
        values = torch.stack([each.float().mean() for each in losses.values()]).tolist()
        self._log_numbers(dict(zip(losses.keys(), values, strict=True)))
        self._bar.update(self.collected_frames - self._bar.n)

    def _log_numbers(self, numbers: Mapping[str, float]) -> None:
        named = {f"{self.description}/{name}": each for name, each in numbers.items()}
        for logger in self.loggers:
            logger.log_metrics(named, step=self.collected_frames)

    def _is_evaluated(self) -> bool:
        steps = [row["step"] for row in self.history]
        return self.evaluation is None or self.collected_frames in steps

    def _evaluate_if_due(self, _: TensorDictBase | None = None) -> None:
        """Evaluate at the interval and at the end, once; keep the best model."""
        step, evaluation = self.collected_frames, self.evaluation
        if evaluation is None or self._is_evaluated():
            return
        if step % evaluation.interval and step != self.total_frames:
            return
        try:
            results = finite_or_none({**evaluation.run(), "step": step})
            # As a checkpoint restores them: sorted, lists for tuples.
            results = json.loads(json.dumps(results, sort_keys=True))
            metric = results[evaluation.metric]
        except Exception as error:
            if not self.history:  # no work is lost yet, and the next would fail alike
                raise
            self.failed_evaluations[step] = f"{type(error).__name__}: {error}"
            log.exception(f"{self.description}: the evaluation of step {step} failed")
            return
        self.history.append(results)
        text = "-" if metric is None else f"{metric:.4g}"
        self._bar.set_postfix_str(f"{evaluation.metric} {text}")
        if self.best() is results:
            metadata = {"step": step, evaluation.metric: metric}
            path = self.checkpoints.best_path
            self.checkpoints.write(path, components=self._model, metadata=metadata)
        numbers = {k: v for k, v in results.items() if isinstance(v, (int, float))}
        del numbers["step"]
        self._log_numbers(numbers)
        if step and step == self._saved["step"]:
            self.checkpoints.save(step)  # once more, with the result


class _StepCounter:
    """Dummy collector. A batch of length n stands for n gradient steps.

    A batch ends wherever something is due: a log entry, an evaluation, a checkpoint.
    """

    init_random_frames = 0

    def __init__(self, total: int, intervals: Sequence[int]) -> None:
        self.total, self.intervals, self.step = total, intervals, 0

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.step < self.total:
            due = [(self.step // each + 1) * each for each in self.intervals]
            steps = min(*due, self.total) - self.step
            self.step += steps
            yield TensorDict({}, [steps])

    def shutdown(self) -> None:
        """Do nothing: the trainer calls this on its collector."""


class _Stepper(OptimizationStepper):
    """Pass a batch to the trainer's update."""

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        try:
            return trainer.update(sub_batch)
        except NonfiniteError as error:
            raise FloatingPointError(
                f"{trainer.description}: step {trainer.step}: {error}. Look at the "
                "data's rewards and states, or lower the learning rates."
            ) from error


def cut_back(folder: Path, step: int, repeated: Set[str] = frozenset()) -> None:
    """Cut off the rows ``step,value`` that a ``CSVLogger`` wrote after a step.

    Of the numbers that are logged at the step once more, ``repeated``, its row goes.
    A last line that a kill left unfinished goes, too.
    """
    for path in folder.rglob("*.csv"):  # of "eval/score" in a folder
        last = step - (path.relative_to(folder).as_posix()[:-4] in repeated)
        with path.open("r+b") as file:
            kept = 0
            for line in file:
                number, end = line.split(b",")[0], line[-1:]
                if end != b"\n" or not number.isdigit() or int(number) > last:
                    break
                kept += len(line)
            file.truncate(kept)


def divergence_warning(largest_reward: float, gamma: float) -> Hook:
    r"""Return a trainer's hook that warns once of values that diverge.

    No policy's value is above :math:`\max|r| / (1 - \gamma)`. Learned values may be, by
    the conservative penalty and by errors, but not ten times as much.
    """
    limit = 10 * largest_reward / (1 - gamma) if gamma < 1 else math.inf
    watched = {"pred_value", "target_value"}

    def warn(step: int, losses: TensorDictBase) -> None:
        for name in sorted(watched.intersection(losses.keys())):
            value = float(losses[name])
            if abs(value) > limit:
                watched.remove(name)
                log.warning(
                    f"Step {step}: the mean {name} is {value:.4g}; a magnitude above "
                    f"{limit:.4g} means that the values diverge. Lower the critics' "
                    "learning rate, or check the rewards and the discount."
                )

    return "post_optim_complete_log", warn
