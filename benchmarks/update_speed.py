"""How fast an update is: ours, TorchRL's CQL, plain PyTorch, and the products alone.

    python benchmarks/update_speed.py
    python benchmarks/update_speed.py --sizes hopper-2x256 --rounds 3 --output speed
    python benchmarks/update_speed.py --device cuda --output speed

All run in turn, round after round, each in a process of its own, so that a machine
which slows down slows all of them; medians over the rounds are reported. One thread,
and CPU seconds, which other processes disturb least, beside the wall clock. On a GPU
the wall clock counts, and OSR runs compiled and as a CUDA graph too. Writes
``speed.json`` with every round, ``speed.png``, and the tables into the README of that
folder, if it has one.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shlex
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from contenders import EAGER, ON_GPU, OURS, PLAIN, PRODUCTS, SAMPLING, TORCHRL, Size
from rounds import Contender
from speed_report import draw, tables, write_tables
from torchrl import torchrl_logger

SIZES = "hopper-quick,hopper-2x256,hopper-3x256,halfcheetah-2x256,halfcheetah-3x256"
PRECISIONS = {
    "float32": (*OURS, EAGER, TORCHRL, PLAIN, PRODUCTS, SAMPLING),
    "medium": (*OURS, TORCHRL, PLAIN, PRODUCTS),
    "bfloat16": (*OURS, PLAIN, PRODUCTS),
}
"""Who takes part in which precision."""


def summarize(
    contender: Contender, reference: Contender, products: Contender, clock: str
) -> dict[str, Any]:
    """Medians of a contender, and the rounds that they were made of.

    Args:
        contender: whose.
        reference: what ``ratio`` compares with, round by round.
        products: the matrix products whose share of an update is given.
        clock: which seconds the ratios are of.
    """
    rounds = contender.rounds

    def median(values: Sequence[float]) -> float | None:
        return statistics.median(values) if values else None

    def relative(other: Contender) -> list[float]:
        pairs = zip(other.rounds, rounds, strict=False)
        return [theirs[clock] / ours[clock] for theirs, ours in pairs]

    ratios = relative(reference)
    parts = rounds[0]["cpu_seconds_by_part"] if rounds else {}
    return {
        "failure": contender.failure,
        "updates_per_cpu_second": median([1 / each["cpu_seconds"] for each in rounds]),
        "updates_per_second": median([1 / each["wall_seconds"] for each in rounds]),
        "ratio": median(ratios),
        "ratio_lowest": min(ratios, default=None),
        "ratio_highest": max(ratios, default=None),
        "products_share": median(relative(products)),
        "cpu_seconds_by_part": {
            part: median([each["cpu_seconds_by_part"][part] for each in rounds])
            for part in parts
        },
        "rounds": rounds,
    }


def measure(
    name: str,
    *,
    precisions: Sequence[str],
    rounds: int,
    device: str,
    threads: int = 1,
    seconds: float = 1.0,
) -> dict[str, dict[str, Any]]:
    """Results of one size, by precision and contender.

    Args:
        name: of the size.
        precisions: some of :data:`PRECISIONS`.
        rounds: how many.
        device, threads, seconds: see :class:`rounds.Timer`.
    """
    on_gpu = device == "cuda"
    contenders = {
        (precision, who): Contender(
            who, precision, Size.parse(name), device, threads, seconds
        )
        for precision in precisions
        for who in (*PRECISIONS[precision], *(ON_GPU if on_gpu else ()))
    }
    for number in range(rounds):
        print(f"{name}: round {number + 1} of {rounds}", file=sys.stderr, flush=True)
        for contender in contenders.values():
            contender.round()
    for contender in contenders.values():
        contender.close()
    results: dict[str, dict[str, Any]] = {precision: {} for precision in precisions}
    for (precision, who), contender in contenders.items():
        # Autocast is compared with the plain reference without it.
        exact = "float32" if precision == "bfloat16" else precision
        results[precision][who] = summarize(
            contender,
            reference=contenders[exact, PLAIN],
            products=contenders[precision, PRODUCTS],
            clock="wall_seconds" if on_gpu else "cpu_seconds",
        )
    return results


def machine() -> dict[str, Any]:
    """What the numbers depend on."""
    path = Path("/proc/cpuinfo")
    text = path.read_text() if path.exists() else ""
    models = re.findall("model name\t: (.*)", text)
    commit = subprocess.run(
        ["git", "--no-optional-locks", "describe", "--always", "--dirty"],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    return {
        "cpu": models[0] if models else platform.processor(),
        "cpus": os.cpu_count(),
        "capability": torch.backends.cpu.get_cpu_capability(),
        # What makes products of bfloat16 numbers fast.
        "bfloat16_units": sorted(set(re.findall(r"\b\w+_bf16\b", text))),
        "platform": platform.platform(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("torch", "tensordict", "torchrl")},
        "load_average": os.getloadavg(),
        "commit": commit.stdout.strip() or None,
        "date": time.strftime("%Y-%m-%d"),
    }


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--sizes", default=SIZES, help="task-quick or task-layersxwidth, by commas"
    )
    parser.add_argument(
        "--precisions", default=",".join(PRECISIONS), help="float32 among them"
    )
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each round")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--output", type=Path, default=Path("results/speed"))
    options = parser.parse_args(arguments)
    options.precisions = options.precisions.split(",")
    if not {"float32"} <= set(options.precisions) <= set(PRECISIONS):
        parser.error(f"--precisions takes float32 and others of {list(PRECISIONS)}")
    return options


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write and print."""
    options = parse(arguments)
    torchrl_logger.setLevel("WARNING")
    settings = {
        name: getattr(options, name)
        for name in ("precisions", "rounds", "seconds", "threads", "device")
    }
    given = sys.argv[1:] if arguments is None else arguments
    results: dict[str, Any] = {
        "command": shlex.join(["python", "benchmarks/update_speed.py", *given]),
        "machine": machine() | settings,
        "sizes": {},
    }
    options.output.mkdir(parents=True, exist_ok=True)

    def write() -> None:
        text = json.dumps(results, indent=1) + "\n"
        (options.output / "speed.json").write_text(text)

    for name in options.sizes.split(","):
        results["sizes"][name] = measure(name, **settings)
        write()  # at once: there are minutes of work in it
    # Last, for nothing may touch a GPU in the process that forks.
    if options.device == "cuda":
        results["machine"]["gpu"] = torch.cuda.get_device_name()
        write()
    draw(results, options.output / "speed.png")
    text = tables(results)
    write_tables(text, options.output / "README.md")
    print(text)


if __name__ == "__main__":
    main()
