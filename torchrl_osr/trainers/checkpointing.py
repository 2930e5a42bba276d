"""Checkpoints that are whole, that rotate, and that cannot run code when loaded.

They are :mod:`torchrl.checkpoint` archives: one ZIP file each, written beside its place
and renamed, every member with a checksum. Two things are added: a payload that is only
ever read with ``weights_only=True`` (TorchRL 0.14.1 unpickles what it finds beside a
memory-mapped tensordict), and a way back from a damaged newest file.
"""

from __future__ import annotations

import shutil
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torchrl import torchrl_logger
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointAdapter,
    CheckpointError,
    CheckpointRotation,
)

from torchrl_osr._files import check_disk_space, refuse_archive


class WeightsOnlyAdapter(CheckpointAdapter):
    """Saves ``state_dict()`` with :func:`torch.save`, loads it weights only."""

    adapter_id = "torchrl_osr.weights_only"
    filename = "state.pt"

    def save(
        self,
        component: Any,
        path: Path,
        *,
        args: tuple[Any, ...],
        kwargs: Mapping[str, Any],
    ) -> None:
        """Write the component's state below the folder ``path``."""
        path.mkdir(parents=True, exist_ok=True)
        torch.save(component.state_dict(*args, **kwargs), path / self.filename)

    def load(
        self,
        component: Any,
        path: Path,
        *,
        map_location: Any,
        tensor_load_kwargs: Mapping[str, Any],
        args: tuple[Any, ...],
        kwargs: Mapping[str, Any],
    ) -> None:
        """Restore the component's state from the folder ``path``."""
        del tensor_load_kwargs
        with zipfile.ZipFile(path / self.filename) as archive:
            refuse_archive(archive)
        state = torch.load(
            path / self.filename, map_location=map_location, weights_only=True
        )
        if isinstance(component, torch.nn.Module):
            _check_fits(component.state_dict(), state)
        component.load_state_dict(state, *args, **kwargs)


def _check_fits(here: Mapping[str, Any], there: Mapping[str, Any]) -> None:
    """Raise before anything is overwritten; tensordict's own error names no shapes."""

    def shape(state: Mapping[str, Any], key: str) -> str:
        value = state.get(key, "nothing")
        return str(tuple(value.shape)) if isinstance(value, torch.Tensor) else "nothing"

    differences = [
        f"{key} is {shape(there, key)} in the file, {shape(here, key)} here"
        for key in sorted(here.keys() | there.keys())
        if shape(here, key) != shape(there, key)
    ]
    if differences:
        shown = "; ".join(differences[:3])
        raise ValueError(f"{len(differences)} tensors differ: {shown}.")


class GeneratorState:
    """Makes a :class:`torch.Generator` checkpointable.

    Args:
        generator: whose state to save and restore.
    """

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the generator's state."""
        return {"state": self.generator.get_state()}

    def load_state_dict(self, state_dict: Mapping[str, torch.Tensor]) -> None:
        """Continue from a saved state."""
        self.generator.set_state(state_dict["state"].cpu())


def safe_checkpoint(**components: Any) -> Checkpoint:
    """Return a checkpoint of ``components`` in one archive without pickled objects.

    Args:
        **components: whatever has ``state_dict`` and ``load_state_dict``, or is
            JSON-compatible (lists and mappings are restored in place).
    """
    checkpoint = Checkpoint(format="archive")
    for name, component in components.items():
        stateful = hasattr(component, "state_dict")
        adapter = WeightsOnlyAdapter() if stateful else None
        checkpoint.register(name, component, adapter=adapter)
    return checkpoint


