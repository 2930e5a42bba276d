"""TorchRL's :class:`~torchrl.trainers.Trainer`, driven by a data set.

TorchRL 0.14.1 has no offline trainer: every trainer asks a collector for frames. Here
the collector is a clock (:class:`GradientSteps`), so that frames count gradient steps
and the trainer's own loop, hooks and optimization stepper are used as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torchrl.checkpoint import CheckpointRotation, GlobalRNGState
from torchrl.data import ReplayBuffer
from torchrl.objectives import LossModule, TargetNetUpdater
from torchrl.record.loggers import Logger

from torchrl_osr.trainers.captured import capture, check_updater
from torchrl_osr.trainers.checkpointing import (
    GeneratorState,
    check_room,
    explained_write_errors,
    load_latest,
    remove_leftovers,
    safe_checkpoint,
    save_step,
)
from torchrl_osr.trainers.finite_guard import FiniteGuard
from torchrl_osr.trainers.gradient_steps import (
    GradientSteps,
    SumOfLosses,
    TickTrainer,
    pandas_settled,
)
from torchrl_osr.trainers.hardware import check_cudagraph
from torchrl_osr.trainers.preemption import sigterm_noted
from torchrl_osr.trainers.value_bounds import ValueBounds

try:
    from tqdm.auto import tqdm
except ImportError as error:
    raise ImportError(
        f"the trainer needs {error.name!r}: pip install torchrl-osr[examples]"
    ) from error


class OfflineTrainer(TickTrainer):
    """Train a loss module on a replay buffer, with evaluation, checkpoints and resume.

    It knows no algorithm: any :class:`~torchrl.objectives.LossModule` whose ``loss_*``
    entries may be summed. A killed run continues from its newest whole checkpoint and
    ends with the same bits as one that was never killed: networks, optimizer, targets,
    the sampler's and the process's random generators and every entry of ``components``
    are restored. (Bit equality is for one machine, one set of libraries and CPU.)

    Args:
        loss_module: what to train.
        optimizer: over the loss module's parameters.
        replay_buffer: sampled once a step, with a generator that the trainer puts in.
        total_steps: gradient steps of the whole run.
        folder: where checkpoints go; created if need be.

    Keyword Args:
        seed: of the sampling. Default 0.
        target_net_updater: stepped after each update. Default: none.
        evaluate: called every ``eval_interval`` steps and at the end; returns
            JSON-compatible results, of which numbers are logged. All are kept in
            ``history``, with their ``"step"``. Default: no evaluation.
        metric: which result decides the best checkpoint, and whether it shall be
            ``"max"`` or ``"min"``. Default ``("score", "max")``.
        components: more state to checkpoint, by name: a transform with a generator,
            observation statistics.
        loggers: TorchRL loggers; all get every number. Default: none.
        log_interval: steps between log entries, which are means over them. Default 200.
        eval_interval: steps between evaluations. Default 5000.
        checkpoint_interval: steps between checkpoints. Default: ``eval_interval``.
        checkpoints_kept: how many of the newest stay, beside the best. Default 2.
        description: names the phase in the progress bar and the logs. Default "train".
        progress: show a progress bar when on a terminal. Default ``True``.
        autocast_dtype: compute the losses' matrix products in this precision
            (``torch.bfloat16``). Default: that of the parameters.
        compile: call the loss module through :func:`torch.compile`, in place. It draws
            other random numbers then. Default ``False``.
        cudagraph: run each update, from the batch to the target networks, as one CUDA
            graph. The hooks ``process_optim_batch`` and ``post_optim`` are in it, see
            :class:`~torchrl_osr.trainers.captured.CapturedUpdate`. Default ``False``.
        nonfinite: what a loss or gradient that is not finite does: ``"stop"`` the run,
            with all that led to it saved, or ``"skip"`` that update, see
            :class:`~torchrl_osr.trainers.finite_guard.FiniteGuard`. Default ``"stop"``.
        bounds: the largest plausible magnitude of a mean, by its name; a word is said
            when it is exceeded for the first time. Default: none.

    Raises:
        ValueError: if ``cudagraph`` or ``nonfinite`` cannot be had.
        FloatingPointError: while training, if a loss or a gradient is not finite.
        Preempted: while training, after SIGTERM, when a checkpoint is written.
        CheckpointError: if a checkpoint in ``folder`` does not fit.
        OSError: if there is no room for the checkpoints.
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
        compile: bool = False,
        cudagraph: bool = False,
        nonfinite: Literal["stop", "skip"] = "stop",
        bounds: Mapping[str, float] | None = None,
    ) -> None:
        intervals = (log_interval, eval_interval, checkpoint_interval or eval_interval)
        device = next(loss_module.parameters()).device
        if cudagraph:
            check_cudagraph(device)
            check_updater(target_net_updater)
        if compile:
            loss_module.compile()
        super().__init__(
            collector=GradientSteps(total_steps, intervals),
            total_frames=total_steps,
            frame_skip=1,
            optim_steps_per_batch=1,
            loss_module=loss_module,
            optimizer=optimizer,
            optimization_stepper=SumOfLosses(autocast_dtype),
            progress_bar=False,
            auto_log_optim_steps=False,
        )
        self.eval_interval, self.checkpoint_interval = intervals[1:]
        self.evaluate, self.metric = evaluate, metric
        self.loggers, self.description = loggers, description
        self.history: list[dict[str, Any]] = []
        self._progress = {"step": 0, "skipped_updates": 0}
        # Not handed to Trainer: it would put the whole data set into checkpoints.
        generator = torch.Generator(device).manual_seed(seed)
        replay_buffer.set_rng(generator)
        self.cudagraph = cudagraph
        self.guard = FiniteGuard(self, nonfinite)
        self._bounds = ValueBounds(bounds or {})
        # What an update draws from, besides the loss.
        self.sampler_generator, self.transform = generator, replay_buffer.transform
        self.register_op("process_optim_batch", lambda _: replay_buffer.sample())
        if target_net_updater is not None:
            self.register_op("post_optim", target_net_updater.step)
        self.register_op("post_optim_complete_log", self._log_losses)
        self.register_op("post_steps_log", self._evaluate)
        self.register_op("post_steps", self._update_bar)
        self.progress = progress

        self.rotation = CheckpointRotation(folder, keep_last=checkpoints_kept)
        self._model_components = ("loss_module", *(components or {}))
        self.checkpoint_of_run = safe_checkpoint(
            loss_module=loss_module,
            optimizer=optimizer,
            sampler=GeneratorState(generator),
            global_rng=GlobalRNGState(),
            history=self.history,
            progress=self._progress,
            **(components or {}),
        )

    @property
    def best_path(self) -> Path:
        """Where the checkpoint with the best evaluation is."""
        return Path(self.rotation.directory) / "best.torchrl"

    def best(self) -> dict[str, Any] | None:
        """Return the best evaluation so far, the first of equals."""
        if not self.history:
            return None
        name, mode = self.metric
        return (max if mode == "max" else min)(self.history, key=lambda row: row[name])

    def train(self) -> None:
        """Run, or continue, to the last step; a finished run returns at once."""
        self.resume()
        self._bar = tqdm(
            total=self.total_frames,
            initial=self.collected_frames,
            desc=self.description,
            unit="step",
            # None: silent where the output is not a terminal.
            disable=None if self.progress else True,
        )
        if self.collected_frames < self.total_frames:
            check_room(self.rotation, self.loss_module, self.optimizer)
        with self._bar, pandas_settled(), sigterm_noted() as self.termination:
            super().train()
        if self.termination.asked:  # in the last evaluation: all is done and saved
            raise self.preempt(self.step)

    def resume(self) -> Path | None:
        """Restore the newest whole checkpoint of the folder, if there is one."""
        self.rotation.directory.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self.rotation.directory)
        path = load_latest(self.checkpoint_of_run, self.rotation)
        step = self._progress["step"]
        self.collected_frames = self._optim_count = self.collector.step = step
        # A checkpoint from before updates could be skipped has no count of them.
        self.guard.restart(self._progress.get("skipped_updates", 0))
        # Anew: the optimizer's state may be other tensors now.
        if self.cudagraph:
            self.captured = capture(self, self.sampler_generator, self.transform)
        return path

    def save_trainer(self, force_save: bool = False, *, in_turn: bool = True) -> None:
        """Write a checkpoint where one is due, at the end, and where a run stops."""
        step, interval = self.collected_frames, self.checkpoint_interval
        if force_save or step % interval == 0:
            self._progress.update(step=step, skipped_updates=self.guard.skipped)
            run, rotation = self.checkpoint_of_run, self.rotation
            save_step(run, rotation, step, interval=interval, in_turn=in_turn)

    def _log_losses(self, _: int, losses: TensorDictBase) -> None:
        """Log the means over a tick; one copy to the host for all of them."""
        share = self.guard.settle()
        names = list(losses.keys())
        values = torch.stack([losses[name].float() for name in names]).tolist()
        means = {name: share * value for name, value in zip(names, values, strict=True)}
        self._bounds.check(means, f"{self.description}, step {self.collected_frames}")
        if self.guard.skips:
            means["skipped_updates"] = self.guard.skipped
        self._send(means)

    def _evaluate(self, _: TensorDictBase) -> None:
        step = self.collected_frames
        due = step % self.eval_interval == 0 or step == self.total_frames
        if self.evaluate is None or not due:
            return
        results = {"step": step, **self.evaluate()}
        self.history.append(results)
        numbers = {
            name: value for name, value in results.items()
            if isinstance(value, (int, float)) and name != "step"
        }  # fmt: skip
        self._send(numbers)
        name, _mode = self.metric
        self._bar.set_postfix_str(f"{name} {results[name]:.4g}")
        if self.best() is results:
            with explained_write_errors(self.rotation):
                self.checkpoint_of_run.save(
                    self.best_path,
                    components=self._model_components,
                    metadata={"step": step, name: results[name]},
                )

    def _update_bar(self) -> None:
        self._bar.update(self.collected_frames - self._bar.n)

    def _send(self, numbers: Mapping[str, float]) -> None:
        step = self.collected_frames
        with explained_write_errors(self.rotation, "the log"):
            for logger in self.loggers:
                for name, value in numbers.items():
                    logger.log_scalar(f"{self.description}/{name}", value, step=step)
