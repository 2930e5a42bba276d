"""Runs in processes of their own, some at a time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from torchrl_osr.trainers.run_folder import STATUS

LOG = "output.log"


def train_in_processes(
    script: Path | str, folders: Sequence[Path], at_once: int
) -> None:
    """Do the run of each folder in a process of its own, and print what it printed.

    All are stopped when this is broken off. One that fails does not stop the others.

    Args:
        script: does one run with ``resume=<folder>``.
        folders: each with a run's ``config.yaml``.
        at_once: how many at a time; at least one.

    Raises:
        RuntimeError: at the end, naming the runs that failed; or at the start, if one
            of them is still being done by a process that was left behind.
    """
    for folder in folders:
        _check_not_running(folder)
    waiting = list(folders)
    running: dict[Path, subprocess.Popen[bytes]] = {}
    failed: list[Path] = []
    try:
        while waiting or running:
            while waiting and len(running) < max(at_once, 1):
                folder = waiting.pop(0)
                running[folder] = _start(script, folder)
            time.sleep(0.1)
            for folder, process in list(running.items()):
                if process.poll() is None:
                    continue
                del running[folder]
                print(f"\n{folder}:\n{(folder / LOG).read_text(encoding='utf-8')}")
                if process.returncode:
                    failed.append(folder)
    finally:
        for process in running.values():
            process.terminate()
            process.wait()
    if failed:
        raise RuntimeError(
            f"{len(failed)} of {len(folders)} members failed, see {STATUS} and {LOG} "
            f"in {', '.join(map(str, failed))}."
        )


def _start(script: Path | str, folder: Path) -> subprocess.Popen[bytes]:
    quoted = str(folder.resolve()).replace("\\", "\\\\").replace("'", "\\'")
    # Hydra's own files in the folder say how the run came about; keep them.
    options = [f"resume='{quoted}'", "hydra.output_subdir=null"]
    with (folder / LOG).open("wb") as log:
        return subprocess.Popen(
            [sys.executable, str(script), *options], stdout=log, stderr=log
        )


def _check_not_running(folder: Path) -> None:
    """Raise if a process that outlived its parent still writes into a folder."""
    path = folder / STATUS
    if not path.exists():
        return
    there = json.loads(path.read_text(encoding="utf-8"))
    if there["status"] != "running" or not _is_alive(there["pid"]):
        return
    raise RuntimeError(
        f"{folder} is still being worked on by process {there['pid']}: wait for its "
        f"end or end it. If that is another program by now, remove {path}."
    )


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # somebody else's
        return True
    return True
