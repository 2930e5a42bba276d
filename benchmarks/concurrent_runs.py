"""Two processes that make one data set, a sweep of which jobs are killed: all right?

    python benchmarks/concurrent_runs.py --folder /tmp/c     # needs torchrl-osr[joblib]

Two processes ask for the same data set at once, with nothing cached; in every second
repetition the one that makes it is killed. Then a sweep of eight runs, two at a time,
in which two are killed with SIGKILL; the same command is given once more, and all
eight are compared, bit for bit, with those of a sweep that was left alone. Writes
``results/reliability/concurrent_runs.json``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from same_run import differences

ROOT = Path(__file__).resolve().parents[1]
OUTPUT = ROOT / "results" / "reliability" / "concurrent_runs.json"
ROWS = 30_000
SWEEP = (
    "-m", "seed=0,1,2,3,4,5,6,7", "hydra/launcher=pool", "data=random",
    "data.num_transitions=20_000", "trainer.inverse_dynamics_steps=200",
    "trainer.steps=400", "trainer.eval_interval=200", "trainer.eval_episodes=2",
    "trainer.checkpoint_interval=100", "trainer.progress=false",
)  # fmt: skip
LOAD = f"""
import sys
from torchrl_osr.lab.data import load_local_dataset
print("ready", flush=True)
sys.stdin.readline()
load_local_dataset("hopper", "medium-replay", num_transitions={ROWS}, progress=False)
"""


def environment(cache: Path) -> dict[str, str]:
    """Return the processes' environment, with the cache in its place."""
    return os.environ | {"TORCHRL_OSR_CACHE": str(cache), "OMP_NUM_THREADS": "1"}


def make_at_once(cache: Path, number: int, kill_after: float | None) -> str:
    """Make one data set in several processes; return the checksum of what is there."""
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", LOAD],
            env=environment(cache),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(number)
    ]
    for process in processes:
        assert process.stdout is not None
        process.stdout.readline()
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    if kill_after is not None:
        time.sleep(kill_after)
        # The one that holds the lock has had the CPU; the other one has waited.
        worker = max(processes, key=lambda each: cpu_seconds(each.pid))
        worker.kill()
        worker.wait()
        processes.remove(worker)
    codes = [process.wait() for process in processes]
    if any(codes):
        raise SystemExit(f"processes ended with {codes}")
    (file,) = cache.glob("rolled-out/*/manifest.json")  # has all checksums
    left = [each.name for each in file.parents[1].glob(".*")]
    if left:
        raise SystemExit(f"left behind: {left}")
    return hashlib.sha256(file.read_bytes()).hexdigest()


def cpu_seconds(pid: int) -> int:
    """Return the clock ticks that a process has used, as Linux tells."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return int(fields[11]) + int(fields[12])


def sweep(folder: Path, cache: Path) -> subprocess.Popen[bytes]:
    """Start, or continue, the sweep."""
    command = [sys.executable, "-m", "torchrl_osr", "train", *SWEEP]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_suffix(".txt").open("ab") as log:
        return subprocess.Popen(
            [*command, f"hydra.sweep.dir={folder}"],
            env=environment(cache),
            stdout=log,
            stderr=log,
        )


def kill_job(folder: Path, spared: list[str], rng: random.Random) -> str:
    """Kill a job of a running sweep at a random moment, none of ``spared``."""
    while True:
        time.sleep(rng.uniform(0.2, 1.0))
        running = {
            path.parent.name: status["pid"]
            for path in sorted(folder.glob("*/status.json"))
            if (status := json.loads(path.read_text()))["status"] == "running"
        }
        job = rng.choice([*running]) if running else ""
        if running and job not in spared:
            with suppress(ProcessLookupError):  # it has ended since
                os.kill(running[job], signal.SIGKILL)
                return job


def disturbed_sweep(folder: Path) -> dict[str, Any]:
    """Do a sweep that is left alone, and one of which two jobs are killed."""
    cache, alone, disturbed = (folder / each for each in ("cache", "alone", "killed"))
    if code := sweep(alone, cache).wait():
        raise SystemExit(f"the undisturbed sweep ended with {code}")
    killed: list[str] = []
    codes: list[int] = []
    rng = random.Random(0)
    while 0 not in codes and len(codes) < 4:
        process = sweep(disturbed, cache)
        if len(killed) < 2:
            # The pool gives up when a worker dies; a user starts the sweep again.
            killed.append(kill_job(disturbed, killed, rng))
        codes.append(process.wait())
    jobs = sorted(each for each in alone.iterdir() if each.is_dir())
    return {
        "jobs": len(jobs),
        "killed": [each.split("_")[0] for each in killed],
        "exit_codes": codes,
        "different": {
            job.name: found
            for job in jobs
            if (found := differences(job, disturbed / job.name))
        },
    }


def main() -> None:
    """Do both, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--repetitions", type=int, default=6)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    folder = options.folder.resolve()
    alone = make_at_once(folder / "once", 1, None)
    checksums = [
        make_at_once(folder / f"at_once{index}", 2, (None, 1.5)[index % 2])
        for index in range(options.repetitions)
    ]
    result: dict[str, Any] = {
        "one_data_set_made_at_once": {
            "repetitions": options.repetitions,
            "with_its_maker_killed": options.repetitions // 2,
            "different": sum(each != alone for each in checksums),
        },
        "sweep": disturbed_sweep(folder / "sweep"),
        "overrides": SWEEP,
    }
    print(json.dumps(result, indent=1))
    options.output.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    if not result["sweep"]["different"]:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
