"""Every kind of file that the package reads: how it is made, and what reads it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import h5py
import minari
import numpy as np
import pandas as pd
import pyarrow
import torch
from forgeries import (
    Forge,
    broken_line,
    code_in_yaml,
    deep,
    entry,
    exploding_table,
    linked_file,
    linked_hdf5,
    made_by_environment,
    rezipped,
    too_large,
)
from gymnasium import spaces
from hydra import compose, initialize_config_dir
from minari.data_collector import EpisodeBuffer
from omegaconf import OmegaConf
from pyarrow import parquet
from tensordict import TensorDict
from torchrl import torchrl_logger
from torchrl.checkpoint import CheckpointRotation
from torchrl.envs import ObservationNorm
from torchrl.objectives import SoftUpdate

from torchrl_osr import OSRLoss, StatePerturbation
from torchrl_osr.lab.cli import CONF
from torchrl_osr.lab.data import (
    load_behavior_policy,
    load_d4rl,
    load_file,
    load_local_dataset,
    load_memmap,
    load_minari,
    make_replay_buffer,
    write_memmap,
)
from torchrl_osr.lab.data.collect.behavior import BEHAVIOR_POLICIES_DIR
from torchrl_osr.lab.evaluation import deterministic_policy
from torchrl_osr.lab.report.runs import pack_runs, read_each
from torchrl_osr.lab.run import schema
from torchrl_osr.lab.run.build import make_learner
from torchrl_osr.lab.run.trained_run import CHECKPOINTS, load_trained
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.policy import load_policy, policy_from_loss
from torchrl_osr.trainers import OfflineTrainer
from torchrl_osr.trainers.checkpoints import safe_checkpoint

ROWS = 600
ANY_BYTE = ("cut", "empty", "bit", "zeros", "noise")
NO_CHECKSUM = ("cut", "empty", "head")


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
    actor, _, loss, _ = make_learner(cfg, 11, 3)
    norm = ObservationNorm(
        torch.full((11,), 2.0), torch.full((11,), 3.0), in_keys=["observation"],
        standard_normal=True,
    )  # fmt: skip
    checkpoint = safe_checkpoint(
        loss_module=loss,
        observation_norm=norm,
        policy_average=deepcopy(actor),
    )
    CheckpointRotation(folder / CHECKPOINTS, keep_last=2).save(checkpoint, step=5)


def act(folder: Path) -> Any:
    """Load a run's policy and let it act."""
    trained = load_trained(folder)
    rows = torch.linspace(-1, 1, 66).reshape(6, 11)
    return deterministic_policy(trained.actor, trained.observation_norm)(rows)


def policies() -> list[Subject]:
    """A run of somebody else, whose policy is loaded, or the policy's own file."""

    def save(folder: Path) -> None:
        folder.mkdir()
        torch.manual_seed(0)
        networks = tanh_gaussian_actor(3, 1), critic_ensemble(3, 1)
        policy = policy_from_loss(OSRLoss(*networks, recovery_weight=0))
        policy.save(folder / "policy.safetensors")

    def play(folder: Path) -> Any:
        return load_policy(folder / "policy.safetensors").act(torch.ones(2, 3))

    return [
        Subject("policy .safetensors", save, "policy.safetensors", play),
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

    def csv(name: str) -> Callable[[Path], None]:
        def make(folder: Path) -> None:
            folder.mkdir()
            rows = {
                f"{key}_{entry}" if each.ndim > 1 else key: column
                for key, each in columns().items()
                for entry, column in enumerate(np.atleast_2d(each.T))
            }
            pd.DataFrame(rows).to_csv(folder / name, index=False)

        return make

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
            "log .csv", csv("log.csv"), "log.csv",
            # Cut behind a line, it is a shorter log.
            lambda f: load_file(f / "log.csv")[0], ("empty", "head"),
        ),
        Subject(
            "log .csv.gz", csv("log.csv.gz"), "log.csv.gz",
            lambda f: load_file(f / "log.csv.gz")[0],
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


def train_briefly(folder: Path) -> None:
    """Train a run of four steps, as a user does."""
    sizes = {
        "data.num_transitions": ROWS, "data.held_out": 0.1, "network.num_cells": "[8]",
        "trainer.batch_size": 8, "trainer.inverse_dynamics_steps": 4,
        "trainer.steps": 4, "trainer.log_interval": 4, "trainer.eval_interval": 4,
        "trainer.eval_episodes": 1, "trainer.checkpoint_interval": 4,
        "hydra.run.dir": folder.absolute(),
    }  # fmt: skip
    options = [f"{key}={value}" for key, value in sizes.items()]
    command = [sys.executable, "-m", "torchrl_osr", "train", "data=random", *options]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


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


def all_kinds(folder: Path) -> list[Subject]:
    """Every kind of file; a finished run is trained into the folder first."""
    train_briefly(folder)
    return [
        checkpoints(), *policies(), cached_set(), *memory_mapped(), *logs(),
        *minari_sets(), *behavior_policies(), *reported(folder),
    ]  # fmt: skip
