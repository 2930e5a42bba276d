"""Twenty million transitions on disk: how fast are they drawn, in how much memory?

    python benchmarks/larger_than_memory.py

Writes a set of synthetic rows of hopper's sizes with ``write_on_disk``, then draws the
same batches from disk and from memory, each in a process of its own, in turns: what
else runs on the machine slows both. ``disk_for_training`` is what training draws: rows
without the held-out ones, standardised. At the end ``examples/offline_osr.py`` trains
on the set. Writes ``results/reliability/larger_than_memory.json``; the set is deleted.
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

from torchrl_osr.data import (
    TransitionsOnDisk,
    make_replay_buffer,
    observation_statistics,
    split_on_disk,
    write_on_disk,
)

ROOT = Path(__file__).parents[1]
OUTPUT = ROOT / "results" / "reliability" / "larger_than_memory.json"
OBSERVATION, ACTION = 11, 3  # hopper's
CHUNK = 200_000
BATCH = 256
SPAWN = multiprocessing.get_context("spawn")  # a fork would begin with our memory
PACKAGES = ("torchrl-osr", "torch", "torchrl", "tensordict", "numpy")
CONTENDERS = ("memory", "disk", "disk_for_training")
TRAINING = (
    *("env=hopper", "data=file", "data.storage=disk", "trainer.progress=false"),
    *("trainer.inverse_dynamics_steps=500", "trainer.steps=1000"),
    *("trainer.eval_interval=500", "trainer.eval_episodes=2"),
    *("trainer.checkpoint_interval=500", "trainer.log_interval=100"),
)


def synthetic_rows(number: int, count: int) -> TensorDict:
    """Return a chunk of random transitions, the same for the same number."""
    generator = torch.Generator().manual_seed(number)
    sizes = [OBSERVATION, ACTION, OBSERVATION, 1]
    numbers = torch.randn(count, sum(sizes), generator=generator)
    state, action, after, reward = map(torch.clone, torch.split(numbers, sizes, dim=1))
    ended = torch.rand(count, 1, generator=generator) < 0.002
    following = {
        "observation": after,
        "reward": reward,
        "done": ended,
        "terminated": ended,
        "truncated": torch.zeros_like(ended),
    }
    root = {"observation": state, "action": action.tanh() * 0.999}
    return TensorDict(root | {"next": TensorDict(following, [count])}, [count])


def chunks(rows: int, first: int = 0) -> Iterator[TensorDict]:
    """Yield the chunks of a set from one of them on."""
    for start in range(first * CHUNK, rows, CHUNK):
        yield synthetic_rows(start // CHUNK, min(CHUNK, rows - start))


def memory(pid: int | str = "self") -> dict[str, float]:
    """Return a process's resident memory in MiB: all, its own, of files, the peak."""
    text = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    names = ("VmRSS", "RssAnon", "RssFile", "VmHWM")
    found = {name: re.search(rf"{name}:\s+(\d+) kB", text) for name in names}
    return {name: round(int(hit[1]) / 1024, 1) for name, hit in found.items() if hit}


def in_memory(rows: int) -> TensorDict:
    """Return the whole set; chunks go into their place, so that there is one copy."""
    data: TensorDict | None = None
    for number, chunk in enumerate(chunks(rows)):
        if data is None:
            data = chunk.new_empty(rows)
        data[number * CHUNK : number * CHUNK + len(chunk)] = chunk
    assert data is not None
    return data


def make_buffer(name: str, rows: int, folder: Path) -> ReplayBuffer:
    """Return the buffer of one contender."""
    if name == "memory":
        return make_replay_buffer(in_memory(rows), batch_size=BATCH, seed=0)
    data = TransitionsOnDisk(folder)
    norm = None
    if name == "disk_for_training":
        keys = ["observation", ("next", "observation")]
        norm = ObservationNorm(
            *observation_statistics(data), in_keys=keys, standard_normal=True
        )
        data, _ = split_on_disk(data, 0.02, seed=0)
    return make_replay_buffer(data, batch_size=BATCH, seed=0, transform=norm)


def serve(connection: Connection, name: str, rows: int, folder: Path) -> None:
    """Draw as many batches as each request says; in a process of its own."""
    torch.set_num_threads(1)
    buffer = make_buffer(name, rows, folder)
    columns = sorted(buffer.sample().flatten_keys().items())
    content = b"".join(column.numpy().tobytes() for _, column in columns)
    first = hashlib.sha256(content).hexdigest()
    connection.send(first)
    while batches := connection.recv():
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(batches):
            buffer.sample()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        times = {"wall_ms": wall / batches * 1e3, "cpu_ms": cpu / batches * 1e3}
        connection.send(times | memory())


