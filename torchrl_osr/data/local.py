"""Local data sets with a cache: rolled out once, checked and read ever after.

One folder a data set, ``data.npz`` (plain arrays) and ``manifest.json``. The manifest
says what the data were made from and how well they did; a folder whose manifest or
checksum does not fit is made anew, never trusted.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr._files import (
    MAX_JSON_BYTES,
    check_disk_space,
    parse_json,
    read_arrays,
    read_text,
)
from torchrl_osr.data.collection import Collection
from torchrl_osr.data.environment import MAZE_IDS, environment_id, make_environment
from torchrl_osr.data.levels import behavior_of, collect_level
from torchrl_osr.data.manifest import (
    check_seal,
    describe_episodes,
    sealed,
    sha256_of,
)
from torchrl_osr.data.partial import PartialCollection
from torchrl_osr.data.reference_scores import normalized_score
from torchrl_osr.data.validation import DATASET_KEYS, check_dataset

try:
    import platformdirs
except ImportError as error:
    raise ImportError(
        f"local data sets need {error.name!r}: pip install torchrl-osr[examples]"
    ) from error

CACHE_VARIABLE = "TORCHRL_OSR_CACHE"
"""Environment variable that moves the cache folder."""

# Raise it whenever the recipe or the layout changes: older folders are then re-made.
FORMAT_VERSION = 1

# Humanoid, the widest of Gymnasium's tasks, has 3,000 bytes a row. Of an episode, which
# has one row at least, the manifest has return and length.
MAX_ROW_BYTES, MAX_EPISODE_BYTES = 2**14, 64

# Other versions of these give other data for the same seed.
DATA_PACKAGES = ("numpy", "gymnasium", "mujoco")
MAZE_PACKAGES = (*DATA_PACKAGES, "gymnasium-robotics")


def load_local_dataset(
    env_name: str,
    level: str,
    *,
    num_transitions: int,
    seed: int = 0,
    cache_dir: Path | str | None = None,
    progress: bool = True,
) -> tuple[TensorDict, dict[str, Any]]:
    """Load a data set rolled out on this machine, collecting it on first use.

    About 10,000 transitions a second are collected; a set of a million takes one or
    two minutes once. A killed collection loses the last 50,000 or so, and goes on to
    the same bytes. Processes that ask for the same set at once wait for one of them to
    collect it. The same seed gives the same data on one machine and one set of library
    versions, not across machines: contact dynamics are chaotic.

    Args:
        env_name: ``"hopper"``, ``"walker2d"`` or ``"halfcheetah"`` (Gymnasium v5);
            ``"pointmaze-umaze"``, ``-medium`` or ``-large`` (gymnasium-robotics).
        level: ``"random"``, ``"medium"``, ``"medium-replay"``, ``"medium-expert"`` or
            ``"expert"``; of a maze ``"diverse"`` or ``"play"``.

    Keyword Args:
        num_transitions: exact number of transitions ``N``.
        seed: non-negative seed. Default: 0.
        cache_dir: cache folder. Default: the environment variable
            ``TORCHRL_OSR_CACHE``, else the user's cache folder for ``torchrl-osr``.
        progress: show a progress bar when on a terminal. Default: ``True``.

    Returns:
        The transitions ``[N]``, see :func:`~torchrl_osr.data.check_dataset` for their
        keys, and the manifest.

    Raises:
        ValueError: unknown environment or level.
        OSError: the cache folder cannot be written.

    Examples:
        >>> import tempfile
        >>> from torchrl_osr.data import load_local_dataset
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     data, manifest = load_local_dataset(
        ...         "hopper", "random", num_transitions=500, cache_dir=folder
        ...     )
        >>> len(data), manifest["env_id"]
        (500, 'Hopper-v5')
    """
    request = request_of(env_name, level, num_transitions, seed)
    folder = (
        cache_root(cache_dir)
        / "local"
        / (f"{env_name}-{level}-{num_transitions}-seed{seed}")
    )
    # Without the lock first: a whole set can be read from a folder that is read-only.
    with suppress(OSError, ValueError):
        return _read(folder, request)
    with _locked(folder):
        try:
            # Another process may have made it while this one waited for the lock.
            return _read(folder, request)
        except (OSError, ValueError) as flaw:
            if folder.exists():
                torchrl_logger.warning(f"Collecting {folder} anew: {flaw}.")
        _check_room(folder, request)
        beside = folder.with_name(f".{folder.name}.partial")
        partial = PartialCollection(beside, request)
        collection = collect_level(
            env_name, level, num_transitions, seed=seed, progress=progress,
            partial=partial,
        )  # fmt: skip
        check_dataset(collection.data)
        with _explained_write_errors(folder):
            _write(folder, request, collection)
        partial.remove()
        return _read(folder, request)


def cache_root(cache_dir: Path | str | None) -> Path:
    """Return the folder of all cached data sets: as given, or as the user has it."""
    root = cache_dir or os.environ.get(CACHE_VARIABLE)
    return Path(root or platformdirs.user_cache_dir("torchrl-osr")).expanduser()


def request_of(
    env_name: str, level: str, num_transitions: int, seed: int
) -> dict[str, Any]:
    """Return the part of the manifest that decides what the data are."""
    maze = env_name in MAZE_IDS
    extra = "examples,mazes" if maze else "examples"
    packages = MAZE_PACKAGES if maze else DATA_PACKAGES
    try:
        versions = {package: version(package) for package in packages}
    except PackageNotFoundError as error:
        raise ImportError(
            f"collecting data needs {error.name!r}: pip install torchrl-osr[{extra}]"
        ) from error
    return {
        "format_version": FORMAT_VERSION,
        "env_name": env_name,
        "env_id": environment_id(env_name),
        "level": level,
        "num_transitions": num_transitions,
        "seed": seed,
        **behavior_of(env_name, level),
        "versions": versions,
    }


def _check_room(folder: Path, request: dict[str, Any]) -> None:
    """Raise an OSError unless the set, and its parts until then, fit on the disk."""
    with closing(make_environment(request["env_id"])) as env:
        observation, action = env.observation_space.shape, env.action_space.shape
    assert observation is not None
    assert action is not None
    numbers = 2 * observation[0] + action[0] + 1  # both states, action, reward
    row = numbers * np.dtype(np.float32).itemsize + 3  # and three flags
    what = f"the data set and its parts ({CACHE_VARIABLE}=/path chooses the folder)"
    check_disk_space(folder, 2 * request["num_transitions"] * row, what)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    lock = FileLock(f"{folder}.lock")
    with _explained_write_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def _read(folder: Path, request: dict[str, Any]) -> tuple[TensorDict, dict[str, Any]]:
    """Return a cached set; raise OSError or ValueError, with the reason, if unfit."""
    rows = request["num_transitions"]
    longest = MAX_JSON_BYTES + MAX_EPISODE_BYTES * rows
    text = read_text(folder / "manifest.json", max_bytes=longest)
    manifest = parse_json(text, "manifest.json")
    for key, wanted in request.items():
        if manifest.get(key) != wanted:
            raise ValueError(f"its {key} is {manifest.get(key)!r}, wanted {wanted!r}")
    check_seal(manifest, text, "manifest.json")
    if (folder / "data.npz").stat().st_size > MAX_ROW_BYTES * (rows + 1):
        raise ValueError("its data.npz is too large")
    # Hash and parse the same bytes: the folder may be replaced at any moment.
    content = (folder / "data.npz").read_bytes()
    if hashlib.sha256(content).hexdigest() != manifest.get("data_sha256"):
        raise ValueError("the checksum of its data.npz is wrong")
    # As it is written, nothing in it is compressed.
    arrays = read_arrays(io.BytesIO(content), max_bytes=0)
    data = TensorDict({}, batch_size=[manifest["num_transitions"]])
    try:
        for key in DATASET_KEYS:
            data.set(key, torch.from_numpy(arrays[_array_name(key)]))
    except (KeyError, RuntimeError) as error:
        raise ValueError(f"its data.npz is not what it says: {error}") from error
    return data, manifest


def _array_name(key: str | tuple[str, ...]) -> str:
    return key if isinstance(key, str) else "/".join(key)


def _write(folder: Path, request: dict[str, Any], collection: Collection) -> None:
    """Write beside the target and rename: a reader sees a whole folder or none."""
    fresh = folder.with_name(f".{folder.name}.new")
    stale = folder.with_name(f".{folder.name}.old")
    try:
        # Left by a process that was killed; the lock is held, so nobody uses them.
        for leftover in (fresh, stale):
            shutil.rmtree(leftover, ignore_errors=True)
        fresh.mkdir()
        arrays = {_array_name(key): collection.data[key] for key in DATASET_KEYS}
        with (fresh / "data.npz").open("wb") as file:
            np.savez(file, **{name: array.numpy() for name, array in arrays.items()})
            _sync(file)
        manifest = request | _statistics(request["env_name"], collection)
        manifest["data_sha256"] = sha256_of(fresh / "data.npz")
        with (fresh / "manifest.json").open("w", encoding="utf-8") as file:
            json.dump(sealed(manifest), file, indent=1)
            _sync(file)
        if folder.exists():
            os.replace(folder, stale)
        os.replace(fresh, folder)
    finally:
        for leftover in (fresh, stale):
            shutil.rmtree(leftover, ignore_errors=True)


def _sync(file: Any) -> None:
    file.flush()
    os.fsync(file.fileno())


def _statistics(env_name: str, collection: Collection) -> dict[str, Any]:
    returns, lengths = collection.episode_returns, collection.episode_lengths
    return {
        "torchrl_osr_version": _own_version(),
        **describe_episodes(returns, lengths),
        "normalized_score": (
            normalized_score(env_name, float(returns.mean())) if len(returns) else None
        ),
    }


def _own_version() -> str:
    try:
        return version("torchrl-osr")
    except PackageNotFoundError:
        return "not installed"


@contextmanager
def _explained_write_errors(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        # errno picks the subclass, so that PermissionError stays one.
        raise OSError(
            error.errno,
            f"cannot write the data set ({error.strerror}); free space, or choose "
            f"another folder with {CACHE_VARIABLE}=/path or cache_dir=",
            str(folder),
        ) from error
