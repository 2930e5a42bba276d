"""Transitions as records of one size: what a row is in a file.

The columns of a row lie side by side, so that a random row is one read, where a file a
column would need seven. Each record carries a checksum, so that damage is found when a
row is read, and nobody has to read the whole file before.

Shapes: ``N`` rows, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDict, TensorDictBase

# "done" is not among them: it is terminated or truncated.
KEYS: dict[str, NestedKey] = {
    "observation": "observation",
    "action": "action",
    "next_observation": ("next", "observation"),
    "reward": ("next", "reward"),
    "terminated": ("next", "terminated"),
    "truncated": ("next", "truncated"),
}
"""Columns of a record, and where a set of transitions has them."""


@dataclass(frozen=True)
class RecordLayout:
    r"""Which bytes of a record are what.

    Little-endian float32 observation, action, next observation and reward, two flags,
    two bytes of zero, and the checksum of the 32-bit words :math:`w_i` before it,

    .. math::
        \Big\lfloor 2^{-32} \big(a_0 + \sum_i a_i w_i \bmod 2^{64}\big) \Big\rfloor,

    multilinear hashing: whatever is damaged, it stays unnoticed with probability
    :math:`2^{-32}`. NumPy computes it for a whole batch at once; a CRC of each row
    would take a quarter of the time that its reading takes.

    Args:
        observation_size, action_size: ``S`` and ``A``.
    """

    observation_size: int
    action_size: int

    @classmethod
    def of(cls, data: TensorDictBase) -> RecordLayout:
        """Return the layout of a set of transitions."""
        return cls(data["observation"].shape[-1], data["action"].shape[-1])

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """NumPy's type of a record."""
        return np.dtype(
            [
                ("observation", "<f4", (self.observation_size,)),
                ("action", "<f4", (self.action_size,)),
                ("next_observation", "<f4", (self.observation_size,)),
                ("reward", "<f4", (1,)),
                ("terminated", "?", (1,)),
                ("truncated", "?", (1,)),
                ("zero", "u1", (2,)),
                ("checksum", "<u4"),
            ]
        )

    @cached_property
    def _weights(self) -> NDArray[np.uint64]:
        # NumPy promises that a bit generator's raw numbers stay what they are.
        return np.random.PCG64(0).random_raw(self.dtype.itemsize // 4)

    def _checksums(self, records: NDArray[np.void]) -> NDArray[np.uint32]:
        words = records.view("<u4").reshape(len(records), len(self._weights))[:, :-1]
        sums = words.astype(np.uint64) @ self._weights[1:] + self._weights[0]
        checksums: NDArray[np.uint32] = (sums >> np.uint64(32)).astype(np.uint32)
        return checksums

    def pack(self, data: TensorDictBase) -> NDArray[np.void]:
        """Return the records ``[N]`` of checked transitions ``[N]``."""
        records = np.zeros(len(data), self.dtype)
        for name, key in KEYS.items():
            records[name] = data.get(key).numpy(force=True)
        records["checksum"] = self._checksums(records)
        return records

    def unpack(self, content: NDArray[np.void]) -> TensorDict:
        """Return the transitions of records ``[N]``, of whatever type.

        Raises:
            ValueError: a record is damaged; its number among them is the second
                argument.
        """
        records = content.view(self.dtype)
        wrong = self._checksums(records) != records["checksum"]
        if wrong.any():
            raise ValueError("the checksum of a record is wrong", int(wrong.argmax()))
        # Copies, to be contiguous like the columns of a set in memory.
        column = {name: torch.from_numpy(records[name].copy()) for name in KEYS}
        size = [len(records)]
        following = {
            "observation": column["next_observation"],
            "reward": column["reward"],
            "done": column["terminated"] | column["truncated"],
            "terminated": column["terminated"],
            "truncated": column["truncated"],
        }
        return TensorDict(
            {
                "observation": column["observation"],
                "action": column["action"],
                "next": TensorDict(following, size),
            },
            size,
        )
