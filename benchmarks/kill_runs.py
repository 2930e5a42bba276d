"""Kill a run again and again at random moments: is anything lost, is a bit different?

    python benchmarks/kill_runs.py --kills 50 --folder /tmp/kills

One run is left alone. Another, of the same configuration, is started by the same two
commands (train, then evaluate) whenever it has been killed with SIGKILL, from the
first roll-out of its data to the last disturbed episode, until it ends. If that takes
fewer kills than asked for, one more run is begun. Writes
``results/reliability/kills.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

from same_run import differences, file_names

ROOT = Path(__file__).resolve().parents[1]
OUTPUT = ROOT / "results" / "reliability" / "kills.json"
TRAIN = (
    "data.num_transitions=100_000",
    "trainer.steps=6000",
    "trainer.eval_interval=2000",
    "trainer.eval_episodes=4",
    "trainer.checkpoint_interval=200",
    "trainer.progress=false",
)
EVALUATE = ("suite=torque", "last=2", "episodes=4", "progress=false")
PHASES = ("inverse_dynamics", "policy")
FOR_EVALUATION = 6  # of the kills: it is short, and comes last


class Run:
    """One run with data of its own: how far it is, and the command that it needs.

    Args:
        folder: of its data and of its results.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "run"
        self.cache = folder / "cache"
        self.environment = os.environ | {
            "TORCHRL_OSR_CACHE": str(self.cache),
            "OMP_NUM_THREADS": "1",
        }

    @property
    def trained(self) -> bool:
        """Whether the policy is there."""
        status = self.folder / "status.json"
        return status.exists() and json.loads(status.read_text())["status"] == "done"

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""
        return (self.folder / "robustness-torque.png").exists()

    def start(self, log: Path) -> subprocess.Popen[bytes]:
        """Start the command that comes next."""
        command = ["train", *TRAIN, f"hydra.run.dir={self.folder}"]
        if self.trained:
            command = ["evaluate", *EVALUATE, f"checkpoint={self.folder}"]
        with log.open("ab") as file:
            return subprocess.Popen(
                [sys.executable, "-m", "torchrl_osr", *command],
                env=self.environment,
                stdout=file,
                stderr=file,
            )

    def phase(self) -> str:
        """Return what is being worked on, as the files tell."""
        if self.trained:
            return "evaluation"
        if not list(self.cache.glob("rolled-out/*/manifest.json")):
            return "start" if not self.cache.exists() else "collection"
        policy = (self.folder / "checkpoint" / "policy").exists()
        return PHASES[policy]

    def newest(self, phase: str) -> int:
        """Return the step of the newest checkpoint of a phase, or 0."""
        found = (self.folder / "checkpoint" / phase).glob("checkpoint-*.torchrl")
        return max((int(each.stem.split("-")[1]) for each in found), default=0)

    def logged(self, phase: str) -> list[int]:
        """Return the steps of a loss's log entries, in the order they were written."""
        files = sorted((self.folder / "csv" / "scalars" / phase).glob("loss_*.csv"))
        lines = files[0].read_text().splitlines() if files else []
        return [int(float(line.split(",")[0])) for line in lines if line[:1].isdigit()]


def live(run: Run, log: Path, seconds: float | None) -> dict[str, Any] | None:
    """Start what comes next; kill it after ``seconds`` and say where it was.

    Returns:
        ``None`` if it ended by itself before.
    """
    before = {phase: run.newest(phase) for phase in PHASES}
    rows = {phase: len(run.logged(phase)) for phase in PHASES}
    process = run.start(log)
    try:
        code = process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        code = None
    if code:
        raise SystemExit(f"a run ended with code {code}, see {log}")
    # Where it went on: the step before the first new entry's updates.
    resumed = {
        phase: new[0] - 200
        for phase in PHASES
        if (new := run.logged(phase)[rows[phase] :])
    }
    lost = {
        phase: before[phase] - step
        for phase, step in resumed.items()
        if step < before[phase]
    }
    if lost:
        raise SystemExit(f"steps lost beyond the last checkpoint: {lost}, see {log}")
    if code == 0:
        return None
    return {
        "after_seconds": round(seconds or 0.0, 2),
        "phase": run.phase(),
        "newest_checkpoint": {phase: run.newest(phase) for phase in PHASES},
        "went_on_from": resumed,
    }


def kill_until_done(
    run: Run, log: Path, kills: int, longest: float, rng: random.Random
) -> list[dict[str, Any]]:
    """Kill a run at random moments, at most ``kills`` times, and let it end."""
    killed: list[dict[str, Any]] = []
    while not run.finished:
        left = kills - len(killed) - (0 if run.trained else FOR_EVALUATION)
        seconds = rng.uniform(0, longest) if left > 0 else None
        entry = live(run, log, seconds)
        if entry is not None:
            killed.append(entry)
            print(f"kill {len(killed)}: {entry}", flush=True)
    return killed


def main() -> None:
    """Do both runs, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--longest", type=float, default=25.0, help="seconds of a life")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    undisturbed = Run(options.folder / "undisturbed")
    options.folder.mkdir(parents=True, exist_ok=True)
    log = options.folder / "output.txt"
    begin = time.perf_counter()
    kill_until_done(undisturbed, log, 0, 0.0, random.Random())
    seconds = time.perf_counter() - begin
    rng = random.Random(options.seed)
    killed: list[dict[str, Any]] = []
    runs, different = 0, []
    while len(killed) < options.kills:
        run = Run(options.folder / f"killed{runs}")
        left = options.kills - len(killed)
        killed += kill_until_done(run, log, left, options.longest, rng)
        different += differences(undisturbed.folder, run.folder)
        runs += 1
    result = {
        "kills": len(killed),
        "runs": runs,
        "kills_in": dict(Counter(each["phase"] for each in killed)),
        "steps_lost_beyond_the_last_checkpoint": 0,  # else it has ended above
        "compared": file_names(undisturbed.folder),
        "different": different,
        "seconds_undisturbed": round(seconds, 1),
        "train": TRAIN,
        "evaluate": EVALUATE,
        "each": killed,
    }
    options.output.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print({key: result[key] for key in ("kills", "kills_in", "different")})
    if not different:
        shutil.rmtree(options.folder)


if __name__ == "__main__":
    main()
