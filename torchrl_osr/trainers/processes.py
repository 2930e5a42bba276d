"""Runs in processes of their own, some at a time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from torchrl_osr.experiment.run_folder import STATUS
from torchrl_osr.trainers.preemption import EX_TEMPFAIL, Preempted, sigterm_noted

LOG = "output.log"


def train_in_processes(
    script: Path | str, folders: Sequence[Path], at_once: int
) -> None:
    """Do the run of each folder in a process of its own, and print what it printed.

    All are stopped when this is broken off. One that fails does not stop the others.
    SIGTERM is passed on: each saves its run and ends, and then so does this.

    Args:
        script: does one run with ``resume=<folder>``.
        folders: each with a run's ``config.yaml``.
        at_once: how many at a time; at least one.

    Raises:
        RuntimeError: at the end, naming the runs that failed; or at the start, if one
            of them is still being done by a process that was left behind.
        Preempted: if a run was, and none has failed.
    """
    for folder in folders:
        _check_not_running(folder)
    waiting = list(folders)
    running: dict[Path, subprocess.Popen[bytes]] = {}
    codes: dict[Path, int] = {}
    passed_on = False
    with sigterm_noted() as termination, _ended(running):
        while waiting or running:
            if termination.asked and not passed_on:
                passed_on = True
                waiting.clear()
                for process in running.values():
                    process.terminate()
            while waiting and len(running) < max(at_once, 1):
                folder = waiting.pop(0)
                running[folder] = _start(script, folder)
            time.sleep(0.1)
            for folder, process in list(running.items()):
                if process.poll() is None:
                    continue
                codes[folder] = running.pop(folder).returncode
                print(f"\n{folder}:\n{(folder / LOG).read_text(encoding='utf-8')}")
    # Killed before its handler was there, or after it had saved: nothing was lost.
    early = -signal.SIGTERM if termination.asked else EX_TEMPFAIL
    failed = [each for each in codes if codes[each] not in (0, EX_TEMPFAIL, early)]
    if failed:
        raise RuntimeError(
            f"{len(failed)} of {len(folders)} members failed, see {STATUS} and {LOG} "
            f"in {', '.join(map(str, failed))}."
        )
    if termination.asked or any(codes.values()):
        raise Preempted(f"{script}: members were stopped by SIGTERM, and are saved.")


@contextmanager
def _ended(running: Mapping[Path, subprocess.Popen[bytes]]) -> Iterator[None]:
    """Let no process outlive this."""
    try:
        yield
    finally:
        for process in running.values():
            process.terminate()
            process.wait()


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
