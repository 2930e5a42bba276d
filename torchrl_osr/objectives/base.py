"""What TorchRL asks of every loss: keys, networks, value estimator, reduction, output.

Shapes: ``B`` batch (any leading dimensions).
"""

from __future__ import annotations

import inspect
import math
import warnings
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictParams,
    dispatch,
)
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.utils import _vmap_func, dispatch_value_estimator

from torchrl_osr._checks import check_literals, check_positive
from torchrl_osr._entries import nested
from torchrl_osr.modules.initial_weights import digest_of_weights, initial_digest
from torchrl_osr.objectives.distributions import (
    action_bounds,
    check_action_spec,
    check_apart,
    check_same_bounds,
)

Terms = tuple[dict[str, Tensor], dict[str, Tensor]]
"""The losses and the metrics of a batch, by name."""


@dataclass
class TransitionKeys:
    """The entries of a batch that every actor-critic loss reads or writes.

    Attributes:
        action: the data's action. Defaults to ``"action"``.
        value: what the value estimator reads. Defaults to ``"state_value"``.
        reward, done, terminated: below ``"next"``. Default to their own names.
        priority: written to the batch, ``[B]``. Defaults to ``"td_error"``.
        priority_weight: importance weight of a row. Defaults to
            ``"priority_weight"``.
        perturbed: where the perturbed states are. Defaults to ``"perturbed"``.
        state_action_value: what a critic writes. Defaults to
            ``"state_action_value"``.
    """

    action: NestedKey = "action"
    value: NestedKey = "state_value"
    reward: NestedKey = "reward"
    done: NestedKey = "done"
    terminated: NestedKey = "terminated"
    priority: NestedKey = "td_error"
    priority_weight: NestedKey = "priority_weight"
    perturbed: NestedKey = "perturbed"
    state_action_value: NestedKey = "state_action_value"


