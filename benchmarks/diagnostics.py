"""What an update does, apart from how long it takes: operations, memory, their kinds.

All of it is measured outside the timed rounds, because watching slows down.
"""

from __future__ import annotations

import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

KINDS = {
    "matrix products": r"aten::(mm|addmm|bmm|baddbmm|mv|addmv)_?$",
    "copies": r"aten::(cat|stack|copy_|clone|_to_copy|repeat|index|index_select"
    r"|fill_|zero_|empty|empty_like|empty_strided|new_empty_strided|resize_)$",
    "elementwise": r"aten::",
}
"""Groups of operations by what they cost; the first pattern that matches counts."""
# Nothing is computed or copied in them: their time is Python's and the dispatcher's.
VIEWS = re.compile(
    r"aten::(view|_unsafe_view|reshape|_reshape_alias|expand|transpose|t|permute|slice"
    r"|select|split|chunk|unsqueeze|squeeze|detach|as_strided|narrow|alias|movedim"
    r"|unbind|flatten|unflatten|matmul|linear|to|result_type|item|lift_fresh)$"
)
aten = torch.ops.aten
# What PyTorch's own counter has no numbers for: products by the shapes of the factors.
MORE_FLOPS = {
    aten.addmm_: lambda _, a, b, **__: 2 * a[0] * a[1] * b[1],
    aten.mv: lambda a, _, **__: 2 * a[0] * a[1],
    aten.addmv_: lambda _, a, __, **___: 2 * a[0] * a[1],
}
# Dispatched, but without work for the device.
NO_KERNEL = frozenset({"_unsafe_view", "lift_fresh", "empty", "new_empty_strided"})


class Counting(TorchDispatchMode):
    """Counts the operations that reach the dispatcher below autograd.

    ``kernels`` leaves out what only changes a view; ``host_reads`` are the numbers that
    Python asked for (``.item()``, an ``if`` on a tensor), for each of which a GPU would
    have to finish what it was given.
    """

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter(operations=0, kernels=0, host_reads=0)

    def __torch_dispatch__(
        self,
        function: Any,
        types: tuple[type, ...],
        arguments: tuple[Any, ...] = (),
        options: Mapping[str, Any] | None = None,
    ) -> Any:
        name = function.overloadpacket.__name__
        if function.namespace == "aten":
            read = name == "_local_scalar_dense"
            self.counts["operations"] += 1
            self.counts["host_reads"] += read
            self.counts["kernels"] += not (
                read or function.is_view or name in NO_KERNEL
            )
        return function(*arguments, **(options or {}))


class NoModules:
    """Stands for the counter's tracker of modules, which fails on TensorDictParams."""

    parents = frozenset({"Global"})

    def __enter__(self) -> None:
        """Watch nothing."""

    def __exit__(self, *_: object) -> None:
        """Watch nothing."""


def count_flops(update: Callable[[], Iterator[str]]) -> int:
    """Return the floating point operations of the matrix products of one update."""
    counter = FlopCounterMode(display=False, custom_mapping=MORE_FLOPS)
    counter.mod_tracker = NoModules()
    with counter:
        for _ in update():
            pass
    return counter.get_total_flops()


def count_operations(update: Callable[[], Iterator[str]]) -> dict[str, Any]:
    """Return the counts of one update, and the host reads of each of its parts."""
    reads: Counter[str] = Counter()
    with Counting() as counting:
        before = 0
        for part in update():
            now = counting.counts["host_reads"]
            reads[part] += now - before
            before = now
    flops = count_flops(update)
    return {**counting.counts, "host_reads_by_part": reads, "flops": flops}


def peak_bytes(events: Any) -> int:
    """Return the most bytes that were allocated at a time beyond those before."""
    memory = sorted(
        (event.start_ns(), event.nbytes())
        for event in events
        if event.name() == "[memory]"
    )
    held = highest = 0
    for _, number in memory:
        held += number
        highest = max(highest, held)
    return highest


def kind_of(name: str) -> str:
    """Return the group of :data:`KINDS` that an operation belongs to."""
    if not VIEWS.match(name):
        for kind, pattern in KINDS.items():
            if re.match(pattern, name):
                return kind
    return "rest"


@contextmanager
def silence() -> Iterator[None]:
    """Drop what the profiler writes to the standard error, beside Python."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def profile_update(
    update: Callable[[], Iterator[str]], device: torch.device, steps: int
) -> dict[str, Any]:
    """Return where the time goes by kind of operation, and the peak of memory.

    "rest" is what no operation accounts for: Python, autograd's engine, dispatch. The
    profiler's own work is in it, and makes it look larger than it is.
    """
    on_gpu = device.type == "cuda"
    activities = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * on_gpu
    if on_gpu:
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
    with (
        silence(),
        profile(activities=activities, profile_memory=not on_gpu) as profiler,
    ):
        start = time.perf_counter()
        for _ in range(steps):
            for _ in update():
                pass
        if on_gpu:
            torch.cuda.synchronize(device)
        seconds = time.perf_counter() - start
    clock = "self_device_time_total" if on_gpu else "self_cpu_time_total"
    by_kind: Counter[str] = Counter(dict.fromkeys(KINDS, 0.0))
    for row in profiler.key_averages():
        by_kind[kind_of(row.key)] += getattr(row, clock) / 1e6
    by_kind["rest"] = seconds - sum(by_kind[kind] for kind in KINDS)
    memory = (
        torch.cuda.max_memory_allocated(device) - before
        if on_gpu
        else peak_bytes(profiler.profiler.kineto_results.events())
    )
    shares = {kind: value / seconds for kind, value in by_kind.items()}
    return {"time_by_kind": shares, "peak_memory_bytes": memory}
