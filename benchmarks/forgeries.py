"""What somebody hostile makes of a file: each function replaces one that is whole."""

from __future__ import annotations

import gzip
import io
import json
import os
import random
import zipfile
from collections.abc import Callable
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import h5py
import numpy as np
import torch
import yaml

from torchrl_osr._files import checksummed

Forge = Callable[[Path, random.Random], None]


class Marker:
    """Unpickling it makes a folder beside, which is looked for afterwards."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(MARKER),)


MARKER = Path(gettempdir()) / f"torchrl-osr-marker-{os.getpid()}"
VALUES = (None, -1, 2**70, 1e300, "", "x", [], {}, [[]], True, "../../x", "/etc/passwd")


def pipe(path: Path, _: random.Random) -> None:
    """Put a named pipe in a file's place; to open it waits for ever."""
    path.unlink()
    os.mkfifo(path)


def folder_instead(path: Path, _: random.Random) -> None:
    """Put a folder in a file's place."""
    path.unlink()
    path.mkdir()


def foreign(path: Path, rng: random.Random) -> None:
    """Write a file of another kind under its name."""
    path.write_bytes(
        rng.choice((b"PK\x03\x04", b"{}", b"\x89HDF\r\n", b"\x1f\x8b", b"#"))
    )


EVERYWHERE: tuple[Forge, ...] = (pipe, folder_instead, foreign)


def entry(path: Path, rng: random.Random) -> None:
    """Replace one entry of a JSON or YAML file by a value of another kind."""
    content = yaml.safe_load(path.read_text())
    spots: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key, item in list(
            node.items() if isinstance(node, dict) else enumerate(node)
        ):
            spots.append((node, key))
            if isinstance(item, (dict, list)):
                walk(item)

    walk(content)
    node, key = rng.choice(spots)
    node[key] = rng.choice([value for value in VALUES if value != node[key]])
    if "checksum" in content and key != "checksum":
        content.pop("checksum")
        content = checksummed(content)
    text = yaml.safe_dump(content) if path.suffix == ".yaml" else json.dumps(content)
    path.write_text(text)


def deep(path: Path, _: random.Random) -> None:
    """Nest a JSON or YAML file too deep."""
    path.write_text('{"a":' + "[" * 10_000 + "]" * 10_000 + "}")


def code_in_yaml(path: Path, rng: random.Random) -> None:
    """Name a function to be called, in one of the ways of YAML, Hydra or Gymnasium."""
    made, content = str(MARKER), yaml.safe_load(path.read_text())
    call = {"_target_": "os.mkdir", "path": made}
    kind = rng.randrange(6)
    if kind == 0:
        path.write_text(f"!!python/object/apply:os.mkdir ['{made}']")
        return
    if kind == 1:
        path.write_text("a: &a [x, x]\n" + "b: [*a, *a, *a]\n")
        return
    if kind == 2:
        content["env"]["id"] = "hostile_module:Hopper-v5"
    elif kind == 3:
        content["loss"]["adversary"] = [{"more": call}]
    elif kind == 4:
        content["network"]["actor"] = call
    else:
        content["seed"] = f"${{oc.create:{{_target_: os.mkdir, path: {made}}}}}"
    path.write_text(yaml.safe_dump(content))


def too_large(path: Path, rng: random.Random) -> None:
    """Ask for networks that fill the memory."""
    content = yaml.safe_load(path.read_text())
    if rng.random() < 0.5:
        content["network"]["num_cells"] = [10_000_000]
    else:
        content["loss"]["num_qvalue_nets"] = 10**9
    path.write_text(yaml.safe_dump(content))


def rezipped(path: Path, rng: random.Random) -> None:
    """Give an archive a member that leads out, is a link, is pickled or lies."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    kind = rng.randrange(5)
    victim = rng.choice([name for name in members if not name.endswith(".json")])
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            if name == victim and kind == 0:
                buffer = io.BytesIO()
                if path.suffix == ".npz":
                    np.save(
                        buffer, np.array([Marker()], dtype=object), allow_pickle=True
                    )
                else:
                    torch.save({"weight": Marker()}, buffer)
                content = buffer.getvalue()
            if name == victim and kind == 1 and path.suffix == ".npz":
                buffer = io.BytesIO()
                header = {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
                np.lib.format.write_array_header_1_0(buffer, header)
                content = buffer.getvalue()
            elif name == victim and kind == 1:
                content = content[: len(content) // 2]
            archive.writestr(
                name if name != victim or kind != 2 else f"../{name}", content
            )
        if kind == 3:
            link = zipfile.ZipInfo("link")
            link.external_attr = 0o120777 << 16
            archive.writestr(link, "/etc/passwd")
        if kind == 4:
            archive.writestr("zeros", bytes(10**7), zipfile.ZIP_DEFLATED)


def linked_hdf5(path: Path, rng: random.Random) -> None:
    """Let an array of an HDF5 file lie in another one."""
    with h5py.File(path, "a") as file:
        names: list[str] = []
        file.visititems(
            lambda name, node: (
                names.append(name) if isinstance(node, h5py.Dataset) else None
            )
        )
        name = rng.choice(names)
        shape = file[name].shape
        del file[name]
        other = str(path.parent / "other.h5")
        kind = rng.randrange(5)
        if kind == 0:
            file[name] = h5py.ExternalLink(other, "secret")
        elif kind == 1:
            file["outside"] = h5py.ExternalLink(other, "secret")
            file[name] = h5py.SoftLink("/outside")
        elif kind == 2:
            layout = h5py.VirtualLayout(shape, "f8")
            layout[:] = h5py.VirtualSource(other, "secret", shape)
            file.create_virtual_dataset(name, layout)
        elif kind == 3:
            file.create_dataset(name, shape, "f8", external=[("/etc/passwd", 0, 10**6)])
        else:
            file.create_dataset(name, (10**11,), "f8", chunks=(10**6,))


def linked_file(path: Path, _: random.Random) -> None:
    """Put a link to a foreign file in a file's place."""
    path.unlink()
    path.symlink_to("/etc/passwd")


def made_by_environment(path: Path, _: random.Random) -> None:
    """Leave the spaces out, so that Minari would make the environment that is named."""
    content = json.loads(path.read_text())
    content.pop("observation_space")
    content["env_spec"] = json.dumps(
        {"id": "X-v0", "entry_point": "os:mkdir", "kwargs": {"path": str(MARKER)}}
    )
    path.write_text(json.dumps(content))


def exploding_table(path: Path, _: random.Random) -> None:
    """Pack more than is read into a small table."""
    with gzip.open(path, "wb", compresslevel=1) as file:
        for _ in range(300):
            file.write(bytes(2**20))


def broken_line(path: Path, rng: random.Random) -> None:
    """Replace one entry of one run of a table."""
    lines = gzip.decompress(path.read_bytes()).decode().splitlines()
    record = json.loads(lines[0])
    record[rng.choice(list(record))] = rng.choice(VALUES)
    lines[0] = json.dumps(record)
    path.write_bytes(gzip.compress("\n".join(lines).encode()))
