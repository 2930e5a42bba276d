"""Replay buffers of offline data, in memory or memory-mapped."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers.storages import Storage
from torchrl.envs.transforms import Transform

from torchrl_osr.lab.data.store import is_memory_mapped

Reader = Callable[[TensorDictBase, Tensor], TensorDictBase]


class MemmapStorage(Storage):
    """Rows of a memory-mapped set as the storage of a replay buffer, read-only.

    Draws are made on the device of the batches, like those of a buffer in memory.
    """

    def __init__(
        self,
        data: TensorDictBase,
        left_out: Tensor | None,
        device: torch.device,
        read: Reader | None,
    ) -> None:
        left_out = torch.empty(0, dtype=torch.long) if left_out is None else left_out
        super().__init__(len(data) - len(left_out))
        self.data, self.device, self.read = data, device, read or operator.getitem
        # Before row i of the rest lie as many of the left-out ones as have no more than
        # i rows of the rest before them.
        self._shifts = left_out - torch.arange(len(left_out))

    def __len__(self) -> int:
        return int(self.max_size)

    def get(self, index: Tensor) -> TensorDictBase:
        """Rows ``[B]``."""
        index = index.cpu()
        rows = index + torch.searchsorted(self._shifts, index, right=True)
        batch = self.read(self.data, rows)
        return batch if self.device.type == "cpu" else batch.to(self.device)

    def state_dict(self) -> dict[str, Any]:
        """Nothing: the rows are in their files."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Do nothing."""


def make_replay_buffer(
    data: TensorDictBase,
    *,
    batch_size: int,
    seed: int,
    left_out: Tensor | None = None,
    transform: Transform | None = None,
    device: torch.device | str | None = None,
    read: Reader | None = None,
) -> ReplayBuffer:
    """Replay buffer that samples a data set uniformly, with replacement.

    The batches depend on ``seed`` alone: the buffer has a generator of its own, and
    does not prefetch, because threads would make the order of the draws depend on time.

    Args:
        data: transitions ``[N]``. Memory-mapped ones (:func:`load_memmap`) stay on
            disk, and the same seed draws the same rows.

    Keyword Args:
        batch_size: rows per ``sample()``.
        seed: of the sampling.
        left_out: sorted numbers of memory-mapped rows that are not drawn.
        transform: applied to each sampled batch.
        device: of the rows and the sampling, or, of a memory-mapped set, of the
            batches. Default: the device of ``data``, or CPU if it has none.
        read: returns rows of memory-mapped data by their numbers.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.lab.data import make_replay_buffer
        >>> data = TensorDict({"observation": torch.rand(100, 3)}, batch_size=[100])
        >>> buffer = make_replay_buffer(data, batch_size=8, seed=0)
        >>> buffer.sample()["observation"].shape
        torch.Size([8, 3])
    """
    if data.ndim != 1 or not len(data):
        raise ValueError(f"data has batch size {[*data.shape]}; expected [N], N > 0.")
    device = torch.device(device or data.device or "cpu")
    options: dict[str, Any] = {
        "batch_size": batch_size,
        "transform": transform,
        "generator": torch.Generator(device).manual_seed(seed),
    }
    if is_memory_mapped(data):
        return ReplayBuffer(
            storage=MemmapStorage(data, left_out, device, read),
            writer=ImmutableDatasetWriter(),
            collate_fn=lambda batch: batch,
            **options,
        )
    if left_out is not None or read is not None:
        raise ValueError("left_out and read are for memory-mapped data.")
    storage = LazyTensorStorage(len(data), device=device)
    buffer = ReplayBuffer(storage=storage, **options)
    buffer.extend(data.to(device))
    return buffer
