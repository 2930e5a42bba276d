"""Files that somebody else has made: refused by name, or read for what they are.

Whatever is in them, nothing outside of their folder is opened and nothing runs.
"""

from __future__ import annotations

import copy
import json
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import gettempdir

import h5py
import numpy as np
import property_settings
import pytest
import torch
import yaml
from composed import composed
from hypothesis import given
from hypothesis import strategies as st
from lab.report.fakes import write_run
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointError

from torchrl_osr._files import checksummed
from torchrl_osr.lab.data import load_file, load_memmap, write_memmap
from torchrl_osr.lab.report.runs import LeftOut, read_each
from torchrl_osr.lab.run.run_config import read_run, read_yaml
from torchrl_osr.trainers.checkpoints import find_damage, safe_checkpoint

tried = property_settings.tried(20)

WORDS = ["", "x", "torchrl_osr.OSRLoss", "os.system", "../x", "/etc/passwd", "${a}"]
NUMBERS = [-1, 0, 3, 2**70, 1e300, float("nan"), float("inf"), True, None]
trees = st.recursive(
    st.sampled_from([*WORDS, *NUMBERS]),
    lambda children: (
        st.lists(children, max_size=3)
        | st.dictionaries(st.sampled_from(["_target_", "a", "b"]), children)
    ),
    max_leaves=6,
)


@contextmanager
def watched(folder: Path) -> Iterator[list[str]]:
    """What is written outside of a folder, or started, while this is open."""
    strange: list[str] = []

    def hook(event: str, arguments: tuple) -> None:
        if not watching:
            return
        if event in ("os.system", "os.exec", "subprocess.Popen", "socket.connect"):
            strange.append(f"{event} {arguments[0]}")
        if event == "open" and isinstance(arguments[0], str):
            path, mode = Path(arguments[0]).resolve(), str(arguments[1] or "")
            inside = path.is_relative_to(folder.resolve())
            if not inside and (set(mode) & set("wax+") or path == SECRET):
                strange.append(f"{event} {path} {mode}")

    watching = True
    sys.addaudithook(hook)  # for ever, hence the flag
    try:
        yield strange
    finally:
        watching = False


SECRET = Path("/etc/passwd").resolve()


@pytest.fixture(scope="module")
def configuration() -> dict:
    return OmegaConf.to_container(composed("train"), resolve=True)


def outcome(read: Callable[[], object]) -> tuple[object, str]:
    """What is read, or nothing and the reason."""
    try:
        return read(), ""
    except (CheckpointError, ValueError) as error:
        return None, str(error)


def put(tree: dict, place: int, value: object) -> None:
    """Replace one entry, however deep: that of this number."""
    spots: list[tuple] = []

    def walk(node: object) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, item in items:
            spots.append((node, key))
            if isinstance(item, (dict, list)):
                walk(item)

    walk(tree)
    node, key = spots[place % len(spots)]
    node[key] = value


@tried
@given(st.integers(0, 10**6), trees)
def test_configurations(configuration, place, value):
    content = copy.deepcopy(configuration)
    put(content, place, value)
    with tempfile.TemporaryDirectory() as name, watched(Path(name)) as strange:
        path = Path(name) / "config.yaml"
        path.write_text(yaml.safe_dump(content))
        config, reason = outcome(lambda: read_run(path))
        if reason:
            assert "config.yaml" in reason
        else:
            assert OmegaConf.to_container(config).keys() == configuration.keys()
    assert not strange


SYNTAX = (
    *(
        "- ",
        "? ",
        ": ",
        "a: ",
        "[",
        "{",
        "]",
        "}",
        ",",
        "1",
        "'",
        '"',
        "|\n",
        "\n",
        "  ",
    ),
    *(
        "&x ",
        "*x",
        "<<: ",
        "---\n",
        "%TAG ! !\n",
        "\x07",
        "é",
        "${",
        "!!set ",
        "!!bool ",
    ),
    *("!!int ", "!!python/name:os ", "!!python/object/apply:os.system [x]"),
)


@tried
@given(st.lists(st.sampled_from(SYNTAX), max_size=12).map("".join))
def test_yaml(text):
    with tempfile.TemporaryDirectory() as name, watched(Path(name)) as strange:
        path = Path(name) / "config.yaml"
        path.write_text(text)
        content, reason = outcome(lambda: read_yaml(path))
        if reason:
            assert reason.startswith("config.yaml ")
        else:
            assert isinstance(content, (dict, list))
    assert not strange


def transitions(rows: int = 20) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    state = torch.rand(rows, 2, generator=generator)
    no = torch.zeros(rows, 1, dtype=torch.bool)
    after = {"observation": state + 1, "reward": state[:, :1] + 1}
    after |= {"done": no, "terminated": no, "truncated": no}
    return TensorDict(
        {"observation": state, "action": state[:, :1], "next": after}, [rows]
    )


