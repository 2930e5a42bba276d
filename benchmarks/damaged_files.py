"""Damage or forge files of every kind that is read: is all of it found, is any used?

    python benchmarks/damaged_files.py --files 1000 --folder /tmp/damage

Each file is whole at first and is then damaged (cut off, emptied, one bit, zeros,
noise) or forged as somebody hostile would: with code to be run, paths that lead out, a
pipe in its place, sizes that fill the memory, numbers of the wrong kind. The package is
asked to go on as if nothing had happened, under an audit hook that notes what is opened
outside of the folder, started or connected to. Writes
``results/reliability/damaged_files.json``.

Where a format has no checksum, a changed number cannot be told from data: JSON, YAML,
Parquet and Minari's files are not changed bit by bit.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import os
import platform
import random
import re
import shutil
import signal
import sys
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from tempfile import gettempdir
from typing import Any, NamedTuple
from unittest.mock import patch

import h5py
import minari
import numpy as np
import pyarrow
import torch
import yaml
from gymnasium import spaces
from hydra import compose, initialize_config_dir
from minari.data_collector import EpisodeBuffer
from omegaconf import OmegaConf
from pyarrow import parquet
from tensordict import TensorDict
from torchrl import torchrl_logger
from torchrl.checkpoint import CheckpointError, CheckpointRotation
from torchrl.envs import ObservationNorm
from torchrl.objectives import SoftUpdate

from torchrl_osr import OSRLoss, StatePerturbation
from torchrl_osr._files import checksummed
from torchrl_osr.commands import CONF
from torchrl_osr.data import (
    load_behavior_policy,
    load_d4rl,
    load_file,
    load_local_dataset,
    load_memmap,
    load_minari,
    make_replay_buffer,
    write_memmap,
)
from torchrl_osr.data.collect.behavior import BEHAVIOR_POLICIES_DIR
from torchrl_osr.evaluation import deterministic_policy
from torchrl_osr.experiment import schema
from torchrl_osr.experiment.build import make_learner
from torchrl_osr.experiment.trained_run import CHECKPOINTS, load_trained
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.report.runs import pack_runs, read_each
from torchrl_osr.trainers import OfflineTrainer
from torchrl_osr.trainers.checkpoints import safe_checkpoint

OUTPUT = Path(__file__).resolve().parents[1] / "results/reliability/damaged_files.json"
ROWS = 600
SECONDS = 60
"""After so many a file counts as one that makes the package wait for ever."""

Forge = Callable[[Path, random.Random], None]
ANY_BYTE = ("cut", "empty", "bit", "zeros", "noise")
NO_CHECKSUM = ("cut", "empty", "head")

CURE = re.compile(
    r"\b(allow|attach|choose|delete|expected|export|fetch|give|mark|move|must|remove|"
    r"repair|store|take|write)\b",
    re.IGNORECASE,
)


class Subject(NamedTuple):
    """One kind of file.

    Attributes:
        name: for the table.
        make: writes whole files into a folder.
        files: those to be damaged, a pattern below the folder.
        use: goes on from a folder; returns what came of it.
        ways: of damaging a file.
        forgeries: what makes a hostile file of a whole one.
    """

    name: str
    make: Callable[[Path], object]
    files: str
    use: Callable[[Path], Any]
    ways: Sequence[str] = ANY_BYTE
    forgeries: Sequence[Forge] = ()


# -- what a hostile file holds ---------------------------------------------------------


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
            file.create_dataset(name, shape, "f8", external=[("/etc/passwd", 0, 8)])
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


# -- the kinds of file -----------------------------------------------------------------


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


def make_run(folder: Path) -> None:
    """Write the folder of an untrained run."""
    schema.register()
    with initialize_config_dir(CONF, version_base="1.3"):
        cfg = compose("train", ["network.num_cells=[8]"])
    folder.mkdir(parents=True)
    OmegaConf.save(cfg, folder / "config.yaml", resolve=True)
    torch.manual_seed(0)
    _, _, loss = make_learner(cfg, 11, 3)
    norm = ObservationNorm(
        torch.full((11,), 2.0), torch.full((11,), 3.0), in_keys=["observation"],
        standard_normal=True,
    )  # fmt: skip
    checkpoint = safe_checkpoint(loss_module=loss, observation_norm=norm)
    CheckpointRotation(folder / CHECKPOINTS, keep_last=2).save(checkpoint, step=5)


def act(folder: Path) -> Any:
    """Load a run's policy and let it act."""
    trained = load_trained(folder)
    rows = torch.linspace(-1, 1, 66).reshape(6, 11)
    return deterministic_policy(trained.actor, trained.observation_norm)(rows)


