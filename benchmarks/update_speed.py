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
from importlib.metadata import version
from itertools import cycle
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
from contenders import COMPILED, CONTENDERS, PLAIN, Size, make_contender
from torchrl import torchrl_logger

SIZES = "hopper-quick,hopper-2x256,hopper-3x256,halfcheetah-2x256,halfcheetah-3x256"
FORK = multiprocessing.get_context("fork")  # a fork shares the imports


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


def serve(connection: Connection, *arguments: Any) -> None:
    """Answer each request with a round, or with the error."""
    timer = None
    while connection.recv():
        try:
            timer = timer or Timer(*arguments)
            connection.send(timer.round())
        except Exception as error:
            # One contender that fails does not end the others.
            connection.send(f"{type(error).__name__}: {error}")


class Contender:
    """A contender seen from outside its process.

    Args:
        arguments: of :class:`Timer`.

    Attributes:
        rounds: times of each round.
        failure: the error after which it takes part no more.
    """

    def __init__(self, *arguments: Any) -> None:
        self.rounds: list[dict[str, float]] = []
        self.failure: str | None = None
        self._connection, theirs = FORK.Pipe()
        self._process = FORK.Process(
            target=serve, args=(theirs, *arguments), daemon=True
        )
        self._process.start()
        theirs.close()

    def round(self) -> None:
        """Do a round of updates."""
        if self.failure is None:
            self._connection.send(True)
            answer = self._connection.recv()
            if isinstance(answer, str):
                self.failure = answer
            else:
                self.rounds.append(answer)

    def close(self) -> None:
        """End the process."""
        self._connection.send(False)
        self._process.join()


def measure(
    name: str, *, rounds: int, device: str, threads: int, seconds: float
) -> dict[str, dict[str, Any]]:
    """Return medians and rounds of all contenders at one size."""
    on_gpu = device == "cuda"
    clock = "wall_seconds" if on_gpu else "cpu_seconds"
    size = Size.parse(name)
    contenders = {
        who: Contender(who, size, device, threads, seconds)
        for who in (*CONTENDERS, *[COMPILED] * on_gpu)
    }
    for number in range(rounds):
        print(f"{name}: round {number + 1} of {rounds}", file=sys.stderr, flush=True)
        for each in contenders.values():
            each.round()
    results = {}
    for who, each in contenders.items():
        each.close()
        pairs = zip(contenders[PLAIN].rounds, each.rounds, strict=False)
        ratios = [plain[clock] / ours[clock] for plain, ours in pairs]
        results[who] = {"failure": each.failure, "rounds": each.rounds}
        if ratios:
            rates = [1 / done[clock] for done in each.rounds]
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
    torchrl_logger.setLevel("WARNING")
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
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.sizes.split(","):
        results["sizes"][name] = measure(name, **settings)
        text = json.dumps(results, indent=1) + "\n"
        (options.output / "speed.json").write_text(text)
    if options.device == "cuda":  # last: a process that has touched a GPU cannot fork
        results["machine"]["gpu"] = torch.cuda.get_device_name()
    print(table(results))


if __name__ == "__main__":
    main()
