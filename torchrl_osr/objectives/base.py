"""What every loss here does alike: its keys, its reduction and what it returns.

Shapes: ``B`` batch (any leading dimensions).
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_osr._checks import check_choice

Reduction = Literal["none", "mean", "sum"] | None
ScalarOutputMode = Literal["exclude", "non_tensor"] | None


class BaseLoss(LossModule):
    """Abstract base: keys in a stable order that follow every renaming, reduction.

    TorchRL 0.14.1 builds ``in_keys`` from sets, so that their order changes from one
    process to the next, and with it the meaning of positional arguments.

    Args:
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Keyword Args:
        use_prioritized_weights: weigh rows by ``"priority_weight"``.
        scalar_output_mode: what happens to scalar metrics under ``"none"``.
    """

    def __init__(
        self,
        reduction: Reduction,
        *,
        use_prioritized_weights: bool | Literal["auto"] = False,
        scalar_output_mode: ScalarOutputMode = "exclude",
    ) -> None:
        check_choice("reduction", reduction, (None, "none", "mean", "sum"))
        check_choice(
            "scalar_output_mode", scalar_output_mode, (None, "exclude", "non_tensor")
        )
        super().__init__()
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[NestedKey] | None = None
        self.use_prioritized_weights = use_prioritized_weights
        self.reduction = reduction or "mean"
        if self.reduction == "none" and scalar_output_mode is None:
            warnings.warn(
                f"{type(self).__name__} with reduction='none' leaves its scalar "
                "metrics out; pass scalar_output_mode='exclude' to say so, or "
                "'non_tensor' to keep them.",
                stacklevel=4,
            )
            scalar_output_mode = "exclude"
        self.scalar_output_mode = scalar_output_mode

    @abstractmethod
    def _input_keys(self) -> list[NestedKey]:
        """Return what the loss reads; repetitions are dropped."""

    @abstractmethod
    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        """Return the losses and the metrics that it writes, in their order."""

    def _set_in_keys(self) -> None:
        """Forget the keys: TorchRL calls this when one was renamed."""
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that the loss reads."""
        if self._in_keys is None:
            keys = list(dict.fromkeys(self._input_keys()))
            if torch.compiler.is_compiling():
                # Kept, they would make torch.compile trace the second call anew.
                return keys
            self._in_keys = keys
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def out_keys(self) -> list[NestedKey]:
        """The entries that the loss writes."""
        if self._out_keys is None:
            losses, metrics = self._output_keys()
            kept = self.reduction != "none" or self.scalar_output_mode == "non_tensor"
            self._out_keys = losses + metrics if kept else losses
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[NestedKey]) -> None:
        self._out_keys = values

    def _weights(self, tensordict: TensorDictBase) -> Tensor | None:
        """Return the rows' importance weights, if there are any to be used."""
        if self.use_prioritized_weights is False:
            return None
        # Not TorchRL's _maybe_get_priority_weight, which fails with a nested key.
        weights: Tensor | None = tensordict.get(self.tensor_keys.priority_weight, None)
        return weights

    def _reduce(self, value: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Reduce ``[B]`` as the user asked, with the batch's masks and weights."""
        weights = self._weights(tensordict)
        reduced: Tensor = self._reduce_loss(value, tensordict, weights=weights)
        return reduced

    def _mean(self, value: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Return the mean of a metric ``[..., B]`` over what the masks leave."""
        value = value.detach().reshape(-1, *tensordict.batch_size).mean(0)
        mean: Tensor = self._reduce_loss(value, tensordict, reduction="mean")
        return mean

    def _output(
        self,
        tensordict: TensorDictBase,
        losses: dict[str, Tensor],
        metrics: dict[str, Tensor],
    ) -> TensorDictBase:
        """Assemble what the loss returns, in the order of ``out_keys``."""
        if self.reduction == "none":
            out = TensorDict(losses, batch_size=tensordict.batch_size)
            if self.scalar_output_mode == "non_tensor":
                for name, value in metrics.items():
                    out.set_non_tensor(name, value)
        else:
            out = TensorDict(losses | metrics, batch_size=[])
        params = [name for name in self._modules if name.endswith("_params")]
        self._clear_weakrefs(tensordict, out, *params)
        return out