class BaseLoss(LossModule):
    """Abstract base: keys in a stable order, networks, value estimator, reduction.

    A loss lists its keys and computes its terms. TorchRL 0.14.1 builds ``in_keys`` from
    sets, so that their order, and with it the meaning of positional arguments, changes
    from one process to the next; here the order is that of :meth:`_input_keys`.

    Keyword Args:
        num_qvalue_nets: number of critics ``N`` where a loss is given a single one,
            which TorchRL copies; a list has its own length. Default 2.
        loss_function: distance of the TD error: ``"l2"`` (default), ``"l1"`` or
            ``"smooth_l1"``.
        delay_qvalue: use target networks, to be moved by
            :class:`~torchrl.objectives.SoftUpdate`. Default ``True``.
        gamma: refused as in every loss of TorchRL; it is an argument of
            ``make_value_estimator``.
        deactivate_vmap: run the critics one by one. Default ``False``.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.
        use_prioritized_weights: weigh rows by ``"priority_weight"``; ``"auto"``
            (default) does when the entry is there.
        scalar_output_mode: with ``reduction="none"``, ``"exclude"`` (with a warning by
            default) or ``"non_tensor"`` for the scalar metrics.
    """

    default_value_estimator = ValueEstimators.TD0

    # convert_to_functional wants every network that a loss may hold annotated.
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    qvalue_network: TensorDictModule
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams
    inverse_dynamics_network: ProbabilisticTensorDictSequential
    inverse_dynamics_network_params: TensorDictParams
    target_inverse_dynamics_network_params: TensorDictParams

    def __init__(
        self,
        *,
        num_qvalue_nets: int = 2,
        loss_function: Literal["l2", "l1", "smooth_l1"] = "l2",
        delay_qvalue: bool = True,
        gamma: None = None,
        deactivate_vmap: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
        scalar_output_mode: Literal["exclude", "non_tensor"] | None = None,
    ) -> None:
        check_literals(BaseLoss.__init__, locals())
        if gamma is not None:
            raise TypeError(
                "gamma belongs to the value estimator: leave it out here and call "
                f"loss.make_value_estimator(gamma={gamma}) afterwards."
            )
        super().__init__()
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[NestedKey] | None = None
        self.num_qvalue_nets = num_qvalue_nets
        self.loss_function = loss_function
        self.delay_qvalue = delay_qvalue
        self.deactivate_vmap = deactivate_vmap
        self.use_prioritized_weights = use_prioritized_weights
        self.reduction = reduction or "mean"
        if self.reduction == "none" and scalar_output_mode is None:
            warnings.warn(
                f"{type(self).__name__} with reduction='none' leaves its scalar "
                "metrics out; pass scalar_output_mode='exclude' to say so, or "
                "'non_tensor' to keep them.",
                stacklevel=_first_frame_outside(),
            )
            scalar_output_mode = "exclude"
        self.scalar_output_mode = scalar_output_mode

    # -- networks ---------------------------------------------------------------

    def _hold_actor_critic(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        inverse_dynamics_network: TensorDictModuleBase | None = None,
        delay_actor: bool = False,
    ) -> None:
        """Hold an actor, critics (one to be copied, or a list) and a frozen model."""
        self.delay_actor = delay_actor
        check_apart(
            actor_network=actor_network,
            qvalue_network=qvalue_network,
            inverse_dynamics_network=inverse_dynamics_network,
        )
        self.convert_to_functional(
            actor_network, "actor_network", create_target_params=delay_actor
        )
        if isinstance(qvalue_network, Sequence):
            self.num_qvalue_nets = len(qvalue_network)
        if self.num_qvalue_nets < 1:
            raise ValueError("There must be at least one critic.")
        self.convert_to_functional(
            qvalue_network,
            "qvalue_network",
            self.num_qvalue_nets,
            create_target_params=self.delay_qvalue,
        )
        if isinstance(qvalue_network, Sequence) and self.num_qvalue_nets == 1:
            # TorchRL 0.14.1 keeps a list of one as expanded views of its parameters,
            # which no optimizer finds in loss.parameters().
            own = self.qvalue_network_params.apply(
                lambda tensor: (
                    nn.Parameter(tensor.detach().clone())
                    if tensor.requires_grad
                    else tensor.clone()
                ),
                filter_empty=False,
            )
            self.qvalue_network_params = TensorDictParams(own, no_convert=True)
        if inverse_dynamics_network is not None:
            self._hold_inverse_dynamics(inverse_dynamics_network)
        self._make_vmap()

    def _hold_action_bounds(
        self,
        network: TensorDictModuleBase,
        inverse_dynamics_network: TensorDictModuleBase | None = None,
        action_spec: TensorSpec | None = None,
    ) -> None:
        """Hold a tanh-Gaussian actor's bounds, the model's and the environment's."""
        low, high = bounds = action_bounds(network, "actor_network")
        if action_spec is not None:
            check_action_spec(bounds, action_spec)
        self.register_buffer("action_low", low, persistent=False)
        self.register_buffer("action_high", high, persistent=False)
        if inverse_dynamics_network is not None:
            model_bounds = action_bounds(
                inverse_dynamics_network, "inverse_dynamics_network"
            )
            check_same_bounds(bounds, model_bounds)

    def _hold_inverse_dynamics(
        self, network: ProbabilisticTensorDictSequential
    ) -> None:
        """Hold a trained model, and tell it from one that is not."""
        self._initial_digest = initial_digest(network)
        self._hold_frozen("inverse_dynamics_network", network)

    def _hold_frozen(self, name: str, network: nn.Module) -> None:
        """Hold a trained network frozen: in the state dict, moved by ``.to()``.

        Its parameters become buffers, so that no optimizer that takes
        ``loss.parameters()`` can move them; they share the network's memory.
        """
        self.convert_to_functional(network, name)
        frozen = getattr(self, f"{name}_params").apply(
            lambda tensor: tensor.data, filter_empty=False
        )
        setattr(self, f"{name}_params", TensorDictParams(frozen, no_convert=True))

    def _check_model_is_trained(self) -> None:
        """Warn, at the first call, of a model with the weights it was built with.

        Not at construction: the weights may be loaded or trained until then. Networks
        that this package did not build are not looked at.
        """
        if self._initial_digest is None or torch.compiler.is_compiling():
            return
        digest = digest_of_weights(self.inverse_dynamics_network_params)
        if digest == self._initial_digest:
            warnings.warn(
                f"{type(self).__name__} uses an inverse dynamics model that was never "
                "trained: its weights are those that it was built with. Train it with "
                "InverseDynamicsLoss, or load its weights, before the policy.",
                stacklevel=_first_frame_outside(),
            )
        self._initial_digest = None

    def load_network(self, name: str, network: nn.Module) -> None:
        """Take the weights of a trained network for one that is held frozen.

        Args:
            name: of the argument that the network was, ``"dynamics_network"`` for
                instance.
            network: of the same sizes.

        Raises:
            ValueError: it has other sizes.
        """
        held, given = getattr(self, f"{name}_params"), TensorDict.from_module(network)
        shapes = [
            {key: value.shape for key, value in each.items(True, True)}
            for each in (held, given)
        ]
        if shapes[0] != shapes[1]:
            raise ValueError(
                f"the {name.replace('_', ' ')} has other sizes than this run's: give "
                "the settings (dynamics.num_networks, dynamics.num_elites and "
                "dynamics.num_cells) that it was trained with."
            )
        with torch.no_grad():
            for key, value in held.items(True, True):
                value.copy_(given[key])

    def _hold_temperature(
        self,
        alpha_init: float,
        fixed_alpha: bool,
        target_entropy: float | Literal["auto"],
        min_alpha: float | None = None,
        max_alpha: float | None = None,
    ) -> None:
        """Hold the logarithm of the entropy temperature, ``log_alpha``."""
        check_positive("alpha_init", alpha_init)
        bounds = {"min_alpha": min_alpha, "max_alpha": max_alpha}
        given = {name: bound for name, bound in bounds.items() if bound is not None}
        for name, bound in given.items():
            check_positive(name, bound)
        if len(given) == 2:
            check_positive("max_alpha", given["max_alpha"], minimum=min_alpha)
        self._log_alpha_bounds = {
            name.removesuffix("_alpha"): math.log(bound)
            for name, bound in given.items()
        }
        self.target_entropy = target_entropy
        log_alpha = torch.tensor(math.log(alpha_init))
        if fixed_alpha:
            self.register_buffer("log_alpha", log_alpha)
        else:
            self.log_alpha = nn.Parameter(log_alpha)

    @property
    def _alpha(self) -> Tensor:
        """The entropy temperature, brought back within its bounds, detached."""
        if self._log_alpha_bounds:
            # The parameter itself: beyond a bound it would take long to come back.
            self.log_alpha.data.clamp_(**self._log_alpha_bounds)
        return self.log_alpha.detach().exp()

    def _make_vmap(self) -> None:
        if "qvalue_network" in self.__dict__:
            self._vmap_qvalue = _vmap_func(
                self.qvalue_network,
                (None, 0),
                randomness=self.vmap_randomness,
                pseudo_vmap=self.deactivate_vmap,
            )

    def reset_parameters_recursive(self) -> None:
        """Reset actor, critics and inverse dynamics model, unless they are frozen."""
        for name in ("actor_network", "qvalue_network", "inverse_dynamics_network"):
            if name not in self.__dict__:
                continue
            if any(True for _ in getattr(self, f"{name}_params").parameters()):
                self._reset_module_parameters(name, getattr(self, name))

    def make_value_estimator(
        self, value_type: ValueEstimators | str | None = None, **hyperparams: Any
    ) -> Self:
        """Choose the TD target: TD(0) with ``gamma=0.99`` unless told otherwise."""
        value_type, kwargs = self._prepare_value_estimator_kwargs(
            value_type, **hyperparams
        )
        if value_type is not None:
            names = ("value", "reward", "done", "terminated")
            dispatch_value_estimator(
                self,
                value_type,
                supported=(
                    ValueEstimators.TD0,
                    ValueEstimators.TD1,
                    ValueEstimators.TDLambda,
                ),
                tensor_keys={name: getattr(self.tensor_keys, name) for name in names},
                value_network=None,
                deactivate_vmap=self.deactivate_vmap,
                **kwargs,
            )
        return self

    # -- keys -------------------------------------------------------------------

    @abstractmethod
    def _input_keys(self) -> list[NestedKey]:
        """The entries that the loss reads; repetitions are dropped."""

    @abstractmethod
    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        """The losses and the metrics that it writes, in their order."""

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

    # -- the call -------------------------------------------------------------------

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses and metrics of a batch, see :attr:`out_keys`.

        A loss with critics writes the largest absolute TD error of them under the
        ``priority`` key, ``[B]``; nothing else is written into ``tensordict``.

        Args:
            tensordict: a batch ``[B]`` with the entries of :attr:`in_keys`.

        Raises:
            ValueError: if the batch is empty.
        """
        # Not tensordict.numel(), which is at least 1.
        if not tensordict.batch_size.numel():
            raise ValueError(
                f"The batch is empty (batch_size {tuple(tensordict.batch_size)}): the "
                f"mean of {type(self).__name__} needs at least one transition."
            )
        return self._output(tensordict, *self._terms(tensordict))

    @abstractmethod
    def _terms(self, tensordict: TensorDictBase) -> Terms:
        """The losses and the metrics of a batch that has rows."""

    def _weights(self, tensordict: TensorDictBase) -> Tensor | None:
        """The rows' importance weights ``[B]``, if they are there and to be used."""
        if self.use_prioritized_weights is False:
            return None
        # Not TorchRL's _maybe_get_priority_weight, which fails with a nested key.
        key = self.tensor_keys.priority_weight
        weights: Tensor | None = tensordict.get(key, None)
        if weights is None or weights.shape == tensordict.batch_size:
            return weights
        if weights.shape == (*tensordict.batch_size, 1):
            return weights.squeeze(-1)
        raise ValueError(
            f"{key!r} has shape {tuple(weights.shape)}, expected one weight a row: "
            f"{tuple(tensordict.batch_size)}."
        )

    def _rows_weigh_alike(self, tensordict: TensorDictBase) -> bool:
        """Whether a reduced loss has the same derivative by every row's term."""
        masked = any(key in tensordict for key in self._loss_mask_keys())
        weighted = self._weights(tensordict) is not None
        return self.reduction != "none" and not (masked or weighted)

    def _reduce(
        self, value: Tensor, tensordict: TensorDictBase, valid: Tensor | None = None
    ) -> Tensor:
        """``value`` reduced as asked, with the batch's masks and weights.

        Args:
            value: one number a row, ``[B]``.
            tensordict: the batch.
            valid: rows that count, bool ``[B]``; the others are 0 under ``"none"``.
                Default: all. A mean over no row, or over weights of 0, is 0.
        """
        weights = self._weights(tensordict)
        if valid is not None:
            # Selected, not multiplied: 0 * nan is nan in the backward pass, too.
            value = torch.where(valid, value, torch.zeros_like(value))
        if weights is None or self.reduction != "mean":
            # A mask handed over under "none" would compact the result.
            mask = None if self.reduction == "none" else valid
            if mask is not None and self.reduction == "sum":
                mask = None
            reduced: Tensor = self._reduce_loss(
                value, tensordict, mask=mask, weights=weights
            )
            return reduced
        # Not TorchRL 0.14.1's weighted mean, which is 0 / 0 where no weight counts.
        weights = weights.to(value.dtype)
        if valid is not None:
            weights = weights * valid
        total: Tensor = self._reduce_loss(value * weights, tensordict, reduction="sum")
        weight: Tensor = self._reduce_loss(weights, tensordict, reduction="sum")
        return total / torch.where(weight == 0, torch.ones_like(weight), weight)

    def _mean(
        self, value: Tensor, tensordict: TensorDictBase, valid: Tensor | None = None
    ) -> Tensor:
        """The mean of a metric ``[..., B]`` over the rows that the masks leave."""
        value = value.detach().reshape(-1, *tensordict.batch_size).mean(0)
        if valid is not None:
            value = torch.where(valid, value, torch.zeros_like(value))
        mean: Tensor = self._reduce_loss(
            value, tensordict, mask=valid, reduction="mean"
        )
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

    def _next_keys(self, *names: str) -> list[NestedKey]:
        """Entries below ``"next"``: ``_next_keys("reward", "done")``."""
        return [nested("next", getattr(self.tensor_keys, name)) for name in names]


def _first_frame_outside() -> int:
    """The ``stacklevel`` at which a warning names the line that called this package."""
    here = Path(__file__).parents[1]
    frame, level = inspect.currentframe(), 0
    while frame is not None and (
        here in Path(frame.f_code.co_filename).parents
        or frame.f_globals.get("__name__", "").startswith(
            ("torch.", "torchrl.", "tensordict.")
        )
    ):
        frame, level = frame.f_back, level + 1
    return level
