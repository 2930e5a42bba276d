"""One door for every data set that a configuration can name."""

from __future__ import annotations

from collections.abc import Mapping
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
from torchrl_osr.data.read.column_checks import ActionBounds
from torchrl_osr.data.read.recording import Recording
from torchrl_osr.data.store.memmap import is_memmap_folder, load_memmap

RECORDED = ("minari", "d4rl", "file")
"""What ``quality`` may be besides the qualities that are rolled out: our readers."""


def load_dataset(
    env_name: str,
    quality: str,
    *,
    env_id: str | None = None,
    path: str | None = None,
    columns: Mapping[str, Any] | None = None,
    action_bounds: ActionBounds | None = None,
    clip_actions: bool = False,
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
        columns: with ``"file"``, the names of the columns, see
            :func:`~torchrl_osr.data.load_file`; with ``"minari"``, ``observation``
            alone: the entries of a dictionary. Default: the usual names.
        action_bounds: what the recording has for the task's lowest and highest action.
            Default: of ``"minari"`` its action space; otherwise the task's own bounds,
            or -1 and 1 without ``env_id``.
        clip_actions: see :func:`~torchrl_osr.data.transitions_from_rows`.
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
        ValueError: an option is missing or has no use, or the data do not fit the task.
    """
    given = {"columns": _named(columns), "action_bounds": action_bounds, "path": path}
    if quality not in RECORDED:
        for option, value in given.items():
            if value:
                raise ValueError(
                    f"data.{option}={value} has no use with data={quality}, which is "
                    f"rolled out; it goes with data={', '.join(RECORDED)}."
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
    if quality == "file" and is_memmap_folder(path):
        _refuse_options(path, given)
        data, manifest = load_memmap(path)
        data = data if on_disk else data.clone()
    else:
        recording = open_recorded(
            quality,
            path,
            env_id=env_id,
            columns=columns,
            action_bounds=action_bounds,
            clip_actions=clip_actions,
            download=download,
            progress=progress and not on_disk,
        )
        data, manifest = recording.load(on_disk=on_disk, progress=progress)
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


def open_recorded(
    quality: str,
    path: str,
    *,
    env_id: str | None = None,
    columns: Mapping[str, Any] | None = None,
    action_bounds: ActionBounds | None = None,
    clip_actions: bool = False,
    download: bool = False,
    progress: bool = True,
) -> Recording:
    """Open recorded data, none of whose rows is read yet; see :func:`load_dataset`."""
    columns, clip = _named(columns), {"clip_actions": clip_actions}
    # Each reader needs a library of its own, and only the one that is asked for.
    if quality == "minari":
        from torchrl_osr.data.read.minari import open_minari

        if others := columns.keys() - {"observation"}:
            raise ValueError(
                f"data.columns.{others.pop()} has no use with data=minari, which has "
                "its own names; data.columns.observation=[...] takes some entries of a "
                "dictionary."
            )
        return open_minari(
            path,
            download=download,
            observation_keys=columns.get("observation"),
            action_bounds=action_bounds,
            progress=progress,
            **clip,
        )
    bounds = action_bounds or _action_bounds(env_id)
    if quality == "file":
        from torchrl_osr.data.read.files import open_file

        return open_file(path, columns=columns, action_bounds=bounds, **clip)
    from torchrl_osr.data.read.d4rl import open_d4rl

    if columns:
        raise ValueError(
            "data.columns has no use with data=d4rl, which has D4RL's own names; "
            "data=file reads HDF5 files with others."
        )
    return open_d4rl(
        path, download=download, action_bounds=bounds, progress=progress, **clip
    )


def _named(columns: Mapping[str, Any] | None) -> dict[str, Any]:
    """What the user has named; ``None`` stands for the usual names."""
    return {part: name for part, name in (columns or {}).items() if name is not None}


def _refuse_options(path: str, given: Mapping[str, Any]) -> None:
    for option in ("columns", "action_bounds"):
        if given[option]:
            raise ValueError(
                f"data.{option} has no use with {path}, which write_memmap has "
                "written: its columns are known and its actions lie between -1 and 1."
            )


def _action_bounds(env_id: str | None) -> ActionBounds:
    """Bounds of the task's actions in its own units; -1 and 1 without a task."""
    if env_id is None:
        return -1.0, 1.0
    with closing(make_environment(env_id)) as env:
        space = env.unwrapped.action_space
    assert isinstance(space, spaces.Box)
    bounds = space.low.tolist(), space.high.tolist()
    # As numbers where they are the same for all: data of another size are told as such.
    low, high = (set(bound) for bound in bounds)
    return (low.pop(), high.pop()) if len(low) == len(high) == 1 else bounds


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