@tried
@given(st.integers(0, 10**6), trees, st.booleans())
def test_manifests_of_data_sets(place, value, signed):
    with tempfile.TemporaryDirectory() as name, watched(Path(name)) as strange:
        folder = Path(name) / "set"
        data, manifest = write_memmap([transitions()], folder, progress=False)
        manifest.pop("checksum") if signed else None
        put(manifest, place, value)
        text = json.dumps(checksummed(manifest) if signed else manifest)
        (folder / "manifest.json").write_text(text)
        again, reason = outcome(lambda: load_memmap(folder)[0])
        if reason:
            assert str(folder) in reason
            assert "write it again" in reason
        else:
            assert (again == data).all()
    assert not strange


COLUMNS = ("observation", "action", "reward", "terminated", "truncated")
LINKS = ["soft", "itself", "root", "external", "virtual", "raw", "group", "array"]


@tried
@given(
    st.dictionaries(
        st.sampled_from([*COLUMNS, "more/deep"]), st.sampled_from(LINKS), max_size=3
    )
)
def test_hdf5_links(links):
    with tempfile.TemporaryDirectory() as name:
        secret, path = Path(name) / "secret.h5", Path(name) / "log.h5"
        shapes = {"observation": (6, 2), "action": (6, 1)}
        for file, number in ((secret, 66.0), (path, 0.5)):
            with h5py.File(file, "w") as made:
                for column in COLUMNS:
                    whole = np.full(shapes.get(column, 6), number)
                    flag = column[0] == "t"
                    made[column] = np.zeros(6, bool) if flag else whole
        (Path(name) / "raw").write_bytes(np.full(12, 66.0).tobytes())
        with h5py.File(path, "a") as made:
            for place, kind in links.items():
                if place in made:
                    del made[place]
                put_link(made, place, kind, secret)
        elsewhere = {"external", "virtual", "raw"} & {*links.values()}
        data, reason = outcome(lambda: load_file(path)[0])
        if elsewhere:
            assert "leads into another file" in reason
        elif not reason:
            assert data["observation"].max() < 1


def put_link(file: h5py.File, place: str, kind: str, secret: Path) -> None:
    if kind == "soft":
        file[place] = h5py.SoftLink("/observation")
    elif kind == "itself":
        file[place] = h5py.SoftLink(f"/{place}")
    elif kind == "root":
        file[place] = file["/"]
    elif kind == "external":
        file[place] = h5py.ExternalLink(str(secret), "observation")
    elif kind == "virtual":
        layout = h5py.VirtualLayout((6,), "f8")
        layout[:] = h5py.VirtualSource(str(secret), "reward", (6,))
        file.create_virtual_dataset(place, layout)
    elif kind == "raw":
        outside = [(str(secret.parent / "raw"), 0, 48)]
        file.create_dataset(place, (6,), "f8", external=outside)
    elif kind == "group":
        file.create_group(place)
    else:
        file[place] = np.full(6, 0.5)


@tried
@given(
    st.sampled_from(["config.yaml", "status.json", "returns.json", "hydra.yaml"]),
    st.integers(0, 10**6),
    trees,
)
def test_run_folders_of_a_report(spoilt, place, value):
    with tempfile.TemporaryDirectory() as name, watched(Path(name)) as strange:
        good = write_run(Path(name) / "good" / "seed0", {8000: [50.0, 60.0]})
        bad = write_run(Path(name) / "bad" / "seed0", {8000: [50.0, 60.0]})
        path = bad / ".hydra" / spoilt if spoilt == "hydra.yaml" else bad / spoilt
        content = yaml.safe_load(path.read_text())
        put(content, place, value)
        dump = json.dumps if path.suffix == ".json" else yaml.safe_dump
        path.write_text(dump(content))
        runs, left_out = read_each([Path(name)])
        assert str(good) in [run.facts["folder"] for run in runs]
        assert (
            len(runs) + len([each for each in left_out if each.path == str(bad)]) == 2
        )
        for each in left_out:
            assert isinstance(each, LeftOut)
            assert each.reason
    assert not strange


@tried
@given(st.integers(0, 10**6), trees, st.sampled_from(["manifest.json", "state.pt"]))
def test_checkpoints(place, value, member):
    module = torch.nn.Linear(2, 1)
    with tempfile.TemporaryDirectory() as name, watched(Path(name)) as strange:
        path = Path(name) / "checkpoint-1.torchrl"
        safe_checkpoint(module=module, history=[1, 2]).save(path)
        with zipfile.ZipFile(path) as archive:
            members = {each: archive.read(each) for each in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for each, content in members.items():
                if each.endswith(member) and member == "manifest.json":
                    manifest = json.loads(content)
                    put(manifest, place, value)
                    content = json.dumps(manifest).encode()
                elif each.endswith(member):
                    cut = place % len(content)
                    content = content[:cut] + b"\x80\x04" + content[cut + 2 :]
                archive.writestr(each, content)
        if find_damage(path) is None:
            again = safe_checkpoint(module=torch.nn.Linear(2, 1), history=[])
            outcome(lambda: again.load(path))  # CheckpointError, if any
    assert [each for each in strange if gettempdir() not in each] == []
