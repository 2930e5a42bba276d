"""Checkpoints that are whole, and that cannot run code when loaded.

They are :mod:`torchrl.checkpoint` archives: one ZIP file each, every member with a
checksum. Three things are added: a payload that is only ever read with
``weights_only=True`` (TorchRL 0.14.1 unpickles what it finds beside a memory-mapped
tensordict), files that are synced before they are renamed and never away in between
(TorchRL moves the old one aside first), and a way back from a damaged newest file.
"""

from __future__ import annotations

import logging
import os
import shutil
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, CheckpointAdapter, CheckpointError
from torchrl.data import PrioritizedSampler

from torchrl_osr._files import check_disk_space

log = logging.getLogger(__name__)


class WeightsOnlyAdapter(CheckpointAdapter):
    """Saves ``state_dict()`` with :func:`torch.save`, loads it weights only."""

    adapter_id = "torchrl_osr.weights_only"
    filename = "state.pt"

    def save(self, component: Any, path: Path, **_: Any) -> None:
        """Write the component's state below the folder ``path``."""
        path.mkdir(parents=True, exist_ok=True)
        # Given a path, torch.save turns an error of the disk into a RuntimeError.
        with (path / self.filename).open("wb") as file:
            torch.save(component.state_dict(), file)

    def load(self, component: Any, path: Path, *, map_location: Any, **_: Any) -> None:
        """Restore the component's state from the folder ``path``."""
        file = path / self.filename
        try:
            state = torch.load(file, map_location=map_location, weights_only=True)
        except UnpicklingError as error:  # whose message says how to unpickle it
            raise ValueError(
                f"{self.filename} holds other things than tensors, which are never "
                "unpickled"
            ) from error
        if isinstance(component, torch.nn.Module):
            _check_fits(component.state_dict(), state)
        component.load_state_dict(state)


def _check_fits(here: Mapping[str, Any], there: Mapping[str, Any]) -> None:
    """Raise before anything is overwritten; tensordict's own error names no shapes."""
    shapes, saved = (
        {key: tuple(each.shape) for key, each in state.items() if torch.is_tensor(each)}
        for state in (here, there)
    )
    differences = [
        f"{key} is {saved.get(key, 'nothing')} in the file, "
        f"{shapes.get(key, 'nothing')} here"
        for key in sorted(shapes.keys() | saved.keys())
        if shapes.get(key) != saved.get(key)
    ]
    if differences:
        shown = "; ".join(differences[:3])
        raise ValueError(f"{len(differences)} tensors differ: {shown}.")


class SamplerState:
    """The draws that a replay buffer makes next, checkpointable.

    The generator, and the order of a sampler without replacement or the priorities of a
    prioritised one.
    """

    def __init__(self, buffer: Any, generator: torch.Generator) -> None:
        self.buffer, self.generator = buffer, generator
        self.sampler: Any = getattr(buffer, "sampler", None)

    def state_dict(self) -> dict[str, Any]:
        """Return tensors and numbers."""
        state: dict[str, Any] = {"generator": self.generator.get_state()}
        if isinstance(self.sampler, PrioritizedSampler):
            rows = torch.arange(len(self.buffer))
            state["priorities"] = torch.as_tensor(self.sampler._sum_tree[rows])
            state["max_priority"] = self.sampler._max_priority
        elif self.sampler is not None:
            state["sampler"] = dict(self.sampler.state_dict())
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue from a saved state."""
        self.generator.set_state(state_dict["generator"].cpu())
        if "priorities" in state_dict:
            priorities = state_dict["priorities"]
            rows = torch.arange(len(priorities))
            self.sampler._sum_tree[rows] = priorities
            self.sampler._min_tree[rows] = priorities
            self.sampler._max_priority = state_dict["max_priority"]
        elif state_dict.get("sampler"):
            self.sampler.load_state_dict(state_dict["sampler"])


def safe_checkpoint(**components: Any) -> Checkpoint:
    """Checkpoint of ``components`` in one archive without pickled objects.

    A component has ``state_dict`` and ``load_state_dict``, or is JSON-compatible (lists
    and mappings are restored in place).
    """
    checkpoint = Checkpoint(format="archive")
    for name, component in components.items():
        stateful = hasattr(component, "state_dict")
        adapter = WeightsOnlyAdapter() if stateful else None
        checkpoint.register(name, component, adapter=adapter)
    return checkpoint


def find_damage(path: Path) -> str | None:
    """Description of a checkpoint's damage, ``None`` if it is whole.

    Every member's checksum is compared, and the components' files must be there.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
            members = set(archive.namelist())
        if damaged is not None:
            return f"wrong checksum of {damaged}"
        # The names of the members have no checksum.
        listed = {
            f"{component['path']}/{file}"
            for component in Checkpoint.manifest(path)["components"].values()
            for file in component["files"]
        }
    except (
        zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, KeyError,
        TypeError, AttributeError, NotImplementedError, CheckpointError,
    ) as error:  # fmt: skip
        return str(error)
    missing = sorted(listed - members)
    return f"{', '.join(missing)} missing" if missing else None


