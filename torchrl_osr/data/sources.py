"""One door for every data set that a configuration can name."""

from __future__ import annotations

from contextlib import closing
from typing import Any

from gymnasium import spaces
from tensordict import TensorDict

from torchrl_osr.data.collect.environment import make_environment
from torchrl_osr.data.collect.local import load_local_dataset
from torchrl_osr.data.collect.reference_scores import (
    REFERENCE_RETURNS,
    normalized_score,
)
from torchrl_osr.data.store.memmap import is_memmap_folder, load_memmap

RECORDED = ("minari", "d4rl", "file")
"""What ``quality`` may be besides the qualities that are rolled out: our readers."""


def load_dataset(
    env_name: str,
    quality: str,
    *,
    env_id: str | None = None,
    path: str | None = None,
    download: bool = False,
    progress: bool = True,
    on_disk: bool = False,
    **recipe: Any,
) -> tuple[TensorDict, dict[str, Any]]:
    """Load a rolled-out data set by its quality, or a recorded one by its path.

    Args:
        env_name: short name of the task. A recorded set has a normalised score if
            there are reference returns for that name.
        quality: one of ``QUALITIES``, see :func:`~torchrl_osr.data.load_local_dataset`;
            or ``"minari"``, ``"d4rl"`` or ``"file"``, see the loaders of that name.

    Keyword Args:
        env_id: Gymnasium id of the task; recorded data of another size are then
            refused at once, not at the first evaluation. Default: not compared.
        path: of recorded data: what the reader takes; with ``"file"`` also a folder
            that :func:`~torchrl_osr.data.write_memmap` has written. They are used
            whole.
        download: let the reader fetch a set that it knows by name. Default: ``False``.
        progress: show a progress bar when on a terminal. Default: ``True``.
        on_disk: leave the rows memory-mapped. At first use they are written into the
            cache folder: recorded data in chunks, what is rolled out from memory.
            Default: ``False``.
        **recipe: ``random_share``, ``num_transitions`` and ``seed``, of data that are
            rolled out; with recorded data the share must be 0.

    Returns:
        The transitions ``[N]`` and their manifest; ``"normalized_score"`` in it is
        ``None`` without reference returns or without a complete episode.

    Raises:
        ValueError: a path is missing or has no use, a random share with recorded data,
            or data that do not fit the task.
    """
    if quality not in RECORDED:
        if path is not None:
            raise ValueError(
                f"data.path={path} has no use with data={quality}, which is rolled "
                f"out; it goes with data={', '.join(RECORDED)}."
            )
        return load_local_dataset(
            env_name, quality, progress=progress, on_disk=on_disk, **recipe
        )
    if path is None:
        raise ValueError(f"data={quality} needs data.path=..., the name or path of it.")
    if recipe.get("random_share"):
        raise ValueError(
            f"data.random_share={recipe['random_share']} is for data that are rolled "
            f"out; with data={quality} it must be 0."
        )
    data, manifest = _load_recorded(quality, path, download, progress, on_disk)
    if env_id is not None:
        _check_sizes(data, env_id, path)
    mean = (manifest.get("return") or {}).get("mean")
    score = None
    if mean is not None and env_name in REFERENCE_RETURNS:
        score = normalized_score(env_name, mean)
    return data, manifest | {
        "env_name": env_name,
        "quality": quality,
        "normalized_score": score,
    }


def _load_recorded(
    quality: str, path: str, download: bool, progress: bool, on_disk: bool
) -> tuple[TensorDict, dict[str, Any]]:
    # Each reader needs a library of its own, and only the one that is asked for.
    if quality == "minari":
        from torchrl_osr.data.read.minari import load_minari

        return load_minari(path, download=download, progress=progress, on_disk=on_disk)
    if quality == "d4rl":
        from torchrl_osr.data.read.d4rl import load_d4rl

        return load_d4rl(path, download=download, progress=progress, on_disk=on_disk)
    if is_memmap_folder(path):
        data, manifest = load_memmap(path)
        return data if on_disk else data.clone(), manifest
    from torchrl_osr.data.read.files import load_file

    return load_file(path, progress=progress, on_disk=on_disk)


def _check_sizes(data: TensorDict, env_id: str, path: str) -> None:
    with closing(make_environment(env_id)) as env:
        sizes = [
            spaces.flatdim(space) for space in (env.observation_space, env.action_space)
        ]
    ours = [data[name].shape[-1] for name in ("observation", "action")]
    if ours != sizes:
        cure = "choose the env that the data are of."
        if isinstance(env.unwrapped.observation_space, spaces.Dict):
            cure += (
                " Its observations hold the goal. D4RL's own files of the ant do not, "
                "and are of a mirrored maze: data=minari, see docs/mazes.md."
            )
        raise ValueError(
            f"{path} has {ours[0]} observation and {ours[1]} action entries, {env_id} "
            f"has {sizes[0]} and {sizes[1]}: {cure}"
        )
