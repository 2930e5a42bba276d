"""Damage or forge files of every kind that is read: is all of it found, is any used?

    python benchmarks/damaged_files.py --files 1000 --folder /tmp/damage

Each file is whole at first and is then damaged (cut off, emptied, one bit, zeros,
noise) or forged as somebody hostile would: with code to be run, paths that lead out, a
pipe in its place, sizes that fill the memory, numbers of the wrong kind. The package is
asked to go on as if nothing had happened, under an audit hook that notes what Python
opens outside of the folder, starts or connects to. Writes
``results/reliability/damaged_files.json``.

Where a format has no checksum, a changed number cannot be told from data: JSON, YAML,
HDF5, Parquet and Minari's files are not changed bit by bit.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import platform
import random
import re
import shutil
import signal
import sys
import tempfile
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from forgeries import EVERYWHERE, MARKER
from kinds_of_files import Subject, all_kinds
from tensordict import TensorDict
from torchrl import torchrl_logger
from torchrl.checkpoint import CheckpointError

OUTPUT = Path(__file__).resolve().parents[1] / "results/reliability/damaged_files.json"
SECONDS = 60
"""After so many a file counts as one that makes the package wait for ever."""

CURE = re.compile(
    r"\b(allow|choose|delete|expected|fetch|give|must|remove|rename|say|store|take|write)\b",
    re.IGNORECASE,
)
"""Words of which a refusal has one: what to do, or what there should have been."""


def damage(path: Path, way: str, rng: random.Random) -> None:
    """Damage a file in one way."""
    before = path.read_bytes()
    content = bytearray(before)
    at = rng.randrange(min(len(content), 64) if way == "head" else len(content))
    if way == "cut":
        del content[at:]
    elif way == "empty":
        content.clear()
    elif way == "bit":
        content[at] ^= 1 << rng.randrange(8)
    else:
        size = min(512, len(content) - at)
        content[at : at + size] = bytes(size) if way == "zeros" else rng.randbytes(size)
    path.write_bytes(content)
    if bytes(content) == before:  # zeros over zeros
        damage(path, "cut", rng)


def same(one: Any, other: Any) -> bool:
    """Return whether two results are equal, bit for bit."""
    if isinstance(one, torch.Tensor):
        return one.shape == other.shape and torch.equal(one, other)
    if isinstance(one, TensorDict):
        return one.batch_size == other.batch_size and bool((one == other).all())
    if isinstance(one, (tuple, list)):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    return bool(one == other)


class Watch:
    """Notes what is opened outside of a folder, started or connected to."""

    EFFECTS = (
        *("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen"),
        *("socket.connect", "os.remove", "os.rename", "os.rmdir", "shutil.rmtree"),
    )

    def __init__(self) -> None:
        self.folder: Path | None = None
        self.effects: list[str] = []
        sys.addaudithook(self._note)

    def _note(self, event: str, arguments: tuple[Any, ...]) -> None:
        folder = self.folder
        if folder is None:
            return
        path = str(arguments[0]) if arguments else ""
        if "/" not in path and event in ("open", "os.remove", "os.rmdir"):
            return  # of shutil.rmtree, whose own folder is noted: below an open folder
        allowed = (str(folder), *LIBRARIES)
        if event == "open":
            writes = set(str(arguments[1] or "r")) & set("wax+")
            allowed = (str(folder), str(OWN_TEMPORARY)) if writes else allowed
            if isinstance(arguments[0], int) or path.startswith(allowed):
                return
            self.effects.append(f"{event} {path}")
        elif event in self.EFFECTS and not path.startswith(
            (*allowed, str(OWN_TEMPORARY))
        ):
            self.effects.append(f"{event} {path}")


OWN_TEMPORARY = Path(tempfile.gettempdir()) / f"torchrl-osr-own-{os.getpid()}"
"""What libraries unpack into, which is this process's own."""

LIBRARIES = (
    *(sys.prefix, sys.base_prefix, "/proc", "/sys", "/dev/null", "/usr", "/lib"),
    *(str(OWN_TEMPORARY), str(Path(__file__).resolve().parents[1])),
)


