"""A set on disk as the storage of a TorchRL replay buffer."""

from __future__ import annotations

from typing import Any, NoReturn

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

from torchrl_osr.data.on_disk import TransitionsOnDisk


class DiskStorage(Storage):
    """Reads the rows that a buffer has drawn; nothing can be written.

    Args:
        data: the rows; as many as have room are held in memory from now on.

    Keyword Args:
        device: where the batches shall be. The draws are made there too, so that they
            are those of a buffer that holds the rows on that device. Default: CPU.
    """

    def __init__(
        self, data: TransitionsOnDisk, *, device: torch.device | str = "cpu"
    ) -> None:
        super().__init__(len(data))
        self.data, self.device = data, torch.device(device)
        if not data.held:  # or another buffer has seen to it
            data.hold()

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.data)

    def get(self, index: Tensor) -> TensorDict:
        """Read rows ``[B]``."""
        batch = self.data[index]
        return batch if self.device.type == "cpu" else batch.to(self.device)

    def set(self, *_: Any, **__: Any) -> NoReturn:
        """Raise: the data set is what it is."""
        raise RuntimeError(f"{self.data.folder} is a recorded set; none can be added.")

    def _empty(self) -> NoReturn:
        self.set()

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: the rows are in the file."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Do nothing."""