class Checkpoints:
    """The checkpoints of one training run, in a folder of its own.

    ``checkpoint-<step>.torchrl`` are the newest; ``best.torchrl`` has the model of the
    best evaluation.

    Args:
        folder: where they are; made when the run is restored.
        components: live objects, by name, see :func:`safe_checkpoint`.

    Keyword Args:
        interval: steps between two checkpoints.
        kept: how many of the newest stay, of those at multiples of ``interval``. The
            newest of all stays too.
    """

    def __init__(
        self,
        folder: Path | str,
        components: Mapping[str, Any],
        *,
        interval: int,
        kept: int,
    ) -> None:
        self.folder, self.interval, self.kept = Path(folder), interval, kept
        self.best_path = self.folder / "best.torchrl"
        self._checkpoint = safe_checkpoint(**components)

    def latest(self) -> Path | None:
        """Path of the newest checkpoint, or ``None``."""
        return max(self._found(), default=None)

    def _found(self) -> list[Path]:
        return sorted(self.folder.glob("checkpoint-*.torchrl"))

    def check_room(
        self, loss_module: torch.nn.Module, optimizer: torch.optim.Optimizer
    ) -> None:
        """Raise an OSError unless all checkpoints of a run will fit on the disk."""
        trained = [each for group in optimizer.param_groups for each in group["params"]]
        # The networks, and Adam's two moments of what is trained.
        held = [*loss_module.parameters(), *loss_module.buffers(), *trained, *trained]
        size = sum(each.numel() * each.element_size() for each in held)
        number = self.kept + 3  # the best, the newest, and one being written
        there = sum(path.stat().st_size for path in self.folder.glob("*.torchrl"))
        check_disk_space(self.folder, number * size - there, f"{number} checkpoints")

    def save(self, step: int) -> None:
        """Write the checkpoint of a step, and remove those that are outdated."""
        self._write(self.folder / f"checkpoint-{step:012d}.torchrl")
        self._remove_outdated()

    def save_best(self, names: Collection[str], metadata: dict[str, Any]) -> None:
        """Write the components of these names to :attr:`best_path`."""
        self._write(self.best_path, components=names, metadata=metadata)

    def _write(self, path: Path, **options: Any) -> None:
        self.check_folder()
        beside = path.with_name(f".{path.name}.new")
        with self.write_errors_explained():
            self._checkpoint.save(beside, **options)
            with beside.open("rb") as file:
                os.fsync(file.fileno())
            os.replace(beside, path)

    def check_folder(self) -> None:
        """Raise a FileNotFoundError if the folder is gone; TorchRL would remake it."""
        if not self.folder.is_dir():
            raise FileNotFoundError(
                f"{self.folder} was removed or renamed while the run was going on. "
                "Start the run again in a folder that stays."
            )

    def _remove_outdated(self) -> None:
        """Keep the newest regular ones, and the newest of all.

        An interrupted run's checkpoint lies between two regular ones and stays until
        the next: a continued run ends up with the files of an undisturbed one.
        """
        found = self._found()
        regular = [
            path for path in found
            if int(path.stem.rpartition("-")[2]) % self.interval == 0
        ]  # fmt: skip
        for path in set(found) - {*regular[-self.kept :], *found[-1:]}:
            path.unlink()

    def restore(self) -> Path | None:
        """Restore the newest undamaged checkpoint; return its path, if there is one.

        What a killed process left half written is removed: only one run uses a folder.

        Raises:
            CheckpointError: if a checkpoint does not fit the components, or every one
                in the folder is damaged.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        for leftover in self.folder.glob(".*.torchrl.*"):
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        found = self._found()
        for path in reversed(found):
            damage = find_damage(path)
            if damage is not None:
                log.warning(f"{path} is damaged ({damage}); trying the one before.")
                continue
            try:
                self._checkpoint.load(path, map_location="cpu")
            except CheckpointError as error:
                raise CheckpointError(
                    f"{path} does not fit this run: {error} Resume with the "
                    "configuration that it was written with, or start in another "
                    "folder.",
                    error.result,
                ) from error
            self._remove_outdated()  # a process may have died of a kill before it could
            return path
        if found:
            raise CheckpointError(
                f"All {len(found)} checkpoints in {self.folder} are damaged; move them "
                "away to start anew."
            )
        return None

    @contextmanager
    def write_errors_explained(self, what: str = "a checkpoint") -> Iterator[None]:
        """Add to an error of the disk what to do about it."""
        try:
            yield
        except OSError as error:
            raise OSError(
                error.errno,
                f"Cannot write {what} of {self.folder}: {error}. Free space or mend "
                "the folder's rights and run again: the last whole checkpoint is "
                f"{self.latest()}.",
            ) from error
