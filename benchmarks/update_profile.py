"""Where an update goes: Python calls, tensor operations, and time by kind of operation.

    python benchmarks/update_profile.py --output results/speed/profile.json

For OSR as the trainer runs it, for OSR called anew for every batch, and for the plain
reference, by default at the sizes of the quick preset. Times are those of PyTorch's
profiler, which slows short operations down: read them as shares. ``update_speed.py``
has the real ones.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from contenders import EAGER, PLAIN, Size, make_contender
from torch.profiler import ProfilerActivity, profile

NAMES = ("OSR", EAGER, PLAIN)
UPDATES = 50
KINDS = {
    "matrix products": ("mm", "addmm", "addmm_", "bmm", "baddbmm", "mv", "addmv_"),
    "layer normalisation": ("native_layer_norm", "native_layer_norm_backward"),
    "optimizer": ("_fused_adam_",),
    "sums and means": ("sum", "mean", "logsumexp", "amax", "min"),
    "copies": ("copy_", "cat", "stack", "fill_", "zero_", "clone"),
    "views": (
        *("view", "reshape", "as_strided", "slice", "select", "expand", "unbind"),
        *("split", "squeeze", "unsqueeze", "t", "transpose", "permute", "detach"),
    ),
}
"""Operations by kind; the others are elementwise, nearly all."""


def python_calls(update: Callable[[], Any]) -> int:
    """Count the calls of Python functions, and of C functions from Python."""
    calls = 0

    def count(_: object, event: str, __: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        update()
    finally:
        sys.setprofile(None)
    return calls


def profiled(update: Callable[[], Any]) -> dict[str, Any]:
    """Calls and operations of an update, and the share of time by kind."""
    for _ in range(10):
        update()
    calls = python_calls(update)
    with profile(activities=[ProfilerActivity.CPU]) as found:
        for _ in range(UPDATES):
            update()
    times: dict[str, float] = defaultdict(float)
    count = 0
    kind_of = {f"aten::{name}": kind for kind, names in KINDS.items() for name in names}
    for event in found.key_averages():
        is_operation = event.key.startswith("aten::")
        count += event.count * is_operation
        other = "elementwise and other" if is_operation else "outside operations"
        times[kind_of.get(event.key, other)] += event.self_cpu_time_total
    total = sum(times.values())
    shares = {kind: round(100 * time / total, 1) for kind, time in times.items()}
    return {
        "python_calls": calls,
        "operations": round(count / UPDATES),
        "percent": dict(sorted(shares.items(), key=lambda item: -item[1])),
    }


def main() -> None:
    """Profile the three, print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--size", default="hopper-quick")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    size, results = Size.parse(options.size), {}
    for name in NAMES:
        torch.manual_seed(0)
        run, batches = make_contender(name, size, torch.device("cpu"), autocast=False)
        results[name] = profiled(lambda run=run, batch=batches[0]: list(run(batch)))
    rows = {"Python calls": "python_calls", "tensor operations": "operations"}
    print(f"| an update of `{options.size}` |", " | ".join(NAMES), "|")
    print("|", " | ".join(["---"] * (len(NAMES) + 1)), "|")
    for label, key in rows.items():
        print(f"| {label} |", *(f"{results[name][key]:,} |" for name in NAMES))
    for kind in results[NAMES[0]]["percent"]:
        cells = (results[name]["percent"].get(kind, 0.0) for name in NAMES)
        print(f"| {kind} |", *(f"{cell} % |" for cell in cells))
    if options.output:
        options.output.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
