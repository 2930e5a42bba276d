"""Several runs trained at once: each an ordinary one, but for one update for all.

On a GPU an update of small networks takes as long as it takes to launch it. The members
of a population share the launches: their losses are one call, their gradients one
backward pass. Everything else, from the batch to the checkpoint, each does for itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tqdm.auto import tqdm

from torchrl_osr.trainers.captured import CapturedUpdate, generators_of, networks_of
from torchrl_osr.trainers.checkpointing import check_room
from torchrl_osr.trainers.gradient_steps import SumOfLosses, pandas_settled
from torchrl_osr.trainers.member_noise import OwnRandomness
from torchrl_osr.trainers.offline import OfflineTrainer
from torchrl_osr.trainers.preemption import Preempted, Termination, sigterm_noted
from torchrl_osr.trainers.vectorized_loss import (
    differences,
    vectorized_loss,
)


class PlainUpdate:
    """Runs an update as it is; otherwise like CapturedUpdate."""

    def __init__(self, update: Callable[[], TensorDictBase]) -> None:
        self._update = update
        self._totals: Any = 0.0
        self._calls = 0

    def __call__(self) -> None:
        """Do one update."""
        self._totals = self._update() + self._totals
        self._calls += 1

    def means(self) -> TensorDictBase:
        """Return the mean losses and metrics of the calls since the last time."""
        means: TensorDictBase = self._totals / self._calls
        self._totals, self._calls = 0.0, 0
        return means


class PopulationTrainer:
    """Train several :class:`OfflineTrainer` at once, in one update.

    Every member keeps its batches, perturbations, learning rates, targets, logs,
    evaluations and checkpoints, and draws the numbers that it would draw alone. It ends
    with the numbers of its single run, up to the order in which a batched product adds;
    its checkpoints are a single run's, which may be continued alone, or in another
    population. Members that were killed at different steps are continued from there:
    those behind catch up first.

    Args:
        members: alike up to seeds, weights of losses, perturbations, learning rates and
            targets.
        randomness: of each, from where it was built.

    Raises:
        ValueError: if members differ in what one update must have in common.
        FloatingPointError: while training, naming the member whose loss or gradient is
            not finite.
        Preempted: while training, after SIGTERM, when all members are saved.
        CheckpointError: if a checkpoint does not fit.
        OSError: if there is no room for a member's checkpoints.
    """

    def __init__(
        self, members: Sequence[OfflineTrainer], randomness: Sequence[OwnRandomness]
    ) -> None:
        for index, member in enumerate(members):
            _check_member(members[0], member, index)
        self.members, self.randomness = members, randomness
        self._device = next(members[0].loss_module.parameters()).device
        self._noise = [own.generator(self._device) for own in randomness]
        self._group: list[int] = []

    def train(self) -> None:
        """Run, or continue, all members to the last step."""
        with pandas_settled(), sigterm_noted() as termination, ExitStack() as bars:
            for index, own in enumerate(self.randomness):
                member = self.members[index]
                with own.active():
                    member.resume()
                    if member.collected_frames < member.total_frames:
                        check_room(
                            member.rotation, member.loss_module, member.optimizer
                        )
                    member._setup_hook()
                member._bar = bars.enter_context(
                    tqdm(
                        total=member.total_frames,
                        initial=member.collected_frames,
                        desc=f"{member.description} {index}",
                        unit="step",
                        disable=None if member.progress else True,
                    )
                )
            while group := self._behind():
                self._tick(group, termination)
        if termination.asked:  # in the last evaluations: all is done and saved
            raise self._preempt()
        for member, own in zip(self.members, self.randomness, strict=True):
            with own.active():
                member._shutdown_hook()

    def _behind(self) -> list[int]:
        """Return which of the unfinished members have taken the fewest steps."""
        steps = {
            index: member.collected_frames
            for index, member in enumerate(self.members)
            if member.collected_frames < member.total_frames
            and not member._stop_training
        }
        return [index for index in steps if steps[index] == min(steps.values())]

    def _tick(self, group: list[int], termination: Termination) -> None:
        """Do the updates up to the next step at which something is due, and do that."""
        if group != self._group:
            self._group, self._update_all = group, self._new_update(group)
        members = [self.members[index] for index in group]
        ticks = [next(iter(member.collector)) for member in members]
        for index, member, tick in zip(group, members, ticks, strict=True):
            with self.randomness[index].active():
                _before_updates(member, tick)
        with _only_own_draws([member.sampler_generator for member in members]):
            for _ in range(ticks[0].numel()):
                if termination.asked:
                    raise self._preempt()
                for member in members:
                    member._optim_count += 1
                self._update_all()
        means = self._update_all.means()
        for row, (index, tick) in enumerate(zip(group, ticks, strict=True)):
            with self.randomness[index].active(), _named(index):
                _after_updates(self.members[index], tick, means[row])

    def _preempt(self) -> Preempted:
        """Save all members where they are; return what to raise."""
        reasons = []
        for index, own in enumerate(self.randomness):
            with own.active(), _named(index):
                member = self.members[index]
                reasons.append(member.preempt(member.step).reason)
        return Preempted(" ".join(reasons))

    def _new_update(self, group: list[int]) -> PlainUpdate | CapturedUpdate:
        update = partial(self._update, group)
        if not self.members[0].cudagraph:
            return PlainUpdate(update)
        return CapturedUpdate(update, lambda: self._generators(group), self._device)

    def _generators(self, group: list[int]) -> Iterator[torch.Generator]:
        """Yield what an update draws from."""
        for index in group:
            member = self.members[index]
            modules = networks_of(member.loss_module)
            yield from (self._noise[index], member.sampler_generator)
            yield from generators_of([*member.transform.modules(), *modules])

    def _update(self, group: list[int]) -> TensorDict:
        """Do one update of some members; return their losses and metrics, ``[K]``."""
        members = [self.members[index] for index in group]
        batches = [member._process_optim_batch_hook(None) for member in members]
        dtype = members[0].optimization_stepper.autocast_dtype
        with torch.autocast(self._device.type, dtype, enabled=dtype is not None):
            losses = vectorized_loss(
                [member.loss_module for member in members],
                batches,
                [self._noise[index] for index in group],
            )
        total = sum(
            value.sum() for key, value in losses.items() if key.startswith("loss_")
        )
        try:
            total.backward()
            rows = []
            for row, index in enumerate(group):
                with _named(index):
                    guard, own = self.members[index].guard, losses.detach()[row]
                    rows.append(guard.step(batches[row], own))
        finally:
            for member in members:
                member.optimizer.zero_grad(set_to_none=True)
        for member in members:
            member._post_optim_hook()
        return torch.stack(rows)


def _before_updates(member: OfflineTrainer, tick: TensorDictBase) -> None:
    """Do what TorchRL's loop does with a batch before the updates."""
    tick = member._process_batch_hook(tick)
    member.collected_frames += tick.numel()
    member._pre_steps_log_hook(tick)
    member.optim_steps_per_batch = tick.numel()
    member._pre_optim_hook()
    member._pre_epoch_log_hook(tick)
    member._pre_epoch_hook(tick)