def policies() -> list[Subject]:
    """A run of somebody else, whose policy is loaded."""
    return [
        Subject(
            "policy of a run", make_run, f"{CHECKPOINTS}/*.torchrl", act,
            forgeries=(rezipped,),
        ),
        Subject(
            "configuration of a run", make_run, "config.yaml", act, NO_CHECKSUM,
            (entry, deep, code_in_yaml, too_large, linked_file),
        ),
    ]  # fmt: skip


def cached_set() -> Subject:
    """A cached data set: it must be collected anew."""

    def use(folder: Path) -> Any:
        data, manifest = load_local_dataset(
            "hopper", "random", num_transitions=ROWS, cache_dir=folder, progress=False
        )
        return data, manifest

    return Subject("cached data set", use, "rolled-out/*/*.*", use, forgeries=())


def transitions(number: int) -> TensorDict:
    """Return synthetic transitions."""
    generator = torch.Generator().manual_seed(number)

    def draw(size: int) -> torch.Tensor:
        return torch.rand(100, size, generator=generator)

    no = torch.zeros(100, 1, dtype=torch.bool)
    after = {"observation": draw(11), "reward": draw(1)}
    after |= {"done": no, "terminated": no, "truncated": no}
    before = {"observation": draw(11), "action": draw(3)}
    return TensorDict(before | {"next": TensorDict(after, [100])}, [100])


def memory_mapped() -> list[Subject]:
    """A data set on disk that was written by hand: it must be refused."""

    def make(folder: Path) -> None:
        write_memmap(map(transitions, range(5)), folder / "set", progress=False)

    def use(folder: Path) -> Any:
        return load_memmap(folder / "set")[0].clone()

    return [
        Subject("rows on disk", make, "set/*.memmap", use, forgeries=(linked_file,)),
        Subject("manifest", make, "set/manifest.json", use, forgeries=(entry, deep)),
    ]


def columns() -> dict[str, Any]:
    """Return a log of episodes."""
    rng = np.random.default_rng(1)
    ends = np.arange(300) % 40 == 39
    return {
        "observation": rng.normal(size=(300, 3)),
        "action": rng.uniform(-1, 1, (300, 2)),
        "reward": rng.normal(size=300),
        "terminated": np.zeros(300, bool),
        "truncated": ends,
    }


def logs() -> list[Subject]:
    """Logs of one's own, and D4RL's: they must be refused."""

    def npz(folder: Path) -> None:
        folder.mkdir()
        np.savez(folder / "log.npz", **columns())

    def table(folder: Path) -> None:
        folder.mkdir()
        rows = {
            name: list(each) if each.ndim > 1 else each
            for name, each in columns().items()
        }
        parquet.write_table(pyarrow.table(rows), folder / "log.parquet")

    def hdf5(names: dict[str, str]) -> Callable[[Path], None]:
        def make(folder: Path) -> None:
            folder.mkdir()
            with h5py.File(folder / "other.h5", "w") as file:
                file["secret"] = np.full(300, 66.0)
            with h5py.File(folder / "log.hdf5", "w") as file:
                for name, each in columns().items():
                    file.create_dataset(
                        names.get(name, name), data=each, fletcher32=True
                    )

        return make

    d4rl = {
        "observation": "observations", "action": "actions", "reward": "rewards",
        "terminated": "terminals", "truncated": "timeouts",
    }  # fmt: skip
    return [
        Subject(
            "log .npz", npz, "log.npz", lambda f: load_file(f / "log.npz")[0],
            forgeries=(rezipped,),
        ),
        Subject(
            "log .parquet", table, "log.parquet",
            lambda f: load_file(f / "log.parquet")[0], NO_CHECKSUM,
        ),
        Subject(
            "log .hdf5", hdf5({}), "log.hdf5", lambda f: load_file(f / "log.hdf5")[0],
            NO_CHECKSUM, (linked_hdf5,),
        ),
        Subject(
            "D4RL .hdf5", hdf5(d4rl), "log.hdf5",
            lambda f: load_d4rl(f / "log.hdf5")[0],
            NO_CHECKSUM, (linked_hdf5,),
        ),
    ]  # fmt: skip


