"""One door for every data set that a configuration can name."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict
from torch import Tensor

from torchrl_osr.data.collect.behavior import load_behavior_card
from torchrl_osr.data.collect.environment import (
    MAZE_IDS,
    EnvironmentSpec,
    environment_name,
    environment_spec,
)
from torchrl_osr.data.collect.local import load_local_dataset
from torchrl_osr.data.collect.reference_scores import (
    REFERENCE_RETURNS,
    ReferenceReturns,
)
from torchrl_osr.data.store.cache import CHUNK_ROWS
from torchrl_osr.data.store.memmap import is_memmap_folder, load_memmap

RECORDED = ("minari", "d4rl", "file")
"""What ``quality`` may be besides the qualities that are rolled out: our readers."""


def load_dataset(
    env_name: str,
    quality: str,
    *,
    env_id: str | None = None,
    references: ReferenceReturns | None = None,
    path: str | None = None,
    download: bool = False,
    progress: bool = True,
    on_disk: bool = False,
    **recipe: Any,
) -> tuple[TensorDict, dict[str, Any]]:
    """Load a rolled-out data set by its quality, or a recorded one by its path.

    Args:
        env_name: short name of the task.
        quality: one of ``QUALITIES``, see :func:`~torchrl_osr.data.load_local_dataset`;
            or ``"minari"``, ``"d4rl"`` or ``"file"``, see the loaders of that name.

    Keyword Args:
        env_id: Gymnasium id of the task. The actions of a ``"file"`` are then in its
            units, and data that do not fit it are refused at once, not at the first
            evaluation. Default: actions within -1 and 1, not compared.
        references: what recorded episodes are scored by. Default: D4RL's of the name,
            if there are any.
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
            a task of which there are no data to roll out, or data that do not fit it.
    """
    if quality not in RECORDED:
        if env_id is not None:
            _check_rolled_out(env_name, env_id, quality)
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
    spec = None if env_id is None else environment_spec(env_id)
    data, manifest = _load_recorded(quality, path, download, progress, on_disk, spec)
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


def _load_recorded(
    quality: str,
    path: str,
    download: bool,
    progress: bool,
    on_disk: bool,
    spec: EnvironmentSpec | None,
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

    actions: dict[str, Any] = {}
    if spec is not None and spec.discrete:
        actions = {"num_actions": spec.action_size}
    elif spec is not None:
        # As numbers where all are alike: then what has another size is told as such.
        low, high = (
            bound[0] if len({*bound}) == 1 else bound
            for bound in (spec.action_low, spec.action_high)
            if bound is not None
        )
        actions = {"action_bounds": (low, high)}
    return load_file(path, **actions, progress=progress, on_disk=on_disk)


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
