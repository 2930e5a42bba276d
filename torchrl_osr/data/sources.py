"""One door for every data set that a configuration can name."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import gymnasium
import torch
from tensordict import TensorDict

from torchrl_osr.data.disk_cache import store_mixture, store_recorded
from torchrl_osr.data.environment import make_environment
from torchrl_osr.data.mixtures import load_mixture
from torchrl_osr.data.on_disk import TransitionsOnDisk
from torchrl_osr.data.reference_scores import REFERENCE_RETURNS, normalized_score

FILE_SOURCES = ("minari", "d4rl", "file")
"""What ``level`` may be besides the levels that are rolled out: a reader of ours."""


def load_dataset(
    env_name: str,
    level: str,
    *,
    env_id: str | None = None,
    path: str | None = None,
    download: bool = False,
    progress: bool = True,
    on_disk: bool = False,
    **mixture: Any,
) -> tuple[TensorDict | TransitionsOnDisk, dict[str, Any]]:
    """Load a rolled-out data set by its level, or a recorded one by its path.

    Args:
        env_name: short name of the task. A recorded set has a normalised score if
            there are reference returns for that name.
        level: one of ``LEVELS``, loaded by :func:`~torchrl_osr.data.load_mixture`; or
            ``"minari"``, ``"d4rl"`` or ``"file"``, read by
            :func:`~torchrl_osr.data.load_minari`, :func:`~torchrl_osr.data.load_d4rl`
            or :func:`~torchrl_osr.data.load_file`.

    Keyword Args:
        env_id: Gymnasium id of the task; recorded data of another size are then
            refused at once, not at the first evaluation. Default: not compared.
        path: of recorded data: what the reader takes. They are used whole.
        download: let the reader fetch a set that it knows by name. Default: ``False``.
        progress: show a progress bar when on a terminal. Default: ``True``.
        on_disk: rows are read from disk as they are drawn. At first use they are
            written into the cache folder: recorded data in slices, what is rolled out
            from memory. Default: ``False``.
        **mixture: ``random_share``, ``num_transitions`` and ``seed``, of data that are
            rolled out; with recorded data the share must be 0.

    Returns:
        The transitions and a manifest, as :func:`~torchrl_osr.data.load_mixture`
        returns them; ``"normalized_score"`` is ``None`` without reference returns or
        without a complete episode.

    Raises:
        ValueError: a path is missing or has no use, a random share with recorded data,
            or data that do not fit the task.

    Examples:
        >>> from torchrl_osr.data import load_dataset
        >>> load_dataset("hopper", "minari")
        Traceback (most recent call last):
            ...
        ValueError: data=minari needs data.path=...
    """
    if level not in FILE_SOURCES:
        if path is not None:
            raise ValueError(
                f"data.path={path} has no use with data={level}, which is rolled out; "
                f"it goes with data={', '.join(FILE_SOURCES)}."
            )
        load = store_mixture if on_disk else load_mixture
        return load(env_name, level, progress=progress, **mixture)
    if path is None:
        raise ValueError(f"data={level} needs data.path=..., the name or path of it.")
    if mixture.get("random_share"):
        raise ValueError(
            f"data.random_share={mixture['random_share']} is for data that are rolled "
            f"out; with data={level} it must be 0."
        )
    read = store_recorded if on_disk else _read
    data, manifest = read(level, path, download, progress)
    if env_id is not None:
        _check_sizes(data[torch.zeros(1, dtype=torch.long)], env_id, path)
    mean = (manifest.get("return") or {}).get("mean")
    score = None
    if mean is not None and env_name in REFERENCE_RETURNS:
        score = normalized_score(env_name, mean)
    return data, manifest | {
        "env_name": env_name,
        "level": level,
        "normalized_score": score,
    }


def _read(
    level: str, path: str, download: bool, progress: bool
) -> tuple[TensorDict, dict[str, Any]]:
    # Each reader needs a library of its own, and only the one that is asked for.
    if level == "minari":
        from torchrl_osr.data.minari_reader import load_minari

        return load_minari(path, download=download, progress=progress)
    if level == "d4rl":
        from torchrl_osr.data.d4rl_reader import load_d4rl

        return load_d4rl(path, download=download, progress=progress)
    from torchrl_osr.data.file_reader import load_file

    return load_file(path)


def _check_sizes(data: TensorDict, env_id: str, path: str) -> None:
    with closing(make_environment(env_id)) as env:
        sizes = [
            gymnasium.spaces.flatdim(space)
            for space in (env.observation_space, env.action_space)
        ]
    ours = [data[name].shape[-1] for name in ("observation", "action")]
    if ours != sizes:
        cure = "choose the env that the data are of."
        if isinstance(env.unwrapped.observation_space, gymnasium.spaces.Dict):
            cure += (
                " Its observations hold the goal. D4RL's own files of the ant do not, "
                "and are of a mirrored maze: data=minari, see docs/mazes.md."
            )
        raise ValueError(
            f"{path} has {ours[0]} observation and {ours[1]} action entries, {env_id} "
            f"has {sizes[0]} and {sizes[1]}: {cure}"
        )
