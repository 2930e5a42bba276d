"""Checkpoints that are whole, and that cannot run code when loaded.

They are :mod:`torchrl.checkpoint` archives: one ZIP file each, every member with a
checksum. Three things are added. The payload is only read with ``weights_only=True``
(TorchRL 0.14.1 unpickles files beside a memory-mapped tensordict). Files are synced
before they are renamed and are never missing in between (TorchRL first moves the old
one aside). A damaged newest file is skipped.
"""

from __future__ import annotations

import logging
import os
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointAdapter,
    CheckpointError,
    GlobalRNGState,
)
from torchrl.data import PrioritizedSampler

log = logging.getLogger(__name__)


class GlobalGenerators(GlobalRNGState):
    """Global random generators; those of devices that are not here are left out."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue the generators of this machine."""
        here = self.state_dict()
        state = {name: each for name, each in state_dict.items() if name in here}
        if "torch_cuda" in state:  # one for each GPU
            state["torch_cuda"] = state["torch_cuda"][: len(here["torch_cuda"])]
        super().load_state_dict(state)


class UnfitCheckpointError(CheckpointError):
    """A whole checkpoint is of another run than the one that asks for it."""


class WeightsOnlyAdapter(CheckpointAdapter):
    """Saves ``state_dict()`` with :func:`torch.save`, loads it weights only."""

    adapter_id = "torchrl_osr.weights_only"
    filename = "state.pt"

    def save(self, component: Any, path: Path, **_: Any) -> None:
        path.mkdir(parents=True, exist_ok=True)
        # Given a path, torch.save turns an error of the disk into a RuntimeError.
        with (path / self.filename).open("wb") as file:
            torch.save(component.state_dict(), file)

    def load(self, component: Any, path: Path, *, map_location: Any, **_: Any) -> None:
        file = path / self.filename
        state = torch.load(file, map_location=map_location, weights_only=True)
        if isinstance(component, torch.nn.Module):
            _check_fits(component.state_dict(), state)
        component.load_state_dict(state)


def _check_fits(here: Mapping[str, Any], there: Mapping[str, Any]) -> None:
    """Raise before anything is overwritten; tensordict's own error names no shapes."""
    shapes, saved = (
        {key: tuple(each.shape) for key, each in state.items() if torch.is_tensor(each)}
        for state in (here, there)
    )
    for key in sorted(shapes.keys() | saved.keys()):
        ours, theirs = (each.get(key, "missing") for each in (shapes, saved))
        if ours != theirs:
            raise ValueError(f"{key} is {theirs} in the file, {ours} here.")


class SamplerState:
    """The draws that a replay buffer makes next, checkpointable.

    The generator, and the order of a sampler without replacement or the priorities of a
    prioritised one.
    """

    def __init__(self, buffer: Any, generator: torch.Generator) -> None:
        self.buffer, self.generator = buffer, generator
        self.sampler: Any = getattr(buffer, "sampler", None)

    def state_dict(self) -> dict[str, Any]:
        state: dict[str, Any] = {"generator": self.generator.get_state()}
        if isinstance(self.sampler, PrioritizedSampler):
            rows = torch.arange(len(self.buffer))
            state["priorities"] = torch.as_tensor(self.sampler._sum_tree[rows])
            state["max_priority"] = self.sampler._max_priority
            for name in ("alpha", "beta"):  # schedulers may move them
                state[name] = float(getattr(self.sampler, name))
        elif self.sampler is not None:
            state["sampler"] = dict(self.sampler.state_dict())
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        self.generator.set_state(state_dict["generator"].cpu())
        if "priorities" in state_dict:
            sampler, priorities = self.sampler, state_dict["priorities"]
            rows = torch.arange(len(priorities))
            sampler._sum_tree[rows] = sampler._min_tree[rows] = priorities
            sampler._max_priority = state_dict["max_priority"]
            sampler._alpha, sampler.beta = state_dict["alpha"], state_dict["beta"]
        elif state_dict.get("sampler"):
            self.sampler.load_state_dict(state_dict["sampler"])


