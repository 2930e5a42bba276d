"""Twenty million transitions on disk: how fast are they drawn, in how much memory?

    python benchmarks/larger_than_memory.py

Writes a set of synthetic rows of hopper's sizes with ``write_memmap``, then draws the
same batches from memory and from disk, each in a process of its own, in turns: what
else runs on the machine slows both. ``disk_for_training`` is what training draws: rows
without the held-out ones, standardised. At the end ``torchrl-osr train`` trains
on the set. Memory is a process's anonymous memory (``RssAnon``), its own; pages of the
mapped files are the system's, which takes them back when memory is short. Linux only.
Writes ``results/reliability/larger_than_memory.json``; the set is deleted.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import platform
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.metadata import version
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer
from torchrl.envs import ObservationNorm

from torchrl_osr.lab.data import (
    held_out_rows,
    load_memmap,
    make_replay_buffer,
    observation_statistics,
    write_memmap,
)

ROOT = Path(__file__).parents[1]
OUTPUT = ROOT / "results" / "reliability" / "larger_than_memory.json"
OBSERVATION, ACTION = 11, 3  # hopper's
CHUNK, BATCH = 200_000, 256
SPAWN = multiprocessing.get_context("spawn")  # a fork would begin with our memory
PACKAGES = ("torchrl-osr", "torch", "torchrl", "tensordict", "numpy")
CONTENDERS = ("memory", "disk", "disk_for_training")
TRAINING = (
    *("env=hopper", "data=file", "data.storage=disk", "trainer.progress=false"),
    *("trainer.inverse_dynamics_steps=500", "trainer.steps=1000"),
    *("trainer.eval_interval=500", "trainer.eval_episodes=2"),
    *("trainer.checkpoint_interval=500", "trainer.log_interval=100"),
)


def chunks(rows: int) -> Iterator[TensorDict]:
    """Yield random transitions, the same for the same number of rows."""
    generator = torch.Generator().manual_seed(0)
    sizes = [OBSERVATION, ACTION, OBSERVATION, 1]
    for start in range(0, rows, CHUNK):
        count = min(CHUNK, rows - start)
        numbers = torch.randn(count, sum(sizes), generator=generator)
        state, action, after, reward = numbers.split(sizes, dim=1)
        ended = torch.rand(count, 1, generator=generator) < 0.002
        following = {"observation": after, "reward": reward, "done": ended}
        following |= {"terminated": ended, "truncated": torch.zeros_like(ended)}
        root = {"observation": state, "action": action.tanh() * 0.999}
        yield TensorDict(root | {"next": TensorDict(following, [count])}, [count])


def memory(pid: int | str = "self") -> dict[str, float]:
    """Return a process's anonymous memory and its pages of files, in MiB."""
    text = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    found = {
        name: re.search(rf"{name}:\s+(\d+)", text) for name in ("RssAnon", "RssFile")
    }
    return {name: round(int(hit[1]) / 1024) for name, hit in found.items() if hit}


def make_buffer(name: str, folder: Path) -> ReplayBuffer:
    """Return the buffer of one contender."""
    data, _ = load_memmap(folder)
    if name == "memory":
        data = data.clone()
    options: dict[str, Any] = {"batch_size": BATCH, "seed": 0}
    if name == "disk_for_training":
        keys = ["observation", ("next", "observation")]
        options["transform"] = ObservationNorm(
            *observation_statistics(data), in_keys=keys, standard_normal=True
        )
        options["left_out"] = held_out_rows(len(data), 0.02, seed=0).sort().values
    return make_replay_buffer(data, **options)


def serve(connection: Connection, name: str, folder: Path) -> None:
    """Draw as many batches as each request says; in a process of its own."""
    torch.set_num_threads(1)
    start = time.perf_counter()
    buffer = make_buffer(name, folder)
    opening = time.perf_counter() - start
    columns = sorted(buffer.sample().flatten_keys().items())
    content = b"".join(column.numpy().tobytes() for _, column in columns)
    connection.send((hashlib.sha256(content).hexdigest(), opening))
    while batches := connection.recv():
        start = time.perf_counter()
        for _ in range(batches):
            buffer.sample()
        seconds = time.perf_counter() - start
        connection.send({"ms_per_batch": seconds / batches * 1e3} | memory())


def convert(connection: Connection, rows: int, folder: Path) -> None:
    """Write the set and say how long it took; in a process of its own."""
    torch.set_num_threads(1)
    largest = 0.0

    def watched() -> Iterator[TensorDict]:
        nonlocal largest
        for chunk in chunks(rows):
            largest = max(largest, memory()["RssAnon"])
            yield chunk

    start = time.perf_counter()
    write_memmap(watched(), folder, total=rows)
    seconds = time.perf_counter() - start
    size = sum(path.stat().st_size for path in folder.iterdir())
    rate = {"seconds": seconds, "rows_per_second": rows / seconds, "bytes": size}
    connection.send(rate | {"largest_RssAnon_mib": largest})


