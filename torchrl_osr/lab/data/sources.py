"""Load any supported data set: rolled out on this machine, or recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr import __version__
from torchrl_osr._checks import needed_by
from torchrl_osr.lab.data.columns import ActionBounds, Reading, has_rewards
from torchrl_osr.lab.data.environment import (
    MAZE_IDS,
    EnvironmentSpec,
    environment_name,
    environment_spec,
    known_ids,
)
from torchrl_osr.lab.data.rollout import behavior_of, collect_source
from torchrl_osr.lab.data.rows import mix_datasets
from torchrl_osr.lab.data.statistics import REFERENCE_RETURNS, ReferenceReturns
from torchrl_osr.lab.data.store import Dataset, cache_root, load_or_write

RECORDED = ("minari", "d4rl", "lerobot", "file")
"""Sources that are recorded; the others are rolled out."""

# Raise it whenever the rollouts change: older sets are then collected again.
RECIPE_VERSION = 1


def load_dataset(
    env_name: str | None = None,
    source: str = "file",
    *,
    env_id: str | None = None,
    references: ReferenceReturns | None = None,
    path: str | Path | Sequence[str] | None = None,
    columns: Mapping[str, Any] | None = None,
    action_bounds: ActionBounds | Literal["log"] | None = None,
    num_actions: int | None = None,
    clip_actions: bool = False,
    missing: str = "error",
    download: bool = False,
    num_transitions: int | None = None,
    random_share: float = 0.0,
    seed: int = 0,
    progress: bool = True,
) -> Dataset:
    """Load a data set that is rolled out on this machine, or a recorded one.

    A rolled-out set is collected at first use and later read from the cache folder.

    Args:
        env_name: short name of the task, ``"hopper"``; not needed for recorded data.
        source: behaviour policy, such as ``"medium-replay"``; in a maze ``"diverse"``,
            ``"play"`` or ``"umaze"``. Recorded data: ``"minari"``, ``"d4rl"``,
            ``"lerobot"`` or ``"file"``.

    Keyword Args:
        env_id: Gymnasium id of the task. The actions of a ``"file"`` are then in its
            units, and data that do not fit it are refused. Default: actions within -1
            and 1, not compared.
        references: scale of the scores. Default: D4RL's, if there are any.
        path: file of a log, a list or a pattern of files; name or folder of a Minari
            set; folder of a LeRobot set.
        columns: of a ``"file"`` or ``"lerobot"``, names, patterns or lists of columns
            by their part, see ``docs/your_data.md``. Default: the usual names.
        action_bounds: lowest and highest action of the recording. Default: of
            ``"minari"`` its action space; otherwise the task's own bounds. ``"log"``:
            the range of the recorded actions and 5 % of it on either side.
        num_actions: number of discrete actions. Default: the task's, if it has any.
        clip_actions, missing: see
            :func:`~torchrl_osr.lab.data.transitions_from_columns`.
        download: fetch the Minari set of that name.
        num_transitions, seed: number of rolled-out rows, default 200,000, and seed.
        random_share: share of the rolled-out rows that are random instead.
        progress: show a progress bar when on a terminal.

    Examples:
        >>> from torchrl_osr.lab.data import load_dataset
        >>> data, manifest = load_dataset("hopper", "random", num_transitions=500)
        >>> data["observation"].shape, manifest["env_id"]
        (torch.Size([500, 11]), 'Hopper-v5')
    """
    log: dict[str, Any] = {
        "columns": {k: name for k, name in (columns or {}).items() if name is not None},
        "action_bounds": action_bounds,
        "clip_actions": clip_actions,
        "missing": missing,
        "download": download,
    }
    if source in RECORDED:
        useless = {"random_share": random_share, "num_transitions": num_transitions}
        _refuse(useless, f"data={source}, which is recorded")
        spec = None if env_id is None else environment_spec(env_id)
        if not path:
            raise ValueError(f"data={source} needs data.path=...")
        data, manifest = _recorded(source, path, spec, num_actions, log, progress)
        if spec is not None:
            _check_fit(data, manifest, str(env_id), spec)
    else:
        if path is not None or (env_id is None and env_name not in known_ids()):
            raise ValueError(
                f"data={source} is rolled out in a simulator: for a log, give "
                "data=file data.path=<its place>."
            )
        _refuse(log, f"data={source}, which is rolled out")
        if random_share and (source == "random" or env_name in MAZE_IDS):
            raise ValueError(
                f"data.random_share={random_share} mixes a source with random rows: "
                "choose another source, and no maze."
            )
        name = env_name if env_id is None else environment_name(env_id)
        if name not in known_ids() or name != env_name:
            raise ValueError(
                f"data={source} is rolled out for env.name={', '.join(known_ids())}, "
                f"not for {env_id or env_name} as {env_name}: record data with "
                f"'torchrl-osr collect env.id={env_id} path={name}.npz', then add "
                f"data=file data.path={name}.npz."
            )
        rows = 200_000 if num_transitions is None else num_transitions
        recipe = {"num_transitions": rows, "seed": seed}
        data, manifest = rolled_out(name, source, recipe, progress=progress)
    mean, checksum = _mean_return(manifest), manifest.get("checksum")
    if random_share:
        random, about = rolled_out(str(name), "random", recipe, progress=progress)
        data = mix_datasets(data, random, random_share=random_share, seed=seed)
        checksum = f"{checksum}{about['checksum']}"
        means: Any = mean, _mean_return(about)
        weights = 1 - random_share, random_share
        mean = None if None in means else float(np.average(means, weights=weights))
        manifest = recipe | {"random_share": random_share, "env_id": about["env_id"]}
    references = references or REFERENCE_RETURNS.get(str(env_name))
    score = None if mean is None or references is None else references.score(mean)
    facts = {"mean_return": mean, "normalized_score": score, "checksum": checksum}
    return data, manifest | {"env_name": env_name, "source": source} | facts


def _refuse(options: Mapping[str, Any], source: str) -> None:
    """Raise if an option that has no effect with a source is not its default."""
    for name, value in options.items():
        if value and value != "error":
            raise ValueError(f"data.{name}={value} has no effect with {source}.")


def _mean_return(manifest: Mapping[str, Any]) -> float | None:
    """Return the complete episodes' mean return, where known."""
    returns = manifest.get("episode_returns") if has_rewards(manifest) else None
    return float(np.mean(returns)) if returns else None


