"""Local data sets: rolled out on this machine at first use, read from the cache after.

The manifest says what the data were made from and how well they did; a set whose
manifest or checksums do not fit is collected anew, never trusted.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDict

from torchrl_osr import __version__
from torchrl_osr._extras import needed_by
from torchrl_osr._files import check_disk_space
from torchrl_osr.lab.data.collect.environment import (
    MAZE_IDS,
    environment_id,
    make_environment,
)
from torchrl_osr.lab.data.collect.qualities import behavior_of, collect_quality
from torchrl_osr.lab.data.collect.reference_scores import normalized_score
from torchrl_osr.lab.data.store.cache import (
    CACHE_VARIABLE,
    CHUNK_ROWS,
    cache_root,
    load_or_write,
)
from torchrl_osr.lab.data.store.splits import mix_datasets
from torchrl_osr.lab.data.store.statistics import describe_episodes

log = logging.getLogger(__name__)

# Raise it whenever the recipe changes: older sets are then made anew.
RECIPE_VERSION = 1

# Other versions of these give other data for the same seed.
DATA_PACKAGES = ("numpy", "gymnasium", "mujoco")
MAZE_PACKAGES = (*DATA_PACKAGES, "gymnasium-robotics")


def load_local_dataset(
    env_name: str,
    quality: str,
    *,
    num_transitions: int,
    random_share: float = 0.0,
    seed: int = 0,
    cache_dir: Path | str | None = None,
    progress: bool = True,
    on_disk: bool = False,
) -> tuple[TensorDict, dict[str, Any]]:
    """Load a data set rolled out on this machine, collecting it on first use.

    About 10,000 transitions a second are collected. Processes that ask for the same set
    at once wait for one of them to collect it. The same seed gives the same data on one
    machine and one set of library versions, not across machines: contact dynamics are
    chaotic.

    Args:
        env_name: ``"hopper"``, ``"walker2d"`` or ``"halfcheetah"`` (Gymnasium v5);
            ``"pointmaze-umaze"``, ``-medium`` or ``-large`` (gymnasium-robotics).
        quality: ``"random"``, ``"medium"``, ``"medium-replay"``, ``"medium-expert"`` or
            ``"expert"``; of a maze ``"diverse"`` or ``"play"``.

    Keyword Args:
        num_transitions: exact number of transitions ``N``.
        random_share: share of the rows that are of quality ``random`` instead, see
            :func:`~torchrl_osr.lab.data.mix_datasets`: limited valuable data, section
            5.3
            of the paper, which has 0.5 to 0.9 with quality ``"expert"``. Default: 0.
        seed: non-negative seed of the data and of the choice of their rows. Default: 0.
        cache_dir: cache folder. Default: the environment variable
            ``TORCHRL_OSR_CACHE``, else the user's cache folder for ``torchrl-osr``.
        progress: show a progress bar when on a terminal. Default: ``True``.
        on_disk: leave the rows memory-mapped. To collect them takes the memory of the
            whole set, once. Default: ``False``.

    Returns:
        The transitions ``[N]``, see :func:`~torchrl_osr.lab.data.check_dataset` for
        their
        keys, and the manifest. That of a mixture has the ``"rows"`` of each quality,
        the ``"sources"``' own manifests, and as ``"normalized_score"`` their scores'
        mean over the rows.

    Raises:
        ValueError: unknown environment or quality, or a mixture of random data with
            random data.
        OSError: the cache folder cannot be written.
    """
    root = cache_root(cache_dir)
    if random_share and quality == "random":
        raise ValueError(
            f"random_share={random_share} mixes random rows into data of another "
            "quality; quality is random already."
        )
    request = request_of(env_name, quality, num_transitions, seed)
    if not random_share:
        data, manifest = _rolled_out(root, request, progress)
        return data if on_disk else data.clone(), manifest
    other_request = request_of(env_name, "random", num_transitions, seed)
    data, manifest = _rolled_out(root, request, progress)
    other, random = _rolled_out(root, other_request, progress)
    manifest = _mixture_manifest(manifest, random, random_share)

    def mixed() -> TensorDict:
        return mix_datasets(data, other, random_share=random_share, seed=seed)

    if not on_disk:
        return mixed(), manifest
    folder = root / "mixed" / f"{_name(**manifest)}-random{random_share}"
    return load_or_write(
        folder, manifest, lambda: mixed().split(CHUNK_ROWS), progress=False
    )


def _rolled_out(
    root: Path, request: dict[str, Any], progress: bool
) -> tuple[TensorDict, dict[str, Any]]:
    """Open one quality's own set, memory-mapped; collect it first if need be."""
    folder = root / "rolled-out" / _name(**request)
    env_name = request["env_name"]
    episodes: dict[str, Any] = {}

    def collect() -> Iterator[TensorDict]:
        _check_room(folder, request)
        log.info(
            f"rolls out {request['num_transitions']:,} transitions of {env_name} "
            f"{request['quality']}, once: they stay in {folder}"
        )
        data, returns, lengths = collect_quality(
            env_name,
            request["quality"],
            request["num_transitions"],
            seed=request["seed"],
            progress=progress,
        )
        episodes.update(describe_episodes(returns, lengths), normalized_score=None)
        if len(returns):
            mean = float(returns.mean())
            episodes["normalized_score"] = normalized_score(env_name, mean)
        yield from data.split(CHUNK_ROWS)

    return load_or_write(
        folder,
        request,
        collect,
        describe=lambda: {"torchrl_osr_version": __version__, **episodes},
        progress=False,
    )


def _name(
    env_name: str, quality: str, num_transitions: int, seed: int, **_: Any
) -> str:
    return f"{env_name}-{quality}-{num_transitions}-seed{seed}"


def _mixture_manifest(
    valuable: dict[str, Any], random: dict[str, Any], random_share: float
) -> dict[str, Any]:
    total, quality = valuable["num_transitions"], valuable["quality"]
    number = round(random_share * total)
    rows = {quality: total - number, "random": number}
    scores = [each["normalized_score"] for each in (valuable, random)]
    # A set without a complete episode has none.
    score = None if None in scores else np.average(scores, weights=[*rows.values()])
    same = ("env_name", "quality", "num_transitions", "seed")
    return {key: valuable[key] for key in same} | {
        "random_share": random_share,
        "rows": rows,
        "normalized_score": None if score is None else float(score),
        "sources": {quality: valuable, "random": random},
    }


def request_of(
    env_name: str, quality: str, num_transitions: int, seed: int
) -> dict[str, Any]:
    """Entries of the manifest that decide what the data are."""
    maze = env_name in MAZE_IDS
    packages = MAZE_PACKAGES if maze else DATA_PACKAGES
    with needed_by("collecting data needs", "mazes" if maze else "train"):
        versions = {package: version(package) for package in packages}
    return {
        "recipe_version": RECIPE_VERSION,
        "env_name": env_name,
        "env_id": environment_id(env_name),
        "quality": quality,
        "num_transitions": num_transitions,
        "seed": seed,
        **behavior_of(env_name, quality),
        "versions": versions,
    }


def _check_room(folder: Path, request: dict[str, Any]) -> None:
    """Raise an OSError before the work unless the set fits on the disk."""
    with closing(make_environment(request["env_id"])) as env:
        observation = env.observation_space.sample().size
        action = env.action_space.sample().size
    numbers = 2 * observation + action + 1  # both states, action, reward
    row = numbers * np.dtype(np.float32).itemsize + 3  # and three flags
    what = f"the data set ({CACHE_VARIABLE}=/path chooses the folder)"
    check_disk_space(folder, request["num_transitions"] * row, what)