def convert(connection: Connection, rows: int, folder: Path) -> None:
    """Write the set and say how long it took; in a process of its own."""
    torch.set_num_threads(1)
    start = time.perf_counter()
    write_on_disk(
        lambda done: ((chunk, {}) for chunk in chunks(rows, len(done))),
        folder,
        total=rows,
    )
    seconds = time.perf_counter() - start
    start = time.perf_counter()
    for _ in chunks(rows):
        pass
    generation = time.perf_counter() - start
    connection.send({
        "seconds": seconds,
        "seconds_to_generate_alone": generation,
        "rows_per_second": rows / seconds,
        "bytes": (folder / "rows.bin").stat().st_size,
        "peak_mib": memory()["VmHWM"],
    })  # fmt: skip


def start(target: Any, *args: Any) -> tuple[Any, Connection]:
    """Return a process and the connection to it."""
    ours, theirs = SPAWN.Pipe()
    process = SPAWN.Process(target=target, args=(theirs, *args), daemon=True)
    process.start()
    theirs.close()
    return process, ours


def compare(rows: int, folder: Path, rounds: int, batches: int) -> dict[str, Any]:
    """Draw in turns; return each contender's rounds and the ratios to memory."""
    running = {name: start(serve, name, rows, folder) for name in CONTENDERS}
    firsts = {name: connection.recv() for name, (_, connection) in running.items()}
    assert firsts["memory"] == firsts["disk"], "the same seed gave other rows"
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
    return {name: summary(played[name], played["memory"]) for name in CONTENDERS}


def summary(
    played: list[dict[str, float]], reference: list[dict[str, float]]
) -> dict[str, Any]:
    """Return medians, the ratios of the rates round by round, and the memory."""
    result: dict[str, Any] = {}
    for kind in ("wall_ms", "cpu_ms"):
        pairs = zip(played, reference, strict=True)
        ratios = [theirs[kind] / ours[kind] for ours, theirs in pairs]
        result[kind] = round(statistics.median(each[kind] for each in played), 4)
        result[f"rate_to_memory_by_{kind[:-3]}"] = {
            "median": round(statistics.median(ratios), 3),
            "range": [round(min(ratios), 3), round(max(ratios), 3)],
        }
    result["memory_mib_by_round"] = {
        name: [each[name] for each in played]
        for name in ("VmRSS", "RssAnon", "RssFile", "VmHWM")
    }
    return result


def cold(folder: Path, batches: int) -> dict[str, float]:
    """Return what opening and a batch take with nothing in the page cache."""
    with (folder / "rows.bin").open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    begin = time.perf_counter()
    buffer = make_buffer("disk", 0, folder)
    opened = time.perf_counter()
    for _ in range(batches):
        buffer.sample()
    return {
        "seconds_to_open": opened - begin,
        "batches": batches,
        "ms_per_batch": (time.perf_counter() - opened) / batches * 1e3,
    }


def train(folder: Path) -> dict[str, Any]:
    """Run the example on the set and watch its memory."""
    script, run = ROOT / "examples" / "offline_osr.py", folder.with_name("run")
    command = [sys.executable, str(script), *TRAINING, f"data.path={folder}"]
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
    names = ("VmRSS", "RssAnon", "RssFile", "VmHWM")
    seen = [each for each in seen if len(each) == len(names)]
    return {
        "overrides": [*TRAINING, "data.path=<the set>"],
        "seconds": time.perf_counter() - begin,
        "largest_mib": {name: max(each[name] for each in seen) for name in names},
        "VmRSS_mib_over_time": [each["VmRSS"] for each in seen][:: len(seen) // 20],
    }


def machine() -> str:
    """Return processor, cores and memory."""
    text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    model = re.findall(r"model name\t: (.*)", text) or [platform.machine()]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{model[0]}, {os.cpu_count()} cores, {memory:.0f} GiB"


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
        result["cold"] = cold(folder, 40)
        with (folder / "rows.bin").open("rb") as file:  # into the page cache
            while file.read(2**24):
                pass
        counts = (arguments.rounds, arguments.batches)
        result["sampling"] = compare(arguments.rows, folder, *counts)
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