def check_room(
    rotation: CheckpointRotation,
    loss_module: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
) -> None:
    """Raise an OSError unless all checkpoints of a run will fit on the disk."""
    groups = optimizer.param_groups
    trained = [each for group in groups for each in group["params"]]
    # The networks, and Adam's two moments of what is trained.
    held = [*loss_module.parameters(), *loss_module.buffers(), *trained, *trained]
    size = sum(each.numel() * each.element_size() for each in held)
    number = rotation.keep_last + 2  # the best, and one that is being written
    there = sum(path.stat().st_size for path in rotation.directory.glob("*.torchrl"))
    what = f"{number} checkpoints"
    check_disk_space(rotation.directory, number * size - there, what)


def remove_leftovers(folder: Path) -> None:
    """Remove the unfinished writes of a killed run; only one run uses a folder."""
    for leftover in folder.glob(".*.torchrl.*"):
        if leftover.is_dir():
            shutil.rmtree(leftover)
        else:
            leftover.unlink()


@contextmanager
def explained_write_errors(
    rotation: CheckpointRotation, what: str = "a checkpoint"
) -> Iterator[None]:
    """Say of an error in writing what to do about it."""
    try:
        yield
    # torch.save turns a full disk into a RuntimeError.
    except (OSError, RuntimeError) as error:
        raise OSError(
            f"Cannot write {what} of {rotation.directory}: {error}. "
            "Free space or mend the folder's rights and run again: the last whole "
            f"checkpoint is {rotation.latest()}."
        ) from error


def save_step(
    checkpoint: Checkpoint,
    rotation: CheckpointRotation,
    step: int,
    *,
    interval: int,
    in_turn: bool = True,
) -> None:
    """Write the checkpoint of a step; the oldest that was in turn makes room.

    What a preempted run has written out of turn goes as soon as the next in turn is
    there: in the end the folder holds what that of an undisturbed run does.

    Args:
        checkpoint: the live components.
        rotation: the folder.
        step: of the run.

    Keyword Args:
        interval: steps between those in turn.
        in_turn: whether this one is.

    Raises:
        OSError: if it cannot be written.
    """
    out_of_turn = [
        path for path in rotation.checkpoints()
        if (saved := int(path.stem.rpartition("-")[2])) % interval and saved != step
    ]  # fmt: skip
    kept = rotation.keep_last
    rotation.keep_last += len(out_of_turn) + (not in_turn)
    try:
        with explained_write_errors(rotation):
            rotation.save(checkpoint, step=step)
    finally:
        rotation.keep_last = kept
    for path in out_of_turn:
        path.unlink()


def find_damage(path: Path) -> str | None:
    """Return what is wrong with a checkpoint's file, ``None`` if it is whole.

    Members that lead out of the archive and those that are packed, which ours are not,
    are wrong too: torchrl.checkpoint unpacks whatever the manifest lists.

    Args:
        path: of the archive; every member is read and its checksum compared, and the
            list of the components' files is gone through.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            refuse_archive(archive)
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


def load_latest(checkpoint: Checkpoint, rotation: CheckpointRotation) -> Path | None:
    """Restore the newest undamaged checkpoint of a folder.

    Args:
        checkpoint: the live components.
        rotation: the folder.

    Returns:
        What was loaded, or ``None`` if the folder holds no checkpoint.

    Raises:
        CheckpointError: if a checkpoint does not fit the components, or every one in
            the folder is damaged.
    """
    pattern = f"{rotation.prefix}-*.torchrl"
    found: list[Path] = sorted(rotation.directory.glob(pattern), reverse=True)
    for path in found:
        damage = find_damage(path)
        if damage is not None:
            torchrl_logger.warning(
                f"Checkpoint {path} is damaged ({damage}); trying the one before."
            )
            continue
        try:
            checkpoint.load(path, map_location="cpu")
        except CheckpointError as error:
            raise CheckpointError(
                f"{path} does not fit this run: {error} Resume with the configuration "
                "that it was written with, or start in another folder.",
                error.result,
            ) from error
        return path
    if found:
        raise CheckpointError(
            f"All {len(found)} checkpoints in {rotation.directory} are damaged; move "
            "them away to start anew."
        )
    return None
