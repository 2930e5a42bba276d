"""Recorded steps, read whole or in parts, in memory or on disk.

A row's transition depends on its trajectory alone. Hence a recording gives the same
transitions, read at once or in parts of whole trajectories.
"""

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
from torchrl_osr.lab.data.store import CHUNK_ROWS, cache_root, load_or_write
from torchrl_osr.lab.data.transitions import (
    ACTION_LIMIT,
    ActionBounds,
    Array,
    Columns,
    Reading,
    Trajectories,
    check_dataset,
    trajectories,
)

# Raise it whenever other rows or another manifest are made of a source: recordings in
# the cache are then converted anew.
READER_VERSION = 3

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

    ``parts`` yields columns of whole trajectories: about so many rows at a time, or all
    at once. ``about`` goes into the manifest.
    """

    parts: Callable[[int | None], Iterable[Columns]]
    options: Reading
    about: dict[str, Any] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    total: int | None = None
    _parts: list[Trajectories] = field(default_factory=list, init=False)

    def load(
        self, *, on_disk: bool = False, progress: bool = True
    ) -> tuple[TensorDict, dict[str, Any]]:
        """Transitions ``[N]`` and their manifest; on disk, converted in parts."""
        source = str(self.about.get("path", ""))
        try:
            if on_disk:
                # Sizes and times: to read a large source at each start is slow.
                states = [(str(file.resolve()), file.stat()) for file in self.files]
                options = asdict(self.options) | {"action_bounds": self._bounds()}
                request = self.about | {
                    "reader_version": READER_VERSION,
                    "source_files": [[n, s.st_size, s.st_mtime_ns] for n, s in states],
                    "options": options,
                }
                text = json.dumps(request, sort_keys=True)
                digest = hashlib.sha256(text.encode()).hexdigest()[:16]
                data, manifest = load_or_write(
                    cache_root() / "recorded" / f"{self.about['source']}-{digest}",
                    request,
                    lambda: self._transitions(CHUNK_ROWS),
                    describe=self._manifest,
                    total=self.total,
                    progress=progress,
                )
            else:
                first, *others = self._transitions(None)
                data = torch.cat([first, *others]) if others else first
                check_dataset(data)
                manifest = {"num_transitions": len(data)} | self._manifest()
        except ValueError as error:
            if source in str(error):
                raise
            raise ValueError(f"{source}: {error}") from error
        for note in manifest["notes"]:
            torchrl_logger.info(note)
        for warning in manifest["warnings"]:
            torchrl_logger.warning(warning)
        return data, manifest

    def _bounds(self) -> list[Any]:
        return [np.asarray(b, np.float64).tolist() for b in self.options.action_bounds]

    def _transitions(self, rows: int | None) -> Iterator[TensorDict]:
        """Yield transitions of about so many rows of the source, or all at once."""
        read = kept = 0
        before: Array | float = np.nan
        seen: set[float] = set()
        for columns in self.parts(rows):
            try:
                part = trajectories(columns, self.options, before)
                numbers = np.asarray(columns.get("episode", ()), np.float64).reshape(-1)
                numbers = numbers[~np.isnan(numbers)]
                first = np.r_[True, np.diff(numbers) != 0][: len(numbers)]
                for number in numbers[first].tolist():
                    if number in seen:
                        raise ValueError(
                            f"'episode' {number:g} comes back; expected its rows "
                            "together. data.columns.step sorts them."
                        )
                    seen.add(number)
            except ValueError as error:
                where = f"in the rows from {read:,} on: " if read else ""
                raise ValueError(f"{where}{error}") from error
            flags = [columns.get(n, [0])[-1] for n in ("terminated", "truncated")]
            if "next_observation" in columns:
                reached = np.asarray(columns["next_observation"])[-1]
                before = reached if np.any(flags) else np.nan
            read += np.size(columns["reward"])
            kept += len(part.data)
            self._parts.append(part._replace(data=TensorDict()))  # not the rows
            if len(part.data):
                yield part.data
        if not kept:
            raise ValueError(
                f"none of the {read} rows has a true next state: give next_observation."
            )

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
            "action_limit": ACTION_LIMIT,
            "action_bounds": self._bounds(),
            **describe_episodes(returns[whole], lengths[whole]),
            "incomplete_returns": returns[~whole].tolist(),
            "incomplete_lengths": lengths[~whole].tolist(),
            "notes": [*dict.fromkeys(self.notes)],
            "warnings": [*self._warnings(counts)],
        }

    def _warnings(self, counts: Mapping[str, int]) -> Iterator[str]:
        for name in ("observation", "reward"):
            total: Any = sum(part.changes[name] for part in self._parts)
            moved, lost = total
            for entry in np.flatnonzero(lost > VANISHED_SHARE * moved):
                which = f"entry {entry} of {name!r}" if len(moved) > 1 else repr(name)
                yield (
                    f"{which} changes {moved[entry]:,} times from one row to the next, "
                    f"and {lost[entry]:,} of these changes vanish in float32: subtract "
                    "a constant (of a clock, its first value), or leave the entry out."
                )
        for name, flaw in WARNINGS.items():
            if counts[name]:
                yield f"{counts[name]:,} rows {flaw}."


def whole_trajectories(
    chunks: Iterable[Mapping[str, Array]],
) -> Iterator[Mapping[str, Array]]:
    """Regroup chunks of columns into parts of whole trajectories."""
    rest: Mapping[str, Array] = {}
    for chunk in chunks:
        if rest:
            chunk = {n: np.concatenate([rest[n], new]) for n, new in chunk.items()}
        ends = np.zeros(len(chunk["reward"]), np.bool_)
        for name in {"terminated", "truncated"} & chunk.keys():
            ends |= np.nan_to_num(chunk[name].reshape(-1)).astype(np.bool_)
        if "episode" in chunk:
            ends[:-1] |= np.diff(chunk["episode"].reshape(-1)) != 0
        end = int(ends.nonzero()[0][-1]) + 1 if ends.any() else 0
        if end:
            yield {name: column[:end] for name, column in chunk.items()}
        rest = {name: column[end:] for name, column in chunk.items()}
    if rest and len(rest["reward"]):
        yield rest


def transitions_from_columns(
    columns: Columns,
    *,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
    num_actions: int | None = None,
    missing: str = "error",
) -> tuple[TensorDict, dict[str, Any]]:
    """Turn recorded steps, in order of time, into a data set.

    A trajectory ends where a row is terminated or truncated, where the episode number
    changes, and at the last row; an end without a flag becomes ``truncated``. Without
    ``next_observation``, a row's next state is the observation of the following row.
    The last row of a trajectory has no following row. If it is terminated, it stays
    with its own observation as next state, which no loss reads. If not, it is dropped,
    and the row before it becomes ``truncated``.

    Args:
        columns: ``observation`` ``[N, S]``, ``action`` ``[N, A]``, ``reward`` and
            ``terminated`` ``[N]`` or ``[N, 1]``; of the same shape ``truncated`` or
            ``episode`` (whole numbers) or both; possibly ``next_observation``
            ``[N, S]``. Flags are bool, or 0 and 1 of any type.

    Keyword Args:
        action_bounds: lowest and highest action, mapped to -1 and 1. Default: -1 and 1.
            The actions are then clipped to ±0.999, see ``ACTION_LIMIT``.
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

    Raises:
        ValueError: the columns are not as above or contradict one another.

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
    return Recording(lambda _: [columns], options).load()
