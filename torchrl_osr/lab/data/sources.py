"""One door for every data set that a configuration can name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDict
from torch import Tensor

from torchrl_osr.lab.data.collect.behavior import load_behavior_card
from torchrl_osr.lab.data.collect.environment import (
    MAZE_IDS,
    EnvironmentSpec,
    environment_name,
    environment_spec,
)
from torchrl_osr.lab.data.collect.local import load_local_dataset
from torchrl_osr.lab.data.collect.reference_scores import (
    REFERENCE_RETURNS,
    ReferenceReturns,
)
from torchrl_osr.lab.data.read.column_checks import ActionBounds
from torchrl_osr.lab.data.read.recording import Recording
from torchrl_osr.lab.data.store.cache import CHUNK_ROWS
from torchrl_osr.lab.data.store.memmap import is_memmap_folder, load_memmap

RECORDED = ("minari", "d4rl", "file")
"""What ``quality`` may be besides the qualities that are rolled out: our readers."""


def load_dataset(
    env_name: str,
    quality: str,
    *,
    env_id: str | None = None,
    references: ReferenceReturns | None = None,
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
        env_name: short name of the task.
        quality: one of ``QUALITIES``, see
            :func:`~torchrl_osr.lab.data.load_local_dataset`;
            or ``"minari"``, ``"d4rl"`` or ``"file"``, see the loaders of that name.

    Keyword Args:
        env_id: Gymnasium id of the task. The actions of a ``"file"`` are then in its
            units, and data that do not fit it are refused at once, not at the first
            evaluation. Default: actions within -1 and 1, not compared.
        references: what recorded episodes are scored by. Default: D4RL's of the name,
            if there are any.
        path: of recorded data: what the reader takes; with ``"file"`` also a folder
            that :func:`~torchrl_osr.lab.data.write_memmap` has written. They are used
            whole.
        columns: with ``"file"``, the names of the columns, see
            :func:`~torchrl_osr.lab.data.load_file`; with ``"minari"``, ``observation``
            alone: the entries of a dictionary. Default: the usual names.
        action_bounds: what the recording has for the task's lowest and highest action.
            Default: of ``"minari"`` its action space; otherwise the task's own bounds,
            or -1 and 1 without ``env_id``.
        clip_actions: see :func:`~torchrl_osr.lab.data.transitions_from_rows`.
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
        ValueError: an option is missing or has no use, a task of which there are no
            data to roll out, or data that do not fit it.
    """
    given: dict[str, Any] = {
        "columns": _named(columns),
        "action_bounds": action_bounds,
        "path": path,
        "clip_actions": clip_actions,
        "download": download,
    }
    if quality not in RECORDED:
        if env_id is not None:
            _check_rolled_out(env_name, env_id, quality)
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
    spec = None if env_id is None else environment_spec(env_id)
    if quality == "file" and is_memmap_folder(path):
        _refuse_options(path, given)
        data, manifest = load_memmap(path)
        data = data if on_disk else data.clone()
    else:
        recording = open_recorded(
            quality,
            path,
            spec=spec,
            columns=columns,
            action_bounds=action_bounds,
            clip_actions=clip_actions,
            download=download,
            progress=progress and not on_disk,
        )
        data, manifest = recording.load(on_disk=on_disk, progress=progress)
    if spec is not None and env_id is not None:
        _check_fit(data, env_id, spec, path)
    mean = (manifest.get("return") or {}).get("mean")
    references = references or REFERENCE_RETURNS.get(env_name)
    score = None if mean is None or references is None else references.score(mean)
    return data, manifest | {
        "env_name": env_name,
        "quality": quality,
        "normalized_score": score,
    }


def _check_rolled_out(env_name: str, env_id: str, quality: str) -> None:
    known, name = [*load_behavior_card(), *MAZE_IDS], environment_name(env_id)
    if name not in known:
        raise ValueError(
            f"there are no built-in data of {env_id}, only of {', '.join(known)}: "
            f"record some with 'torchrl-osr collect env.id={env_id} path={name}.npz', "
            f"then add data=file data.path={name}.npz."
        )
    if name != env_name:
        raise ValueError(
            f"data={quality} is rolled out for the task {name}: leave out "
            f"env.name={env_name}, or bring data of your own with data=file."
        )


def open_recorded(
    quality: str,
    path: str,
    *,
    spec: EnvironmentSpec | None = None,
    columns: Mapping[str, Any] | None = None,
    action_bounds: ActionBounds | None = None,
    clip_actions: bool = False,
    download: bool = False,
    progress: bool = True,
) -> Recording:
    """Open recorded data, none of whose rows is read yet; see :func:`load_dataset`."""
    columns = _named(columns)
    options: dict[str, Any] = {"clip_actions": clip_actions}
    if spec is not None and spec.discrete and quality != "file":
        raise ValueError(f"data={quality} has no discrete actions; data=file has.")
    # Each reader needs a library of its own, and only the one that is asked for.
    if quality == "minari":
        from torchrl_osr.lab.data.read.minari import open_minari

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
            **options,
        )
    options |= _actions(spec, action_bounds)
    if quality == "file":
        from torchrl_osr.lab.data.read.files import open_file

        return open_file(path, columns=columns, **options)
    from torchrl_osr.lab.data.read.d4rl import open_d4rl

    if columns:
        raise ValueError(
            "data.columns has no use with data=d4rl, which has D4RL's own names; "
            "data=file reads HDF5 files with others."
        )
    return open_d4rl(path, download=download, progress=progress, **options)


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


def _actions(
    spec: EnvironmentSpec | None, action_bounds: ActionBounds | None
) -> dict[str, Any]:
    """Options of a reader: bounds as given, else the task's own; -1 and 1 without."""
    if spec is not None and spec.discrete:
        if action_bounds:
            raise ValueError("data.action_bounds has no use with discrete actions.")
        return {"num_actions": spec.action_size}
    if action_bounds or spec is None or spec.action_low is None:
        return {"action_bounds": action_bounds or (-1.0, 1.0)}
    low, high = set(spec.action_low), set(spec.action_high or [])
    # As numbers where they are the same for all: data of another size are told as such.
    if len(low) == len(high) == 1:
        return {"action_bounds": (low.pop(), high.pop())}
    return {"action_bounds": (spec.action_low, spec.action_high)}


def _check_fit(data: TensorDict, env_id: str, spec: EnvironmentSpec, path: str) -> None:
    """Raise unless the data have the task's observations and actions."""
    ours = [data[name].shape[-1] for name in ("observation", "action")]
    if ours != [spec.observation_size, spec.action_size]:
        cure = "choose the env that the data are of."
        if environment_name(env_id).startswith("antmaze"):
            cure += (
                " Its observations hold the goal. D4RL's own files of the ant do not, "
                "and are of a mirrored maze: data=minari, see docs/mazes.md."
            )
        kind = f"from {spec.action_low} to {spec.action_high}"
        raise ValueError(
            f"{path} has {ours[0]} observation and {ours[1]} action entries, {env_id} "
            f"has {spec.observation_size} and {spec.action_size} "
            f"({'one of them is chosen' if spec.discrete else kind}): {cure}"
        )
    if spec.discrete and not all(map(_one_hot, data["action"].split(CHUNK_ROWS))):
        raise ValueError(
            f"{path} has actions that are real numbers, {env_id} has "
            f"{spec.action_size} discrete ones: choose the env that the data are of."
        )


def _one_hot(action: Tensor) -> bool:
    """Whether each row ``[A]`` is one 1 among zeros."""
    ones = (action == 1).sum(-1)
    return bool((ones == 1).all() and ((action != 0).sum(-1) == 1).all())
