"""Load any supported data set: rolled out on this machine, or recorded."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr import __version__
from torchrl_osr._extras import needed_by
from torchrl_osr._files import check_disk_space
from torchrl_osr.lab.data.behavior import load_behavior_card
from torchrl_osr.lab.data.environment import (
    MAZE_IDS,
    EnvironmentSpec,
    environment_id,
    environment_name,
    environment_spec,
)
from torchrl_osr.lab.data.recording import Recording
from torchrl_osr.lab.data.rollout import behavior_of, collect_source
from torchrl_osr.lab.data.rows import mix_datasets
from torchrl_osr.lab.data.scores import REFERENCE_RETURNS, ReferenceReturns
from torchrl_osr.lab.data.statistics import describe_episodes
from torchrl_osr.lab.data.store import (
    CACHE_VARIABLE,
    CHUNK_ROWS,
    cache_root,
    is_memmap_folder,
    load_memmap,
    load_or_write,
)
from torchrl_osr.lab.data.transitions import ActionBounds, Reading

log = logging.getLogger(__name__)

RECORDED = ("minari", "d4rl", "file")
"""Sources that are recorded; the others are rolled out."""

# Raise it whenever the roll-outs change: older sets are then made anew.
RECIPE_VERSION = 1


def load_dataset(
    env_name: str | None = None,
    source: str = "file",
    *,
    env_id: str | None = None,
    references: ReferenceReturns | None = None,
    path: str | Path | Sequence[str] | None = None,
    columns: Mapping[str, Any] | None = None,
    action_bounds: ActionBounds | None = None,
    clip_actions: bool = False,
    missing: str = "error",
    download: bool = False,
    num_transitions: int = 200_000,
    random_share: float = 0.0,
    seed: int = 0,
    cache_dir: Path | str | None = None,
    on_disk: bool = False,
    progress: bool = True,
) -> tuple[TensorDict, dict[str, Any]]:
    """Load a data set that is rolled out on this machine, or a recorded one.

    A rolled-out set is collected at first use, about 10,000 transitions a second, and
    read from the cache folder ever after. The same seed gives the same data on one
    machine and one set of library versions: contact dynamics are chaotic.

    Args:
        env_name: short name of the task: ``"hopper"``, ``"walker2d"``,
            ``"halfcheetah"``, ``"pointmaze-umaze"``, ``-medium`` or ``-large``; any, or
            ``None``, for recorded data.
        source: ``"random"``, ``"medium"``, ``"medium-replay"``, ``"medium-expert"`` or
            ``"expert"``; of a maze ``"diverse"`` or ``"play"``; ``"minari"``,
            ``"d4rl"`` or ``"file"``. Default: ``"file"``.

    Keyword Args:
        env_id: Gymnasium id of the task. The actions of a ``"file"`` are then in its
            units, and data that do not fit it are refused. Default: actions within -1
            and 1, not compared.
        references: scale of the scores. Default: D4RL's, if there are any.
        path: of recorded data. ``"file"``: CSV, Parquet, HDF5 or NumPy archive, a list
            or a pattern (``"logs/*.csv"``) of files that make one log, or a folder that
            :func:`~torchrl_osr.lab.data.write_memmap` has written. ``"minari"``: a
            name, such as ``"mujoco/hopper/medium-v0"``, or a folder. ``"d4rl"``: an
            HDF5 file of D4RL.
        columns: of a ``"file"``, names of columns by their part: ``observation``,
            ``action``, ``reward``, ``terminated``, ``truncated``, ``episode``,
            ``next_observation``, as in
            :func:`~torchrl_osr.lab.data.transitions_from_columns`, and ``step``, by
            which the rows of an episode are sorted: numbers, or time stamps in ISO
            format. Names may be patterns (``"obs_*"``), or lists, one name an entry.
            ``terminated=False`` says that nothing ends the task. Of ``"minari"``,
            ``observation`` alone: entries of a dictionary. Default: the usual names.
        action_bounds: lowest and highest action of the recording. Default: of
            ``"minari"`` its action space; otherwise the task's own bounds.
        clip_actions, missing: see
            :func:`~torchrl_osr.lab.data.transitions_from_columns`.
        download: fetch the Minari set of that name. Default: ``False``.
        num_transitions: exact number of rolled-out transitions. Default: 200,000.
        random_share: share of the rolled-out rows that are random instead: limited
            valuable data, section 5.3 of the paper. Default: 0.
        seed: of the roll-outs, and of the choice of random rows. Default: 0.
        cache_dir: cache folder of rolled-out data. Default: ``TORCHRL_OSR_CACHE``, else
            the user's.
        on_disk: leave the rows memory-mapped. Parquet and Minari are converted in
            parts, other files from memory. Default: ``False``.
        progress: show a progress bar when on a terminal. Default: ``True``.

    Returns:
        The transitions ``[N]`` and their manifest; ``"normalized_score"`` in it is
        ``None`` without reference returns or without a complete episode.

    Raises:
        ValueError: an option is missing or has no effect, a task or a source is
            unknown, or the data do not fit the task.

    Examples:
        >>> from torchrl_osr.lab.data import load_dataset
        >>> data, manifest = load_dataset("hopper", "random", num_transitions=500)
        >>> data["observation"].shape, manifest["env_id"]
        (torch.Size([500, 11]), 'Hopper-v5')
    """
    columns = {part: name for part, name in (columns or {}).items() if name is not None}
    reading: dict[str, Any] = {
        "columns": columns,
        "action_bounds": action_bounds,
        "clip_actions": clip_actions,
        "missing": missing,
        "download": download,
    }
    if source not in RECORDED:
        _refuse(reading | {"path": path}, f"data={source}, which is rolled out")
        _check_rolled_out(env_name, env_id, source)
        recipe = {"num_transitions": num_transitions, "seed": seed}
        root, name = cache_root(cache_dir), str(env_name)
        return _rolled_out(root, name, source, recipe, random_share, on_disk, progress)
    if path is None:
        raise ValueError(f"data={source} needs data.path=...")
    _refuse({"random_share": random_share}, f"data={source}")
    spec = None if env_id is None else environment_spec(env_id)
    if source == "file" and isinstance(path, (str, Path)) and is_memmap_folder(path):
        _refuse(reading, f"{path}, which is converted")
        data, manifest = load_memmap(path)
        data = data if on_disk else data.clone()
    else:
        recording = open_recorded(source, path, spec=spec, progress=progress, **reading)
        data, manifest = recording.load(on_disk=on_disk, progress=progress)
    if spec is not None:
        _check_fit(data, manifest, str(env_id), spec)
    mean = (manifest.get("return") or {}).get("mean")
    references = references or REFERENCE_RETURNS.get(str(env_name))
    score = None if mean is None or references is None else references.score(mean)
    added = {"env_name": env_name, "source": source, "normalized_score": score}
    return data, manifest | added


def _refuse(options: Mapping[str, Any], source: str) -> None:
    """Raise if an option that has no effect with a source is not its default."""
    for name, value in options.items():
        if value and value != "error":
            raise ValueError(f"data.{name}={value} has no effect with {source}.")


def open_recorded(
    source: str,
    path: str | Path | Sequence[str],
    *,
    spec: EnvironmentSpec | None = None,
    columns: Mapping[str, Any] | None = None,
    action_bounds: ActionBounds | None = None,
    clip_actions: bool = False,
    missing: str = "error",
    download: bool = False,
    progress: bool = True,
) -> Recording:
    """Open recorded data, no row of which is read yet; see :func:`load_dataset`."""
    columns = {part: name for part, name in (columns or {}).items() if name is not None}
    if source != "file":
        given = {f"columns.{part}": name for part, name in columns.items()}
        if source == "minari":
            given.pop("columns.observation", None)
        _refuse(given, f"data={source}")
    number = spec.action_size if spec is not None and spec.discrete else None
    if number is not None:
        _refuse({"action_bounds": action_bounds}, "discrete actions")
    elif spec is not None and action_bounds is None and source != "minari":
        low, high = spec.action_low or [], spec.action_high or []
        # Numbers where they are the same for all: they fit data of another size.
        alike = len({*low}) == len({*high}) == 1
        action_bounds = (low[0], high[0]) if alike else (low, high)
    if action_bounds is None and source != "minari":
        action_bounds = -1.0, 1.0
    options = Reading(action_bounds, clip_actions, number, missing)
    # Each reader needs a library of its own.
    if source == "minari":
        from torchrl_osr.lab.data.minari import open_minari

        entries = columns.get("observation")
        return open_minari(path, options, entries, download=download, progress=progress)
    from torchrl_osr.lab.data.table import D4RL_NAMES, open_log

    _refuse({"download": download}, f"data={source}")
    names = D4RL_NAMES if source == "d4rl" else columns
    return open_log(path, names, options, source)


def _check_rolled_out(env_name: str | None, env_id: str | None, source: str) -> None:
    name = env_name if env_id is None else environment_name(env_id)
    known = [*load_behavior_card(), *MAZE_IDS]
    if name not in known or name != env_name:
        raise ValueError(
            f"data={source} is rolled out for env.name={', '.join(known)}, not for "
            f"{env_id or env_name} as {env_name}: record data with 'torchrl-osr "
            f"collect env.id={env_id} path={name}.npz', then add data=file "
            f"data.path={name}.npz."
        )


def _check_fit(
    data: TensorDict, manifest: Mapping[str, Any], env_id: str, spec: EnvironmentSpec
) -> None:
    """Raise unless the data have the task's observations and actions."""
    ours = [data[name].shape[-1] for name in ("observation", "action")]
    parts = data["action"].split(CHUNK_ROWS)
    hot = all(bool((p.sum(1) == 1).all() and (p * (1 - p) == 0).all()) for p in parts)
    if ours != [spec.observation_size, spec.action_size] or spec.discrete > hot:
        kind = "discrete" if spec.discrete else "real"
        raise ValueError(
            f"the data have {ours[0]} observation and {ours[1]} action entries, "
            f"{env_id} has {spec.observation_size} and {spec.action_size} ({kind}): "
            "choose the env that the data are of."
        )
    if manifest.get("source") == "minari" and not spec.discrete:
        bounds = manifest["action_bounds"]
        task: Any = [spec.action_low, spec.action_high]
        if not all(map(np.allclose, bounds, task)):
            torchrl_logger.warning(
                f"The actions of the Minari set have the bounds {bounds}, those of "
                f"{env_id} {task}: actions are rescaled. If the environment clipped "
                "them, give data.action_bounds=[low,high] and data.clip_actions=true."
            )