def rolled_out(
    env_name: str, source: str, recipe: Mapping[str, int], *, progress: bool
) -> Dataset:
    """Return rows of a source from the cache; collect them at the first use."""
    rows, seed = recipe["num_transitions"], recipe["seed"]
    maze = env_name in MAZE_IDS
    # Other versions of these give other data for the same seed.
    packages = ["numpy", "gymnasium", "mujoco"] + ["gymnasium-robotics"] * maze
    with needed_by("collecting data needs", "mazes" if maze else "train"):
        versions = {package: version(package) for package in packages}
    request = {
        "recipe_version": RECIPE_VERSION,
        "env_name": env_name,
        "env_id": known_ids()[env_name],
        "source": source,
        **recipe,
        **behavior_of(env_name, source),
        "versions": versions,
    }

    def collect() -> Dataset:
        data, *episodes = collect_source(env_name, source, **recipe, progress=progress)
        returns, lengths = (each.tolist() for each in episodes)
        about = {"torchrl_osr_version": __version__, "episode_returns": returns}
        return data, about | {"episode_lengths": lengths}

    name = f"{env_name}-{source}-{rows}-seed{seed}.safetensors"
    return load_or_write(cache_root() / "collected" / name, request, collect)


def _recorded(
    source: str,
    path: str | Path | Sequence[str],
    spec: EnvironmentSpec | None,
    number: int | None,
    log: Mapping[str, Any],
    progress: bool,
) -> Dataset:
    bounds = log["action_bounds"]
    if source not in ("file", "lerobot"):
        _refuse({"columns": log["columns"]}, f"data={source}")
    if spec is not None and spec.discrete:
        number = spec.action_size
    if number is not None:
        useless = {"action_bounds": bounds, "clip_actions": log["clip_actions"]}
        _refuse(useless, "discrete actions")
    if bounds is None and source != "minari":
        bounds = -1.0, 1.0
        if spec is not None and spec.action_low and spec.action_high:
            low, high = bounds = spec.action_low, spec.action_high
            if len({*low}) == len({*high}) == 1:  # they fit data of another size
                bounds = low[0], high[0]
    options = Reading(bounds, log["clip_actions"], number, log["missing"])
    if source == "minari":
        from torchrl_osr.lab.data.minari import read_minari

        return read_minari(path, options, download=log["download"], progress=progress)
    from torchrl_osr.lab.data.lerobot import read_lerobot
    from torchrl_osr.lab.data.table import read_log

    _refuse({"download": log["download"]}, f"data={source}")
    if source == "lerobot":
        return read_lerobot(path, log["columns"], options)
    d4rl = {"observation": "observations"}  # others have their usual names
    return read_log(path, d4rl if source == "d4rl" else log["columns"], options, source)


def _check_fit(
    data: TensorDict, manifest: Mapping[str, Any], env_id: str, spec: EnvironmentSpec
) -> None:
    """Raise unless the data have the task's observations and actions."""
    ours = [data[name].shape[-1] for name in ("observation", "action")]
    fits = ours == [spec.observation_size, spec.action_size]
    if not fits or (manifest["num_actions"] is not None) != spec.discrete:
        kind = "discrete" if spec.discrete else "continuous"
        raise ValueError(
            f"the data have {ours[0]} observation and {ours[1]} action entries, "
            f"{env_id} has {spec.observation_size} and {spec.action_size} ({kind}): "
            "choose the env that the data are of, or env=none."
        )
    if manifest.get("source") == "minari" and not spec.discrete:
        bounds: Any = manifest["action_bounds"]
        task: Any = [spec.action_low, spec.action_high]
        if not all(map(np.allclose, bounds, task)):
            torchrl_logger.warning(
                f"The actions of the Minari set have the bounds {bounds}, those of "
                f"{env_id} {task}: actions are rescaled. If the environment clipped "
                "them, give data.action_bounds=[low,high] and data.clip_actions=true."
            )
