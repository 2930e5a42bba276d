"""Time an update: ours, TorchRL's CQL, and the same mathematics in plain PyTorch.

    python benchmarks/update_speed.py
    python benchmarks/update_speed.py --sizes hopper-2x256 --rounds 3 --output speed

Each contender has a process of its own, since memory that was allocated before changes
the speed. They run in turn, round after round, so that a machine that slows down slows
all of them. The table has medians over the rounds, in updates a CPU second of one
thread, which other processes disturb least. On a GPU the wall clock counts instead.
Writes ``speed.json`` with every round, and prints the table.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import re
import shlex
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import version
from itertools import cycle
from pathlib import Path
from typing import Any

import torch
from contenders import COMPILED, CONTENDERS, PLAIN, Size, make_contender
from torchrl import torchrl_logger

SIZES = "hopper-quick,hopper-2x256,hopper-3x256,halfcheetah-2x256,halfcheetah-3x256"
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["contenders"])  # the processes share the imports
TIMERS: list[Timer] = []


class Timer:
    """Time one contender's updates, in a process of its own.

    Args:
        name: of the contender.
        size: of the task and the networks.
        device: where it runs.
        threads: of torch.
        seconds: of a round, roughly.
    """

    def __init__(
        self, name: str, size: Size, device: str, threads: int, seconds: float
    ) -> None:
        torchrl_logger.setLevel("WARNING")
        torch.set_num_threads(threads)
        torch.manual_seed(0)
        self.device = torch.device(device)
        self.update, batches = make_contender(name, size, self.device)
        self.batches = cycle(batches)
        self.steps = 6
        self.round()  # warm-up
        self.steps = max(1, round(seconds / self.round()["wall_seconds"]))

    def synchronize(self) -> None:
        """Wait until a GPU has finished."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def round(self) -> dict[str, float]:
        """Return the seconds of one update, averaged over a round."""
        self.synchronize()
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(self.steps):
            self.update(next(self.batches))
        self.synchronize()
        return {
            "updates": self.steps,
            "wall_seconds": (time.perf_counter() - wall) / self.steps,
            "cpu_seconds": (time.process_time() - cpu) / self.steps,
        }


def timed(*arguments: Any) -> dict[str, float]:
    """Return a round of this process's timer, which the first call makes."""
    if not TIMERS:
        TIMERS.append(Timer(*arguments))
    return TIMERS[0].round()


def measure(
    name: str, *, rounds: int, device: str, threads: int, seconds: float
) -> dict[str, dict[str, Any]]:
    """Return medians and rounds of all contenders at one size."""
    on_gpu = device == "cuda"
    clock = "wall_seconds" if on_gpu else "cpu_seconds"
    size = Size.parse(name)
    pools = {
        who: ProcessPoolExecutor(1, SERVER)
        for who in (*CONTENDERS, *[COMPILED] * on_gpu)
    }
    results: dict[str, dict[str, Any]] = {
        who: {"failure": None, "rounds": []} for who in pools
    }
    for number in range(rounds):
        print(f"{name}: round {number + 1} of {rounds}", file=sys.stderr, flush=True)
        for who in (each for each in pools if not results[each]["failure"]):
            result = pools[who].submit(timed, who, size, device, threads, seconds)
            # A contender that fails takes part no more, and the others go on.
            if error := result.exception():
                results[who]["failure"] = f"{type(error).__name__}: {error}"
            else:
                results[who]["rounds"].append(result.result())
    for who, pool in pools.items():
        pool.shutdown()
        done = results[who]["rounds"]
        pairs = zip(results[PLAIN]["rounds"], done, strict=False)
        if ratios := [plain[clock] / ours[clock] for plain, ours in pairs]:
            rates = [1 / each[clock] for each in done]
            results[who] |= {
                "updates_per_second": statistics.median(rates),
                "ratio": statistics.median(ratios),
                "ratio_lowest": min(ratios),
                "ratio_highest": max(ratios),
            }
    return results


def machine() -> dict[str, Any]:
    """Return the hardware and the versions that the times depend on."""
    path = Path("/proc/cpuinfo")
    models = re.findall("model name\t: (.*)", path.read_text() if path.exists() else "")
    command = ["git", "--no-optional-locks", "describe", "--always", "--dirty"]
    options = {"capture_output": True, "text": True, "check": False}
    commit = subprocess.run(command, cwd=Path(__file__).parent, **options)
    return {
        "cpu": models[0] if models else platform.processor(),
        "cpus": os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("torch", "tensordict", "torchrl")},
        "load_average": os.getloadavg()[0],
        "commit": commit.stdout.strip() or None,
        "date": time.strftime("%Y-%m-%d"),
    }


def table(results: dict[str, Any]) -> str:
    """Return the results in Markdown."""
    sizes, of = results["sizes"], results["machine"]
    names = list(next(iter(sizes.values())))
    rows = [["updates a second (x plain PyTorch)", *sizes], ["---"] * (1 + len(sizes))]
    for name in names:
        cells = [
            f"{row['updates_per_second']:.1f} ({row['ratio']:.2f}x)"
            if "ratio" in (row := sizes[size][name])
            else row["failure"]
            for size in sizes
        ]
        rows.append([name, *cells])
    lines = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return (
        f"`{results['command']}`: {of.get('gpu', of['cpu'])}, {of['threads']} "
        f"thread(s), {of['rounds']} rounds, load average {of['load_average']:.1f}, "
        f"commit `{of['commit']}`, torch {of['torch']}, TorchRL {of['torchrl']}, "
        f"tensordict {of['tensordict']}, {of['date']}.\n\n{lines}\n"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--sizes", default=SIZES, help="task-quick or task-layersxwidth, by commas"
    )
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each round")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--output", type=Path, default=Path("results/speed"))
    options = parser.parse_args(arguments)
    settings = {
        name: getattr(options, name)
        for name in ("rounds", "seconds", "threads", "device")
    }
    given = sys.argv[1:] if arguments is None else arguments
    results: dict[str, Any] = {
        "command": shlex.join(["python", "benchmarks/update_speed.py", *given]),
        "machine": machine() | settings,
        "sizes": {},
    }
    if options.device == "cuda":
        results["machine"]["gpu"] = torch.cuda.get_device_name()
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.sizes.split(","):
        results["sizes"][name] = measure(name, **settings)
        text = json.dumps(results, indent=1) + "\n"
        (options.output / "speed.json").write_text(text)
    print(table(results))


if __name__ == "__main__":
    main()