def _rolled_out(
    root: Path,
    env_name: str,
    source: str,
    recipe: dict[str, int],
    random_share: float,
    on_disk: bool,
    progress: bool,
) -> tuple[TensorDict, dict[str, Any]]:
    """Open a rolled-out set, with a share of random rows; collect it if need be."""
    data, manifest = _collected(root, env_name, source, recipe, progress)
    if not random_share:
        return data if on_disk else data.clone(), manifest
    if source == "random":
        _refuse({"random_share": random_share}, "data=random")
    other, random = _collected(root, env_name, "random", recipe, progress)
    number = round(random_share * len(data))
    rows = {source: len(data) - number, "random": number}
    scores = [each["normalized_score"] for each in (manifest, random)]
    score = None if None in scores else np.average(scores, weights=[*rows.values()])
    mixture = {
        "env_name": env_name,
        "source": source,
        **recipe,
        "random_share": random_share,
        "rows": rows,
        "normalized_score": None if score is None else float(score),
        "sources": {source: manifest, "random": random},
    }

    def mixed() -> TensorDict:
        seed = recipe["seed"]
        return mix_datasets(data, other, random_share=random_share, seed=seed)

    if not on_disk:
        return mixed(), mixture
    name = f"{_name(env_name, source, recipe)}-random{random_share}"
    folder = root / "collected" / name
    return load_or_write(folder, mixture, lambda: mixed().split(CHUNK_ROWS))


