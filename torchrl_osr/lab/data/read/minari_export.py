"""From a data set of ours to a Minari set, so that other libraries train on the same.

Shapes: ``N`` rows, ``T`` steps of an episode, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Iterator, Mapping
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_osr._extras import needed_by
from torchrl_osr.lab.data.collect.environment import make_environment
from torchrl_osr.lab.data.store.validation import check_dataset

with needed_by("Minari data sets need", "minari"):
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.storage.datasets_root_dir import get_dataset_path


def export_minari(
    data: TensorDict,
    dataset_id: str,
    *,
    env_id: str | None = None,
    data_format: str = "hdf5",
    **metadata: Any,
) -> Path:
    """Write a data set in Minari's format.

    An episode ends at each row that is done. Minari stores ``T + 1`` observations of
    it, so all other rows must be followed by the row that begins where they end.
    :func:`~torchrl_osr.lab.data.load_minari` reads the same numbers back, bit by bit.

    Args:
        data: transitions ``[N]`` in order of time, as the readers and
            :func:`~torchrl_osr.lab.data.load_local_dataset` return them.
        dataset_id: such as ``"mine/hopper/medium-v0"``, below
            ``MINARI_DATASETS_PATH`` or ``~/.minari/datasets``.

    Keyword Args:
        env_id: Gymnasium id of the task, whose actions must be bounded by -1 and 1;
            ``minari.load_dataset(dataset_id).recover_environment()`` then makes it.
            Default: none.
        data_format: ``"hdf5"``, ``"arrow"`` or ``"parquet"``. Default: ``"hdf5"``.
        **metadata: what :func:`minari.create_dataset_from_buffers` takes besides:
            ``author``, ``author_email``, ``algorithm_name``, ``code_permalink``,
            ``description``, ``ref_min_score``, ...

    Returns:
        The folder of the set.

    Raises:
        ValueError: a row that is not done does not go on in the next, as in shuffled
            or mixed data; the set exists; the task has other spaces; an episode is too
            long for the storage; or the data do not pass
            :func:`~torchrl_osr.lab.data.check_dataset`.
    """
    check_dataset(data)
    stops = _stops(data)
    spaces = {
        name: gymnasium.spaces.Box(-bound, bound, data[key].shape[1:], np.float32)
        for name, key, bound in (
            ("observation_space", "observation", np.inf),
            ("action_space", "action", 1.0),
        )
    }
    if env_id is not None:
        _check_spaces(env_id, spaces)
    folder = Path(get_dataset_path(dataset_id))
    if folder.exists():
        raise ValueError(f"there is a Minari set at {folder}: choose another id.")
    try:
        with warnings.catch_warnings():
            # One for each piece of metadata that is not given: that is the user's.
            warnings.simplefilter("ignore", UserWarning)
            written = minari.create_dataset_from_buffers(
                dataset_id,
                list(_buffers(data, stops)),
                env=None if env_id is None else gymnasium.spec(env_id),
                data_format=data_format,
                **spaces,
                **metadata,
            )
        # Minari 0.5.4 writes long Arrow episodes that it then reads in part.
        if (steps := sum(map(len, written.iterate_episodes()))) != len(data):
            raise ValueError(
                f"Minari reads {steps} of {len(data)} rows back from its {data_format} "
                "storage; choose data_format='hdf5'."
            )
    except BaseException:
        # Half a set would be found, and read, by the next who asks for it.
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder


def _stops(data: TensorDict) -> NDArray[np.int64]:
    """Row after each episode's last."""
    done = data["next", "done"][:, 0].numpy(force=True)
    goes_on = (data["next", "observation"][:-1] == data["observation"][1:]).all(1)
    broken = np.flatnonzero(~done & ~np.r_[goes_on.numpy(force=True), False])
    if len(broken):
        raise ValueError(
            f"row {broken[0]}, and {len(broken) - 1} more, is not done, and the next "
            "row does not begin where it ends; expected whole trajectories in order of "
            "time, not shuffled, mixed or thinned out."
        )
    return np.flatnonzero(done) + 1


def _check_spaces(env_id: str, spaces: Mapping[str, gymnasium.spaces.Box]) -> None:
    with closing(make_environment(env_id)) as env:
        for name, ours in spaces.items():
            theirs = getattr(env.unwrapped, name)
            same = theirs.shape == ours.shape
            if name == "action_space":
                same = same and np.all(theirs.low == -1) and np.all(theirs.high == 1)
            if not same:
                raise ValueError(
                    f"{env_id} has {name} {theirs}, the data {ours}; leave env_id out "
                    "if they are not of that task as it is."
                )


def _buffers(data: TensorDict, stops: NDArray[np.int64]) -> Iterator[EpisodeBuffer]:
    for start, stop in pairwise([0, *stops.tolist()]):
        episode = data[start:stop]
        after = episode["next"]
        states = torch.cat([episode["observation"], after["observation"][-1:]])
        yield EpisodeBuffer(
            observations=states.numpy(force=True),
            actions=episode["action"].numpy(force=True),
            rewards=after["reward"][:, 0].numpy(force=True),
            terminations=after["terminated"][:, 0].numpy(force=True),
            truncations=after["truncated"][:, 0].numpy(force=True),
        )
