"""One file with tensors and a record: safetensors, with checksums and bounds."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_osr._files import (
    check_checksum,
    checksummed,
    parse_json,
    refuse_other_than_files,
    write_atomically,
)

FORMAT = 1
"""Version of the record; a file of another one is refused."""

RECORD = "torchrl_osr"
"""Where the record is in the file's metadata."""

# Ten critics of three layers have 40 kB of header and 6 MB of weights.
MAX_HEADER_BYTES, MAX_FILE_BYTES = 2**20, 2**30


def write_tensors(
    path: Path, tensors: Mapping[str, Tensor], record: Mapping[str, Any]
) -> None:
    """Write tensors and a JSON-compatible record to one file, whole or not at all.

    Raises:
        ImportError: safetensors is not installed.
        OSError: naming ``path``, if it cannot be written.
    """
    library = _safetensors()
    there = {name: each.detach().cpu().contiguous() for name, each in tensors.items()}
    stamps = {"format": FORMAT, "tensors_sha256": _digest(there)}
    text = json.dumps(checksummed(stamps | dict(record)), allow_nan=False)
    write_atomically(path, library.torch.save(there, {RECORD: text}))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and record of a file; nothing is unpickled.

    Raises:
        ImportError: safetensors is not installed.
        OSError: the file cannot be read.
        ValueError: it is something else, too large, of another :data:`FORMAT`, or a
            checksum is wrong.
    """
    library = _safetensors()
    refuse_other_than_files(path)
    with path.open("rb") as file:
        header = int.from_bytes(file.read(8), "little")
    if header > MAX_HEADER_BYTES or path.stat().st_size > MAX_FILE_BYTES:
        raise ValueError(
            f"no safetensors file, or one with more than {MAX_HEADER_BYTES:,} bytes of "
            f"header or {MAX_FILE_BYTES:,} in all"
        )
    try:
        with library.safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            # Copies: what is mapped changes with the file.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    except library.SafetensorError as error:
        raise ValueError(str(error)) from error
    if RECORD not in metadata:
        raise ValueError("a safetensors file without the record of a policy")
    record = parse_json(metadata[RECORD], "its record")
    if record.get("format") != FORMAT:
        raise ValueError(
            f"it has format {str(record.get('format'))[:20]}, torchrl-osr "
            f"{version('torchrl-osr')} reads format {FORMAT}; install the version that "
            "wrote it"
        )
    check_checksum(record, "its record")
    if record["tensors_sha256"] != _digest(tensors):
        raise ValueError("the checksum of its tensors is wrong")
    return tensors, record


def _digest(tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def _safetensors() -> Any:
    try:
        import safetensors
        import safetensors.torch
    except ImportError as error:
        raise ImportError(
            "policy files need 'safetensors': pip install torchrl-osr[export]"
        ) from error
    return safetensors