def safe_checkpoint(**components: Any) -> Checkpoint:
    """Return a checkpoint of ``components``: one archive without pickled objects.

    A component has ``state_dict`` and ``load_state_dict``, or is JSON-compatible (lists
    and mappings are restored in place).
    """
    checkpoint = Checkpoint(format="archive")
    for name, component in components.items():
        adapter = WeightsOnlyAdapter() if hasattr(component, "state_dict") else None
        checkpoint.register(name, component, adapter=adapter)
    return checkpoint


def find_damage(path: Path) -> str | None:
    """Describe a checkpoint's damage; return ``None`` if it is whole."""
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except Exception as error:  # zipfile raises a dozen kinds
        return str(error) or repr(error)
    return f"wrong checksum of {damaged}" if damaged else None


class Checkpoints:
    """The checkpoints of one training run, in a folder of its own.

    ``checkpoint-<step>.torchrl`` are the newest; ``best.torchrl`` has the model of the
    best evaluation. Of those at multiples of ``interval`` the newest ``kept`` stay, and
    the newest of all.
    """

    def __init__(
        self, folder: Path | str, components: dict[str, Any], interval: int, kept: int
    ) -> None:
        self.folder, self.interval, self.kept = Path(folder), interval, kept
        self.best_path = self.folder / "best.torchrl"
        self._checkpoint = safe_checkpoint(**components)

    def latest(self) -> Path | None:
        """Return the path of the newest checkpoint, or ``None``."""
        return max(self._found(), default=None)

    def _found(self) -> list[Path]:
        return sorted(self.folder.glob("checkpoint-*.torchrl"))

    def save(self, step: int) -> None:
        """Write the checkpoint of a step, and remove those that are outdated."""
        self.write(self.folder / f"checkpoint-{step:012d}.torchrl")
        self._remove_outdated()

    def write(self, path: Path, **options: Any) -> None:
        """Write a checkpoint with these options of TorchRL's ``Checkpoint.save``."""
        if not self.folder.is_dir():  # TorchRL would make it again
            raise FileNotFoundError(f"{self.folder} was removed or renamed.")
        beside = path.with_name(f".{path.name}.new")
        self._checkpoint.save(beside, **options)
        with beside.open("r+b") as file:  # Windows refuses to sync what is read
            os.fsync(file.fileno())
        os.replace(beside, path)

    def _remove_outdated(self) -> None:
        """Keep the newest regular ones, and the newest of all.

        An interrupted run's checkpoint lies between two regular ones and stays until
        the next: a continued run ends up with the files of an undisturbed one.
        """
        found = self._found()
        regular = [x for x in found if int(x.stem.split("-")[1]) % self.interval == 0]
        for path in set(found) - {*regular[::-1][: self.kept], *found[-1:]}:
            path.unlink()

    def restore(self) -> Path | None:
        """Restore the newest undamaged checkpoint; return its path, if there is one.

        Newer damaged ones become ``.damaged``. Half-written files of a killed process
        are removed: only one run uses a folder.

        Raises:
            CheckpointError: if a checkpoint does not fit the components, or every one
                in the folder is damaged.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        for leftover in self.folder.glob(".*.torchrl.*"):
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        found = self._found()
        for path in reversed(found):
            if damage := find_damage(path):
                log.warning(f"{path} is damaged ({damage}); trying the one before.")
                continue
            try:
                self._checkpoint.load(path, map_location="cpu")
            except CheckpointError as error:
                raise UnfitCheckpointError(
                    f"{path} does not fit this run: {error} Resume with the "
                    "configuration that it was written with, or start in another "
                    "folder.",
                    error.result,
                ) from error
            for later in found[found.index(path) + 1 :]:  # or it would be the newest
                later.replace(later.with_suffix(".damaged"))
            self._remove_outdated()  # a process may have died of a kill before it could
            return path
        if found:
            raise CheckpointError(
                f"All {len(found)} checkpoints in {self.folder} are damaged: move them "
                "away to start again."
            )
        return None