def start(target: Any, *args: Any) -> tuple[Any, Connection]:
    """Return a process and the connection to it."""
    ours, theirs = SPAWN.Pipe()
    process = SPAWN.Process(target=target, args=(theirs, *args), daemon=True)
    process.start()
    theirs.close()
    return process, ours


def compare(folder: Path, rounds: int, batches: int) -> dict[str, Any]:
    """Draw in turns; return each contender's medians and its rates to memory's."""
    running = {name: start(serve, name, folder) for name in CONTENDERS}
    first = {name: connection.recv() for name, (_, connection) in running.items()}
    assert first["memory"][0] == first["disk"][0], "the same seed gave other rows"
    played: dict[str, list[dict[str, float]]] = {name: [] for name in CONTENDERS}
    for number in range(rounds + 1):
        for name, (_, connection) in running.items():
            connection.send(batches)
            answer = connection.recv()
            if number:  # the first warms up
                played[name].append(answer)
    for process, connection in running.values():
        connection.send(0)
        process.join()
    result = {}
    for name, own in played.items():
        ratios = [
            theirs["ms_per_batch"] / ours["ms_per_batch"]
            for ours, theirs in zip(own, played["memory"], strict=True)
        ]
        result[name] = {
            "seconds_to_open": round(first[name][1], 2),
            "ms_per_batch": statistics.median(each["ms_per_batch"] for each in own),
            "rate_to_memory": {
                "median": round(statistics.median(ratios), 3),
                "range": [round(min(ratios), 3), round(max(ratios), 3)],
            },
            "largest_mib": {
                kind: max(each[kind] for each in own) for kind in ("RssAnon", "RssFile")
            },
        }
    return result


def cold(folder: Path, batches: int) -> dict[str, float]:
    """Return what a batch takes with nothing in the page cache."""
    buffer = make_buffer("disk", folder)
    os.sync()
    for path in folder.glob("*.memmap"):
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    begin = time.perf_counter()
    for _ in range(batches):
        buffer.sample()
    seconds = time.perf_counter() - begin
    return {"batches": batches, "ms_per_batch": seconds / batches * 1e3}


def train(folder: Path) -> dict[str, Any]:
    """Run the example on the set and watch its memory."""
    run = folder.with_name("run")
    command = [
        sys.executable,
        "-m",
        "torchrl_osr",
        "train",
        *TRAINING,
        f"data.path={folder}",
    ]
    process = subprocess.Popen([*command, f"hydra.run.dir={run}"])
    begin, seen = time.perf_counter(), []
    while process.poll() is None:
        try:
            seen.append(memory(process.pid))
        except FileNotFoundError:
            break
        time.sleep(0.2)
    if process.wait():
        raise RuntimeError("the training run failed; see above.")
    whole = [each for each in seen if len(each) == 2]
    return {
        "overrides": [*TRAINING, "data.path=<the set>"],
        "seconds": time.perf_counter() - begin,
        "largest_mib": {
            kind: max(each[kind] for each in whole) for kind in ("RssAnon", "RssFile")
        },
    }


def machine() -> str:
    """Return processor, cores and memory."""
    text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    model = re.findall(r"model name\t: (.*)", text) or [platform.machine()]
    size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{model[0]}, {os.cpu_count()} cores, {size:.0f} GiB"


def main() -> None:
    """Write, draw, train, delete."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=20_000_000)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--batches", type=int, default=300, help="of a round")
    parser.add_argument("--folder", type=Path, help="where the set is written to")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    place = Path(tempfile.mkdtemp(prefix="larger-than-memory-", dir=arguments.folder))
    try:
        folder = place / "set"
        process, connection = start(convert, arguments.rows, folder)
        result: dict[str, Any] = {"conversion": connection.recv()}
        process.join()
        result["sampling"] = compare(folder, arguments.rounds, arguments.batches)
        result["cold"] = cold(folder, 40)
        result["training"] = train(folder)
    finally:
        shutil.rmtree(place)
    result = {
        "command": " ".join(["python benchmarks/larger_than_memory.py", *sys.argv[1:]]),
        "rows": arguments.rows,
        "batch_size": BATCH,
        "versions": {name: version(name) for name in PACKAGES},
        "machine": machine(),
        "load_average": os.getloadavg(),
        "python": platform.python_version(),
    } | result
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