def _after_updates(
    member: OfflineTrainer, tick: TensorDictBase, means: TensorDictBase
) -> None:
    """Do what TorchRL's loop does with a batch after the updates."""
    member._post_epoch_log_hook(tick)
    member._post_epoch_hook()
    member._post_optim_complete_log_hook(member._optim_count, means)
    member._post_steps_hook()
    member._post_steps_log_hook(tick)
    at_end = member.collected_frames >= member.total_frames
    member.save_trainer(force_save=at_end or member._stop_training)


@contextmanager
def _named(index: int) -> Iterator[None]:
    """Say whose losses are not finite."""
    try:
        yield
    except FloatingPointError as error:
        raise FloatingPointError(f"member {index}: {error}") from error


@contextmanager
def _only_own_draws(samplers: Sequence[torch.Generator]) -> Iterator[None]:
    """Raise unless each member draws from its own generators during the updates."""

    def global_states() -> list[torch.Tensor]:
        on_gpu = torch.cuda.is_available()
        return [torch.get_rng_state(), *(torch.cuda.get_rng_state_all() * on_gpu)]

    before = global_states()
    samples = [sampler.get_state() for sampler in samplers]
    yield
    if not all(map(torch.equal, before, global_states())):
        raise RuntimeError(
            "A hook or a transform drew from torch's default generator during an "
            "update. The members of a population share it: give the hook a generator "
            "of its own."
        )
    drew = [
        not torch.equal(sampler.get_state(), state)
        for sampler, state in zip(samplers, samples, strict=True)
    ]
    if any(drew) and not all(drew):
        raise RuntimeError(
            "Members draw their batches from each other's generators: TorchRL keeps a "
            "buffer's generator in its storage. Give each member's buffer a storage of "
            "its own; TensorStorage(data) copies nothing."
        )


def _common(trainer: OfflineTrainer) -> Mapping[str, Any]:
    """Return the options of a trainer that all members must have in common."""
    return {
        "description": trainer.description,
        "total_steps": trainer.total_frames,
        "intervals (log, eval, checkpoint)": trainer.collector.intervals,
        "cudagraph": trainer.cudagraph,
        "nonfinite=skip": trainer.guard.skips,
        "optimizer": type(trainer.optimizer),
        "autocast_dtype": trainer.optimization_stepper.autocast_dtype,
    }


def _check_member(first: OfflineTrainer, member: OfflineTrainer, index: int) -> None:
    """Raise a ValueError unless a member can share its updates with the first."""
    if type(member.optimization_stepper) is not SumOfLosses:
        raise ValueError(f"member {index} has an optimization stepper of its own.")
    loss = member.loss_module
    if loss._compiled_call_impl is not None:
        raise ValueError(f"member {index} is compiled, which a population cannot be.")
    if member._post_optim_log_ops:
        raise ValueError(
            f"member {index} has post_optim_log hooks, which read numbers after each "
            "update: register them as post_optim_complete_log."
        )
    here, there = _common(first), _common(member)
    different = [
        f"{key}: {here[key]} and {there[key]}"
        for key in here
        if here[key] != there[key]
    ] + differences(first.loss_module, loss)
    if different:
        raise ValueError(
            f"members 0 and {index} cannot share their updates; they differ in "
            f"{'; '.join(different[:3])}."
        )
