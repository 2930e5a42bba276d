"""Kill a run with SIGKILL, resume it, and compare it with one that was left alone.

    python results/first_run/kill_and_resume.py UNDISTURBED KILLED [override ...]

``UNDISTURBED`` is the folder of a finished run; ``KILLED`` is a new folder, in which
the same run (give the same overrides) is started, killed three times and resumed.
Prints where it was killed and, at the end, which parts of the two runs are equal.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

TRAIN = [sys.executable, "-m", "torchrl_osr", "train"]


def run_until(folder: Path, arguments: list[str], phase: str, step: int, wait: float):
    """Start or resume the run and kill it ``wait`` seconds after a checkpoint."""
    process = subprocess.Popen([*TRAIN, *arguments])
    checkpoint = folder / "checkpoint" / phase / f"checkpoint-{step:012d}.torchrl"
    while not checkpoint.exists():
        if process.poll() is not None:
            raise SystemExit(f"the run ended before {checkpoint} was written")
        time.sleep(0.05)
    time.sleep(wait)
    process.kill()
    process.wait()
    print(f"killed {wait} s after {phase} step {step}", flush=True)


def last_checkpoint(folder: Path) -> dict[str, Any]:
    """Return every state of the newest policy checkpoint, flat, by component."""
    newest = max((folder / "checkpoint" / "policy").glob("checkpoint-*.torchrl"))
    states = {}
    with zipfile.ZipFile(newest) as archive:
        manifest = json.loads(archive.read("manifest.json"))
        for name, record in manifest["components"].items():
            if f"{record['path']}/state.pt" in archive.namelist():
                content = io.BytesIO(archive.read(f"{record['path']}/state.pt"))
                states[name] = torch.load(content, weights_only=True)
    # Python's and NumPy's generators are saved too, but nothing here draws from them
    # and they are not seeded.
    states["global_rng"] = states["global_rng"]["torch_cpu"]
    return {name: flat(name, state) for name, state in states.items()}


def flat(name: str, value: Any) -> dict[str, Any]:
    """Return nested state as one mapping."""
    if isinstance(value, (list, tuple)):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        return {name: value}
    result: dict[str, Any] = {}
    for key, item in value.items():
        result |= flat(f"{name}/{key}", item)
    return result


def same(mine: Any, theirs: Any) -> bool:
    """Return whether two states are equal bit for bit."""
    return torch.equal(mine, theirs) if torch.is_tensor(mine) else mine == theirs


def main(undisturbed: Path, killed: Path, overrides: list[str]) -> None:
    """Kill in the first phase, early and late in the second, then compare."""
    cfg = OmegaConf.load(undisturbed / "config.yaml")
    every = cfg.trainer.checkpoint_interval
    middle = cfg.trainer.steps // 2 // every * every
    resume = [f"resume={killed}"]
    first = [*overrides, f"hydra.run.dir={killed}"]
    run_until(killed, first, "inverse_dynamics", every, 1.3)
    run_until(killed, resume, "policy", every, 1.7)
    run_until(killed, resume, "policy", middle, 0.4)
    subprocess.run([*TRAIN, *resume], check=True)
    mine, theirs = last_checkpoint(killed), last_checkpoint(undisturbed)
    for name, state in theirs.items():
        equal = mine[name].keys() == state.keys() and all(
            same(mine[name][key], value) for key, value in state.items()
        )
        print(f"{name}: {len(state)} entries {'equal' if equal else 'DIFFERENT'}")
    for name in ("returns.json", "inverse_dynamics.json"):
        contents = [
            json.loads((each / name).read_text()) for each in (killed, undisturbed)
        ]
        equal = contents[0] == contents[1]
        print(f"{name}: {'equal' if equal else 'DIFFERENT'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]).absolute(), sys.argv[3:])
