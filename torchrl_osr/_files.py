"""Files that are written whole or not at all; JSON, arrays, tensors and checksums."""

from __future__ import annotations

import hashlib
import json
import math
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchrl_osr._checks import needed_by

RECORD = "torchrl_osr"
"""Where a file of tensors, or a graph, has its record."""


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file that readers find whole, or as it was before; an OSError names it."""
    beside = path.with_name(f".{path.name}.new")
    try:
        with beside.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:
        text = f"cannot write the file ({error.strerror})"
        raise OSError(error.errno, text, str(path)) from error
    finally:
        with suppress(OSError):  # there is none, or the disk is read-only
            beside.unlink()


def check_writable(folder: Path) -> None:
    """Raise a PermissionError unless files can be written there: before a long job."""
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} is read-only: work on a copy of it elsewhere.")


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write text or bytes, see :func:`whole_file`."""
    with whole_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def write_json(path: Path, value: Any) -> None:
    """Write JSON, see :func:`whole_file`; NaN and infinity, which it lacks, as null."""
    text = json.dumps(finite_or_none(value), indent=1, allow_nan=False)
    write_atomically(path, text + "\n")


def finite_or_none(value: Any) -> Any:
    """Return the value for JSON: lists for arrays, ``None`` for NaN and infinity."""
    if hasattr(value, "tolist"):  # of NumPy or torch
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: finite_or_none(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite_or_none(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object of a file; a ValueError names one that holds another."""
    try:
        value = json.loads(path.read_bytes())
    except ValueError as error:  # of the encoding, too
        raise ValueError(f"{path} is no JSON: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path} holds no object")
    return value


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a NumPy archive (``.npz``) by name; nothing is unpickled."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: np.asarray(archive[name]) for name in archive}
    except (
        *(EOFError, MemoryError, NotImplementedError, OverflowError, TypeError),
        *(ValueError, zipfile.BadZipFile, zlib.error),
    ) as error:
        raise ValueError(
            f"{path} is no NumPy archive of plain arrays, or damaged ({error}): take a "
            "whole copy of it, written with numpy.savez"
        ) from error


def write_tensors(
    path: Path, tensors: Mapping[str, Tensor], record: Mapping[str, Any]
) -> None:
    """Write tensors and a JSON-compatible record to a safetensors file."""
    with needed_by("files of tensors need", "export"):
        from safetensors.torch import save
    there = {name: each.detach().cpu().contiguous() for name, each in tensors.items()}
    record = dict(record) | {"checksum": _digest(there)}
    write_atomically(path, save(there, {RECORD: json.dumps(record)}))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return tensors and record of a file; a ValueError names another, or damage."""
    with needed_by("files of tensors need", "export"):
        from safetensors import SafetensorError, safe_open
    try:
        with safe_open(path, "pt") as file:
            # Copies: what is mapped changes with the file.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
            record = json.loads((file.metadata() or {})[RECORD])
        damaged = record["checksum"] != _digest(tensors)
    except (SafetensorError, KeyError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} is no file of tensors of torchrl-osr, or damaged: {error!r}"
        ) from error
    if damaged:
        raise ValueError(f"{path} is damaged: its checksum is wrong. Copy it again.")
    return tensors, record


def _digest(tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