def _collected(
    root: Path, env_name: str, source: str, recipe: dict[str, int], progress: bool
) -> tuple[TensorDict, dict[str, Any]]:
    """Open one source's own set, memory-mapped; collect it first if need be."""
    folder = root / "collected" / _name(env_name, source, recipe)
    maze = env_name in MAZE_IDS
    # Other versions of these give other data for the same seed.
    packages = ["numpy", "gymnasium", "mujoco"] + ["gymnasium-robotics"] * maze
    with needed_by("collecting data needs", "mazes" if maze else "train"):
        versions = {package: version(package) for package in packages}
    request = {
        "recipe_version": RECIPE_VERSION,
        "env_name": env_name,
        "env_id": environment_id(env_name),
        "source": source,
        **recipe,
        **behavior_of(env_name, source),
        "versions": versions,
    }
    episodes: dict[str, Any] = {}

    def collect() -> Iterator[TensorDict]:
        rows = recipe["num_transitions"]
        spec = environment_spec(request["env_id"])
        size = 4 * (2 * spec.observation_size + spec.action_size + 1) + 3  # three flags
        what = f"the data set ({CACHE_VARIABLE}=/path chooses the folder)"
        check_disk_space(folder, rows * size, what)
        log.info(f"rolls out {rows:,} transitions of {env_name} {source} to {folder}")
        data, returns, lengths = collect_source(
            env_name, source, rows, seed=recipe["seed"], progress=progress
        )
        episodes.update(describe_episodes(returns, lengths), normalized_score=None)
        if len(returns):
            mean = float(returns.mean())
            episodes["normalized_score"] = REFERENCE_RETURNS[env_name].score(mean)
        yield from data.split(CHUNK_ROWS)

    return load_or_write(
        folder,
        request,
        collect,
        describe=lambda: {"torchrl_osr_version": __version__, **episodes},
    )


def _name(env_name: str, source: str, recipe: Mapping[str, int]) -> str:
    return f"{env_name}-{source}-{recipe['num_transitions']}-seed{recipe['seed']}"