def minari_sets() -> list[Subject]:
    """Minari's sets: they must be refused."""

    def make(data_format: str) -> Callable[[Path], None]:
        def write(folder: Path) -> None:
            rng = np.random.default_rng(0)
            buffers = [
                EpisodeBuffer(
                    observations=rng.normal(size=(41, 3)),
                    actions=rng.uniform(-1, 1, (40, 2)).astype(np.float32),
                    rewards=rng.normal(size=40),
                    terminations=np.zeros(40, bool),
                    truncations=np.arange(40) == 39,
                )
                for _ in range(4)
            ]
            with patch.dict(os.environ, MINARI_DATASETS_PATH=str(folder)):
                minari.create_dataset_from_buffers(
                    "any/set-v0", buffers,
                    observation_space=spaces.Box(-np.inf, np.inf, (3,), np.float64),
                    action_space=spaces.Box(-1, 1, (2,)),
                    data_format=data_format,
                )  # fmt: skip

        return write

    def use(folder: Path) -> Any:
        return load_minari(folder / "any" / "set-v0", progress=False)[0]

    return [
        Subject(
            "Minari metadata", make("hdf5"), "any/set-v0/data/metadata.json", use,
            NO_CHECKSUM, (entry, deep, made_by_environment),
        ),
        Subject(
            "Minari HDF5", make("hdf5"), "any/set-v0/data/main_data.hdf5", use,
            NO_CHECKSUM, (linked_hdf5,),
        ),
        Subject(
            "Minari Arrow", make("arrow"), "any/set-v0/data/**/*.arrow", use,
            NO_CHECKSUM,
        ),
    ]  # fmt: skip


def behavior_policies() -> list[Subject]:
    """A behaviour policy of somebody else: it must be refused."""

    def make(folder: Path) -> None:
        (folder / "hopper").mkdir(parents=True)
        for name in ("card.json", "hopper/medium.npz"):
            shutil.copy(BEHAVIOR_POLICIES_DIR / name, folder / name)

    def use(folder: Path) -> Any:
        policy = load_behavior_policy("hopper", "medium", folder=folder)
        return torch.from_numpy(policy.deterministic(np.linspace(-1, 1, 11)))

    return [
        Subject(
            "behaviour policy", make, "hopper/medium.npz", use, forgeries=(rezipped,)
        ),
        Subject(
            "card of policies", make, "card.json", use, NO_CHECKSUM, (entry, deep)
        ),
    ]  # fmt: skip


def reported(finished: Path) -> list[Subject]:
    """Runs that are reported: theirs is left out, the other stays."""

    def make(folder: Path) -> None:
        folder.mkdir()
        for name in ("good", "bad"):
            shutil.copytree(finished, folder / name)
        pack_runs([folder / "good", folder / "bad"], folder / "runs.jsonl.gz")

    def use(paths: Callable[[Path], Path]) -> Callable[[Path], Any]:
        def read(folder: Path) -> Any:
            runs, left_out = read_each([folder / "good", paths(folder)])
            for path, reason in left_out:
                torchrl_logger.warning(f"{path}: {reason}: take another")
            assert any(run.facts["folder"].endswith("good") for run in runs)
            # Those that are there are as they were.
            return all(len(run.episodes) == len(runs[0].episodes) for run in runs)

        return read

    files = ("config.yaml", "status.json", "returns.json", ".hydra/hydra.yaml")
    return [
        *(
            Subject(
                f"report: {Path(name).name}", make, f"bad/{name}",
                use(lambda folder: folder / "bad"), NO_CHECKSUM, (entry, deep),
            )
            for name in files
        ),
        Subject(
            "report: table of runs", make, "runs.jsonl.gz",
            use(lambda folder: folder / "runs.jsonl.gz"),
            forgeries=(broken_line, exploding_table),
        ),
    ]  # fmt: skip


# -- damage, use, count ----------------------------------------------------------------


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


OWN_TEMPORARY = Path(gettempdir()) / f"torchrl-osr-own-{os.getpid()}"
"""What libraries unpack into, which is this process's own."""

LIBRARIES = (
    *(sys.prefix, sys.base_prefix, "/proc", "/sys", "/dev/null", "/usr", "/lib"),
    *(str(OWN_TEMPORARY), str(Path(__file__).resolve().parents[1])),
)


def outcome(subject: Subject, folder: Path, file: Path, right: Any) -> tuple[str, str]:
    """Go on from a folder with a bad file; what came of it, and what was said."""

    def too_long(*_: Any) -> None:
        raise TimeoutError

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
            except TimeoutError:
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
    named = any(each in message for each in (file.name, str(file.parent), folder.name))
    if not named or (refused and not CURE.search(message)):
        return "NO SENTENCE", message
    return "refused by name" if refused else "done without it, and said", message


def main() -> None:
    """Damage and forge, use, count, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--run", type=Path, required=True, help="a finished run")
    parser.add_argument("--only", default="", help="kinds whose name has this")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(1)
    OWN_TEMPORARY.mkdir()
    os.environ["TMPDIR"] = str(OWN_TEMPORARY)
    import tempfile

    tempfile.tempdir = str(OWN_TEMPORARY)
    rng, watch = random.Random(options.seed), Watch()
    subjects = [
        checkpoints(), *policies(), cached_set(), *memory_mapped(), *logs(),
        *minari_sets(), *behavior_policies(), *reported(options.run),
    ]  # fmt: skip
    subjects = [each for each in subjects if options.only in each.name]
    counts: dict[str, dict[str, int]] = {}
    effects: list[str] = []
    options.folder.mkdir(parents=True)
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
