"""Damage checkpoints and cached data at random: is all of it found, is any of it used?

    python benchmarks/damaged_files.py --damages 100 --folder /tmp/damage

Three kinds of file (a run's newest checkpoint, a cached data set, a data set on disk)
are damaged in five ways: cut off, one bit flipped, a block zeroed, a block of random
bytes, emptied. Each time the package is asked to go on as if nothing had happened. It
must say what is wrong, by the file's name, and must end with what it would have had
without the file, or not at all. Writes ``results/reliability/damaged_files.json``.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from tensordict import TensorDict
from torchrl import torchrl_logger
from torchrl.objectives import SoftUpdate

from torchrl_osr import OSRLoss, StatePerturbation
from torchrl_osr.data import (
    load_local_dataset,
    load_memmap,
    make_replay_buffer,
    write_memmap,
)
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.trainers import OfflineTrainer

OUTPUT = Path(__file__).resolve().parents[1] / "results/reliability/damaged_files.json"
ROWS = 2000


class Subject(NamedTuple):
    """One kind of file.

    Attributes:
        name: for the table.
        make: writes whole files into a folder.
        files: those to be damaged, a pattern below the folder.
        use: goes on from a folder; returns what came of it.
    """

    name: str
    make: Callable[[Path], object]
    files: str
    use: Callable[[Path], Any]


def checkpoints() -> Subject:
    """A trainer's newest checkpoint; it must go on from the one before."""
    data, _ = load_local_dataset("hopper", "random", num_transitions=ROWS)

    def trainer(folder: Path, steps: int) -> OfflineTrainer:
        torch.manual_seed(0)
        sizes, cells = (11, 3), [8]
        loss = OSRLoss(
            tanh_gaussian_actor(*sizes, num_cells=cells),
            critic_ensemble(*sizes, num_cells=cells, num_qvalue_nets=2),
            tanh_gaussian_inverse_dynamics(*sizes, num_cells=cells),
            num_random=2,
        )
        noise = StatePerturbation(std=1e-3)
        buffer = make_replay_buffer(data, batch_size=8, seed=0, transform=noise)
        return OfflineTrainer(
            loss, torch.optim.Adam(loss.parameters()), buffer, steps, folder,
            target_net_updater=SoftUpdate(loss, tau=0.01), eval_interval=10,
            components={"perturbation": noise}, checkpoints_kept=3, progress=False,
        )  # fmt: skip

    def use(folder: Path) -> Any:
        # To the end, whatever it begins with: the same bits.
        ends = trainer(folder, 40)
        ends.train()
        return dict(ends.loss_module.state_dict())

    def make(folder: Path) -> None:
        trainer(folder, 30).train()

    return Subject("newest checkpoint", make, "checkpoint-*30.torchrl", use)


def cached_set() -> Subject:
    """A cached data set: it must be collected anew."""

    def use(folder: Path) -> Any:
        data, manifest = load_local_dataset(
            "hopper", "random", num_transitions=ROWS, cache_dir=folder, progress=False
        )
        return data, manifest

    return Subject("cached data set", use, "rolled-out/*/*.*", use)


def rows(number: int) -> TensorDict:
    """Return synthetic transitions."""
    generator = torch.Generator().manual_seed(number)

    def draw(size: int) -> torch.Tensor:
        return torch.rand(100, size, generator=generator)

    no = torch.zeros(100, 1, dtype=torch.bool)
    after = {"observation": draw(11), "reward": draw(1)}
    after |= {"done": no, "terminated": no, "truncated": no}
    before = {"observation": draw(11), "action": draw(3)}
    return TensorDict(before | {"next": TensorDict(after, [100])}, [100])


def memory_mapped() -> Subject:
    """A data set on disk that was written by hand: it must be refused."""

    def make(folder: Path) -> None:
        write_memmap(map(rows, range(10)), folder / "set", progress=False)

    def use(folder: Path) -> Any:
        data, manifest = load_memmap(folder / "set")
        return data.clone(), manifest

    return Subject("data set on disk", make, "set/*", use)


def damage(path: Path, rng: random.Random) -> str:
    """Damage a file in one of five ways; return which."""
    content = bytearray(path.read_bytes())
    way = rng.choice(("cut", "bit", "zeros", "noise", "empty"))
    at = rng.randrange(len(content))
    if way == "cut":
        del content[at:]
    elif way == "bit":
        content[at] ^= 1 << rng.randrange(8)
    elif way == "empty":
        content.clear()
    else:
        size = min(512, len(content) - at)
        fresh = bytes(size) if way == "zeros" else rng.randbytes(size)
        content[at : at + size] = fresh
    if bytes(content) == path.read_bytes():
        return damage(path, rng)  # zeros over zeros are no damage
    path.write_bytes(content)
    return way


def same(one: Any, other: Any) -> bool:
    """Return whether two results are equal, bit for bit."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, TensorDict):
        return bool((one == other).all())
    if isinstance(one, (tuple, list)):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    return bool(one == other)


def outcome(subject: Subject, folder: Path, file: Path, right: Any) -> str:
    """Go on from a folder with a damaged file; return in a word what came of it."""
    with patch.object(torchrl_logger, "warning") as warning:
        try:
            result = subject.use(folder)
        except (OSError, ValueError) as error:
            return "refused by name" if file.name in str(error) else "REFUSED"
    if not same(result, right):
        return "WRONG"
    return "found, and done without it" if warning.called else "NOT FOUND"


def main() -> None:
    """Damage, use, count, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--damages", type=int, default=100, help="of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    torchrl_logger.setLevel("WARNING")
    rng = random.Random(options.seed)
    counts: dict[str, dict[str, int]] = {}
    for subject in (checkpoints(), cached_set(), memory_mapped()):
        whole = options.folder / subject.name.replace(" ", "_")
        subject.make(whole)
        right = subject.use(shutil.copytree(whole, options.folder / "right"))
        shutil.rmtree(options.folder / "right")
        count: Counter[str] = Counter()
        for _ in range(options.damages):
            folder = shutil.copytree(whole, options.folder / "damaged")
            file = rng.choice(sorted(folder.glob(subject.files)))
            way = damage(file, rng)
            result = outcome(subject, folder, file, right)
            count[result] += 1
            if result.isupper():
                print(f"{subject.name}: {file.name}, {way}: {result}")
            shutil.rmtree(folder)
        counts[subject.name] = dict(sorted(count.items()))
        print(f"{subject.name}: {counts[subject.name]}", flush=True)
    options.output.write_text(json.dumps(counts, indent=1) + "\n", encoding="utf-8")
    shutil.rmtree(options.folder)


if __name__ == "__main__":
    main()
