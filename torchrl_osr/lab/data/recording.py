"""Recorded steps become transitions, in memory or on disk."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr._files import sha256_of
from torchrl_osr.lab.data.statistics import describe_episodes
from torchrl_osr.lab.data.store import Dataset, cache_root, load_or_write
from torchrl_osr.lab.data.transitions import (
    ActionBounds,
    Columns,
    Part,
    Reading,
    check_dataset,
    trajectories,
)

# Raise it whenever other rows or another manifest are made of a source: recordings in
# the cache are then converted anew.
READER_VERSION = 4

WARNINGS = {
    "actions_outside": "had actions outside their bounds, which were clipped",
    "missing_rows": "were left out: values were missing (data.missing)",
    "reset_rows": "were left out: they begin where an episode ended, with a reward of "
    "0, as a vector environment records its resets",
}

# Changes that float32 loses, of all changes of an entry, before a warning is due.
VANISHED_SHARE = 0.01


@dataclass
class Recording:
    """A recorded data set, to be converted once.

    ``parts`` is its reader: it yields columns of whole trajectories, a file or many
    rows at a time. ``about`` goes into the manifest.
    """

    parts: Callable[[], Iterable[Columns]]
    options: Reading
    about: dict[str, Any] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    _parts: list[Part] = field(default_factory=list, init=False)

    def load(self, *, on_disk: bool = False) -> Dataset:
        """Transitions ``[N]`` and their manifest; on disk, converted in parts."""
        if on_disk:
            # Sizes and times: to read a large source at each start is slow.
            states = [(str(file.resolve()), file.stat()) for file in self.files]
            request = self.about | {
                "reader_version": READER_VERSION,
                "source_files": [[n, s.st_size, s.st_mtime_ns] for n, s in states],
                "options": asdict(self.options) | {"action_bounds": self._bounds()},
            }
            text = json.dumps(request, sort_keys=True)
            digest = hashlib.sha256(text.encode()).hexdigest()[:16]
            folder = cache_root() / "recorded" / f"{self.about['source']}-{digest}"
            data, manifest = load_or_write(
                folder, request, self._transitions, describe=self._manifest
            )
        else:
            data = torch.cat([*self._transitions()])
            check_dataset(data)
            manifest = {"num_transitions": len(data)} | self._manifest()
        for warning in manifest["warnings"]:
            torchrl_logger.warning(warning)
        return data, manifest

    def _bounds(self) -> list[Any]:
        return [np.asarray(b, np.float64).tolist() for b in self.options.action_bounds]

    def _transitions(self) -> Iterator[TensorDict]:
        kept = 0
        for columns in self.parts():
            part = trajectories(columns, self.options)
            kept += len(part.data)
            self._parts.append(part._replace(data=TensorDict()))  # not the rows
            if len(part.data):
                yield part.data
        if not kept:
            raise ValueError("no row has a true next state: give next_observation.")

    def _manifest(self) -> dict[str, Any]:
        """Facts about the transitions once all have been read."""
        counts: Counter[str] = Counter()
        for part in self._parts:
            counts.update(part.counts)
        episodes = np.concatenate([part.episodes for part in self._parts])
        whole = episodes[:, 2] == 1
        returns, lengths = episodes[:, 0], episodes[:, 1].astype(int)
        return {
            **self.about,
            "data_sha256": [sha256_of(file) for file in self.files],
            **counts,
            "num_actions": self.options.num_actions,
            "action_bounds": self._bounds(),
            **describe_episodes(returns[whole], lengths[whole]),
            "incomplete_returns": returns[~whole].tolist(),
            "incomplete_lengths": lengths[~whole].tolist(),
            "warnings": [*self._warnings(counts)],
        }

    def _warnings(self, counts: Mapping[str, int]) -> Iterator[str]:
        total: Any = sum(part.changes for part in self._parts)
        moved, lost = total
        for entry in np.flatnonzero(lost > VANISHED_SHARE * moved):
            reward = entry == len(moved) - 1
            yield (
                f"{'reward' if reward else f'observation[{entry}]'} changes "
                f"{moved[entry]:,} times from one row to the next, and {lost[entry]:,} "
                "of these changes vanish in float32: subtract a constant (of a clock, "
                "its first value), or leave the entry out."
            )
        for name, flaw in WARNINGS.items():
            if counts[name]:
                yield f"{counts[name]:,} rows {flaw}."


def transitions_from_columns(
    columns: Columns,
    *,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
    num_actions: int | None = None,
    missing: str = "error",
) -> Dataset:
    """Turn recorded steps, in order of time, into a data set.

    A trajectory ends where a row is terminated or truncated, where the episode number
    changes, and at the last row; an end without a flag becomes ``truncated``. Without
    ``next_observation``, a row's next state is the observation of the following row.
    The last row of a trajectory has none: it stays, with its own observation as next
    state, if it is terminated, because no loss reads that. Otherwise it is dropped, and
    the row before it becomes ``truncated``.

    Args:
        columns: ``observation`` ``[N, S]``, ``action`` ``[N, A]``, ``reward`` and
            ``terminated`` ``[N]`` or ``[N, 1]``; of the same shape ``truncated`` or
            ``episode`` (whole numbers) or both; possibly ``next_observation``
            ``[N, S]``. Flags are bool, or 0 and 1 of any type.

    Keyword Args:
        action_bounds: lowest and highest action, mapped to -1 and 1. Default: -1 and 1.
            The actions are then clipped to ±0.999.
        clip_actions: clip actions outside their bounds, as MuJoCo does, rather than
            raise. Default: ``False``.
        num_actions: number of discrete actions: ``action`` then holds their numbers
            from 0, ``[N]``, and becomes one-hot. Default: actions are real.
        missing: ``"row"`` leaves out rows with missing values (NaN or masked) and cuts
            their trajectories there, ``"episode"`` leaves out their trajectories,
            ``"error"`` raises. Default: ``"error"``.

    Returns:
        The transitions in float32, and a manifest: counts of rows and ends, returns and
        lengths of the complete and the incomplete episodes, and ``warnings``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_osr.lab.data import transitions_from_columns
        >>> columns = {
        ...     "observation": np.arange(1.0, 9.0).reshape(4, 2),
        ...     "action": np.full((4, 1), 0.5),
        ...     "reward": np.ones(4),
        ...     "terminated": [False, True, False, False],
        ...     "truncated": [False, False, False, True],
        ... }
        >>> data, manifest = transitions_from_columns(columns)
        >>> data["next", "observation"].tolist()  # of row 1: no loss reads it
        [[3.0, 4.0], [3.0, 4.0], [7.0, 8.0]]
        >>> manifest["dropped_rows"], manifest["episode_returns"]
        (1, [2.0, 2.0])
    """
    options = Reading(action_bounds, clip_actions, num_actions, missing)
    return Recording(lambda: [columns], options).load()