class TooLongError(BaseException):
    """No exception that anybody takes for one of the file's."""


def outcome(subject: Subject, folder: Path, file: Path, right: Any) -> tuple[str, str]:
    """Go on from a folder with a bad file; what came of it, and what was said."""

    def too_long(*_: Any) -> None:
        raise TooLongError

    signal.signal(signal.SIGALRM, too_long)
    signal.alarm(SECONDS)
    said, result, refused = io.StringIO(), None, False
    try:
        with (
            patch.object(torchrl_logger, "warning") as warning,
            patch("torchrl_osr.trainers.checkpoints.log.warning", warning),
            redirect_stdout(said),
            redirect_stderr(said),
        ):
            try:
                result = subject.use(folder)
            except TooLongError:
                return "WAITS FOR EVER", ""
            except (OSError, ValueError, CheckpointError) as error:
                message, refused = str(error), True
            except BaseException as error:
                return "UNEXPECTED", f"{type(error).__name__}: {error}"
            else:
                message = " ".join(str(call.args[0]) for call in warning.call_args_list)
    finally:
        signal.alarm(0)
    if not refused and not same(result, right):
        return "USED WRONGLY", message
    if not refused and not message:
        return "the same without it", ""
    named = file.name in message or str(folder) in message
    if not named or (refused and not CURE.search(message)):
        return "NO SENTENCE", message
    return "refused by name" if refused else "done without it, and said", message


def main() -> None:
    """Damage and forge, use, count, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--only", default="", help="kinds whose name has this")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(1)
    OWN_TEMPORARY.mkdir()
    tempfile.tempdir = str(OWN_TEMPORARY)
    rng, watch = random.Random(options.seed), Watch()
    options.folder.mkdir(parents=True)
    subjects = all_kinds(options.folder / "finished")
    subjects = [each for each in subjects if options.only in each.name]
    counts: dict[str, dict[str, int]] = {}
    effects: list[str] = []
    for number, subject in enumerate(subjects):
        whole = options.folder / "whole"
        subject.make(whole)
        here = options.folder / "here"
        right = subject.use(shutil.copytree(whole, here))
        shutil.rmtree(here)
        count: Counter[str] = Counter()
        share = range(number, options.files, len(subjects))
        for turn in range(len(share)):
            shutil.copytree(whole, here)
            file = rng.choice(sorted(here.glob(subject.files)))
            forgeries = (*subject.forgeries, *EVERYWHERE)
            if turn % 2:
                forge = forgeries[turn // 2 % len(forgeries)]
                way = forge.__name__
                forge(file, rng)
            else:
                way = subject.ways[turn // 2 % len(subject.ways)]
                damage(file, way, rng)
            watch.folder, watch.effects = here, []
            result, message = outcome(subject, here, file, right)
            watch.folder = None
            if MARKER.exists():
                watch.effects.append("code of the file was run")
                MARKER.rmdir()
            effects += watch.effects
            count[result] += 1
            if result.isupper() or watch.effects:
                print(f"{subject.name}: {file.name}, {way}: {result}: {message[:300]}")
                print(*(f"    {each}" for each in watch.effects), sep="\n")
            shutil.rmtree(here)
        shutil.rmtree(whole)
        counts[subject.name] = dict(sorted(count.items()))
        print(f"{subject.name}: {counts[subject.name]}", flush=True)
    shutil.rmtree(OWN_TEMPORARY)
    shutil.rmtree(options.folder)
    totals: Counter[str] = Counter()
    for each in counts.values():
        totals.update(each)
    results = {
        "machine": f"{platform.platform()}, Python {platform.python_version()}, "
        f"torch {torch.__version__}",
        "files": sum(totals.values()),
        "totals": dict(sorted(totals.items())),
        "foreign effects": len(effects),
        "kinds": counts,
    }
    options.output.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(results["totals"]), "foreign effects:", len(effects))


if __name__ == "__main__":
    main()
