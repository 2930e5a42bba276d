"""A loss module's ``in_keys`` and ``out_keys``, in a stable order.

TorchRL 0.14.1 builds them from sets, so that their order changes from one process to
the next, and with it the meaning of positional arguments and results.
"""

from __future__ import annotations

from abc import abstractmethod

from tensordict import NestedKey
from torchrl.objectives import LossModule


class KeyedLoss(LossModule):
    """Abstract base of the losses here: their keys follow every renaming."""

    def __init__(self) -> None:
        super().__init__()
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[NestedKey] | None = None

    @abstractmethod
    def _input_keys(self) -> list[NestedKey]:
        """Return what the loss reads; repetitions are dropped."""

    @abstractmethod
    def _output_keys(self) -> list[NestedKey]:
        """Return what the loss writes, in the order in which it does."""

    def _set_in_keys(self) -> None:
        """Forget the keys: TorchRL calls this when one was renamed."""
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that the loss reads."""
        if self._in_keys is None:
            self._in_keys = list(dict.fromkeys(self._input_keys()))
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def out_keys(self) -> list[NestedKey]:
        """The entries that the loss writes."""
        if self._out_keys is None:
            self._out_keys = self._output_keys()
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[NestedKey]) -> None:
        self._out_keys = values
