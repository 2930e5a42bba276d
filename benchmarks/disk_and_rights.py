"""Full disks, read-only folders, missing rights: what does a run say and lose?

    unshare --map-root-user --mount python benchmarks/disk_and_rights.py --folder /tmp/d

Needs Linux: small file systems are mounted below ``--folder``. Every case is one run of
``torchrl-osr train`` that must fail with a message that names the place and the
cause, leave no part of a file behind that is later taken for a whole one, and end like
an undisturbed run, bit for bit, once the cause is gone. Writes
``results/reliability/disk_and_rights.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from same_run import differences

ROOT = Path(__file__).resolve().parents[1]
OUTPUT = ROOT / "results" / "reliability" / "disk_and_rights.json"
TRAIN = (
    "data=random",
    "data.num_transitions=20_000",
    "trainer.inverse_dynamics_steps=200",
    "trainer.steps=300",
    "trainer.eval_interval=300",
    "trainer.eval_episodes=2",
    "trainer.checkpoint_interval=100",
    "trainer.checkpoints_kept=2",
    "trainer.progress=false",
)
# Root may write everywhere, unless it gives that right away.
WITHOUT_RIGHTS = ("setpriv", "--bounding-set=-dac_override", "--inh-caps=-all")


def train(
    run: Path, cache: Path, before: tuple[str, ...] = ()
) -> subprocess.CompletedProcess[str]:
    """Start or continue a run; return its exit code and what it printed."""
    command = [*before, sys.executable, "-m", "torchrl_osr", "train", *TRAIN]
    command.append(f"hydra.run.dir={run}")
    environment = os.environ | {"TORCHRL_OSR_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        command,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )


@contextmanager
def small_disk(place: Path, megabytes: float) -> Iterator[Callable[[str], object]]:
    """Mount a file system of that size; yield how to mount it again otherwise."""
    place.mkdir(parents=True)
    size = f"size={int(megabytes * 2**20)}"
    subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", place], check=True)
    try:
        yield lambda options: subprocess.run(
            ["mount", "-o", f"remount,{options}", place], check=True
        )
    finally:
        subprocess.run(["umount", place], check=True)


def full_at_start(folder: Path, cache: Path) -> Iterator[tuple[Path, Path]]:
    """The run's disk is too small from the start."""
    with small_disk(folder / "disk", 1) as mount_again:
        yield folder / "disk" / "run", cache
        mount_again("size=64m")
        yield folder / "disk" / "run", cache


def full_for_the_data(folder: Path, cache: Path) -> Iterator[tuple[Path, Path]]:
    """The cache's disk is too small for the data."""
    with small_disk(folder / "disk", 0.5) as mount_again:
        yield folder / "run", folder / "disk" / "cache"
        mount_again("size=64m")
        yield folder / "run", folder / "disk" / "cache"


def full_in_the_middle(folder: Path, cache: Path) -> Iterator[tuple[Path, Path]]:
    """Something else fills the disk while the run trains: at its third checkpoint."""
    with small_disk(folder / "disk", 64):
        run = folder / "disk" / "run"
        first = run / "checkpoint" / "inverse_dynamics" / "checkpoint-000000000100"
        ballast = [folder / "disk" / "ballast"]
        filler = subprocess.Popen(
            [sys.executable, "-c", FILL, f"{first}.torchrl", str(ballast[0])]
        )
        yield run, cache
        filler.wait()
        ballast[0].unlink()
        yield run, cache


# Waits for a file, then fills the disk of another to its last page.
FILL = """
import os, sys, time
while not os.path.exists(sys.argv[1]):
    time.sleep(0.002)
with open(sys.argv[2], "wb", buffering=0) as ballast:
    size = 2**20
    while size:
        try:
            ballast.write(bytes(size))
        except OSError:
            size //= 2
"""


def read_only_run(folder: Path, cache: Path) -> Iterator[tuple[Path, Path]]:
    """The run's folder is on a disk that is mounted read-only."""
    with small_disk(folder / "disk", 64) as mount_again:
        mount_again("ro")
        yield folder / "disk" / "run", cache
        mount_again("rw")
        yield folder / "disk" / "run", cache


def read_only_cache(folder: Path, cache: Path) -> Iterator[tuple[Path, Path]]:
    """The cache is empty and read-only."""
    with small_disk(folder / "disk", 64) as mount_again:
        mount_again("ro")
        yield folder / "run", folder / "disk" / "cache"
        mount_again("rw")
        yield folder / "run", folder / "disk" / "cache"


def no_rights_to_run(folder: Path, cache: Path) -> Iterator[tuple[Path, Path]]:
    """The run's folder may be looked into, not written to."""
    run = folder / "run"
    run.mkdir(parents=True)
    run.chmod(0o500)
    yield run, cache
    run.chmod(0o700)
    yield run, cache


def no_rights_to_cache(folder: Path, cache: Path) -> Iterator[tuple[Path, Path]]:
    """The cache's folder may not even be looked into."""
    mine = folder / "cache"
    mine.mkdir(parents=True)
    mine.chmod(0o000)
    yield folder / "run", mine
    mine.chmod(0o700)
    yield folder / "run", mine


CASES = (
    full_at_start, full_for_the_data, full_in_the_middle, read_only_run,
    read_only_cache, no_rights_to_run, no_rights_to_cache,
)  # fmt: skip


def go_through(
    case: Callable[[Path, Path], Iterator[tuple[Path, Path]]],
    folder: Path,
    undisturbed: Path,
    cache: Path,
) -> dict[str, Any]:
    """Do one case: the run that must fail, and the one that must end right."""
    places = case(folder, cache)
    run, data = next(places)
    failed = train(run, data, WITHOUT_RIGHTS)
    run, data = next(places)
    ended = train(run, data)
    different = (
        differences(undisturbed, run) if ended.returncode == 0 else ["did not end"]
    )
    next(places, None)  # unmounts
    # Folders of this machine say nothing to a reader.
    output = failed.stdout.replace(str(folder), "<folder>")
    return {
        "case": (case.__doc__ or "").splitlines()[0],
        "exit_code": failed.returncode,
        "message": output.strip().splitlines()[-1],
        "exit_code_afterwards": ended.returncode,
        "different": different,
    }


def main() -> None:
    """Do the undisturbed run and every case, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    parser.add_argument("--cases", nargs="+", default=[])
    options = parser.parse_args()
    cache, undisturbed = options.folder / "cache", options.folder / "undisturbed"
    train(undisturbed, cache).check_returncode()
    results = []
    for case in CASES:
        if options.cases and case.__name__ not in options.cases:
            continue
        folder = options.folder / case.__name__
        results.append(go_through(case, folder, undisturbed, cache))
        print(json.dumps(results[-1], indent=1), flush=True)
    options.output.write_text(
        json.dumps({"train": TRAIN, "cases": results}, indent=1) + "\n",
        encoding="utf-8",
    )
    if not any(each["different"] or not each["exit_code"] for each in results):
        shutil.rmtree(options.folder)


if __name__ == "__main__":
    main()
