"""Losses and gradients as a recorded list of tensor operations.

An update of small networks is some hundreds of short operations, and around each of
them Python, TorchRL and autograd take longer than the operation itself. Which
operations there are does not change from one batch to the next. So they are recorded
once, by :func:`torch.fx.experimental.proxy_tensor.make_fx`, forward and backward, and
repeated with the next batches: the same operations on the same numbers in the same
order, hence the same bits, without a compiler. TorchScript's interpreter repeats them,
where it can: without Python in between they take two thirds of the time.
"""

from __future__ import annotations

import logging
import operator
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.fx import GraphModule, Node, map_arg
from torch.fx.experimental.proxy_tensor import make_fx
from torchrl.objectives import LossModule

log = logging.getLogger(__name__)

Run = Callable[..., Sequence[Tensor]]


class LossGradients:
    """Losses of a batch; the gradients of their sum go where an optimizer looks.

    Args:
        loss_module: whose entries ``loss_*`` are summed.
        autocast_dtype: of the matrix products. Default: that of the parameters.
        parameters: that are given a gradient; losses and metrics stay the same.
            Default: all of the loss module.
        record: repeat a recording, on a CPU. Python code in the losses is not run again
            then: hooks, counters or prints in them stay silent. A loss that decides by
            numbers cannot be recorded and runs as it is.
        warm_up: batches before the recording, which takes as long as some hundreds of
            updates save: short runs do without. Default 100.
    """

    def __init__(
        self,
        loss_module: LossModule,
        autocast_dtype: torch.dtype | None = None,
        *,
        parameters: Sequence[nn.Parameter] | None = None,
        record: bool = False,
        warm_up: int = 100,
    ) -> None:
        self.loss_module, self.autocast_dtype = loss_module, autocast_dtype
        self.parameters = parameters
        self.device = next(loss_module.parameters()).device
        self.record = record and self.device.type == "cpu"
        self._countdown = warm_up
        self._recording: _Recording | None = None

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Detached losses and metrics of a batch; adds to the parameters' ``grad``."""
        if self._recording is not None and self._recording.fits(batch):
            return self._recording(batch)
        if self.record and self._recording is None:
            self._countdown -= 1
            if self._countdown < 0:
                self.record = self._try_to_record(batch)
        losses = self._losses(batch)
        _total(losses).backward(inputs=self.parameters)
        return losses.detach()

    def _losses(self, batch: TensorDictBase) -> TensorDictBase:
        enabled = self.autocast_dtype is not None
        with torch.autocast(self.device.type, self.autocast_dtype, enabled=enabled):
            losses: TensorDictBase = self.loss_module(batch)
        return losses

    def _try_to_record(self, batch: TensorDictBase) -> bool:
        generator = torch.get_rng_state()
        try:
            self._losses(batch.copy())  # a loss may look at its first batch
            torch.set_rng_state(generator)
            self._recording = _Recording(
                self._losses, self.loss_module, batch, self.parameters
            )
        except Exception as error:  # whatever a loss does that cannot be recorded
            log.warning(
                f"{type(self.loss_module).__name__} runs without a recording, slower: "
                f"{type(error).__name__}: {str(error).splitlines()[0]}"
            )
        finally:
            torch.set_rng_state(generator)
        return self._recording is not None


def _total(losses: TensorDictBase) -> Any:
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


class _Recording:
    """The operations of one update.

    Args:
        losses: of a batch, with their graph.
        loss_module: its parameters, buffers and options are part of the recording.
        batch: of the kind that is to come; a loss may write into it.
        parameters: that are given a gradient; ``None`` for all.
    """

    def __init__(
        self,
        losses: Any,
        loss_module: LossModule,
        batch: TensorDictBase,
        parameters: Sequence[nn.Parameter] | None,
    ) -> None:
        self.loss_module = loss_module
        given = loss_module.parameters() if parameters is None else parameters
        self.parameters = [each for each in given if each.requires_grad]
        self.keys: list[NestedKey] = list(batch.keys(True, True))
        self.names: list[str] = []
        self.written: list[NestedKey] = []
        self.kind, self.options = self._kind(batch), _options(loss_module)
        self.trained: list[nn.Parameter] = []

        def update(*tensors: Tensor) -> list[Tensor]:
            inputs = dict(zip(self.keys, tensors, strict=True))
            own = TensorDict({}, batch.batch_size, device=batch.device)
            for key, value in inputs.items():
                own.set(key, value)
            result = losses(own)
            found = torch.autograd.grad(
                _total(result), self.parameters, allow_unused=True
            )
            pairs = zip(self.parameters, found, strict=True)
            given = [(each, value) for each, value in pairs if value is not None]
            self.trained = [each for each, _ in given]
            self.names = list(result.keys())
            self.written = [
                key for key, value in own.items(True, True)
                if inputs.get(key) is not value
            ]  # fmt: skip
            return [
                *(value.detach() for value in result.values()),
                *(own.get(key) for key in self.written),
                *(_laid_out(value, like=each) for each, value in given),
            ]

        tensors = self._tensors(batch)
        self.run = _without_python(_simplified(make_fx(update)(*tensors)), tensors)

    def fits(self, batch: TensorDictBase) -> bool:
        """Whether batch and options are of the kind that was recorded."""
        return (
            self._kind(batch) == self.kind
            and _options(self.loss_module) == self.options
        )

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        outputs = iter(self.run(*self._tensors(batch)))
        losses = TensorDict({name: next(outputs) for name in self.names}, [])
        for key in self.written:
            batch.set(key, next(outputs))
        for parameter, gradient in zip(self.trained, outputs, strict=True):
            grad = parameter.grad
            parameter.grad = gradient if grad is None else grad + gradient
        return losses

    def _tensors(self, batch: TensorDictBase) -> list[Tensor]:
        return [batch.get(key) for key in self.keys]

    def _kind(self, batch: TensorDictBase) -> Any:
        entries = {
            key: (value.shape, value.dtype, value.requires_grad)
            for key, value in batch.items(True, True)
            if key in self.keys or key not in self.written
        }
        return batch.batch_size, entries


def _laid_out(gradient: Tensor, like: Tensor) -> Tensor:
    """The gradient with the strides of its parameter, as ``backward`` leaves it.

    Fused optimizers go through both by address and do not look at strides (torch 2.13).
    """
    if gradient.stride() == like.stride():
        return gradient
    return torch.empty_like(like).copy_(gradient)


def _options(loss_module: LossModule) -> list[dict[str, Any]]:
    """Numbers, words and flags of a loss and its parts: what Python may decide by."""
    plain = (bool, int, float, str, type(None))
    parts = [each for each in loss_module.children() if isinstance(each, LossModule)]
    return [
        {
            name: value for name, value in vars(each).items()
            if isinstance(value, plain) and not name.startswith("_")
        } for each in (loss_module, *parts)
    ]  # fmt: skip


_VIEWS = {
    operator.getitem,
    *(
        getattr(torch.ops.aten, name).default
        for name in ("t", "unsqueeze", "expand", "permute", "view")
    ),
    torch.ops.aten.transpose.int,
    torch.ops.aten.select.int,
    torch.ops.aten.unbind.int,
    torch.ops.aten.slice.Tensor,
    torch.ops.aten.squeeze.dim,
}


def _simplified(graph: GraphModule) -> GraphModule:
    """Leave out what has no effect without autograd, and what nobody reads.

    Views of the module's own tensors are made now, once: they show whatever an
    optimizer writes into these.
    """
    own: dict[Node, Any] = {}
    for node in list(graph.graph.nodes):
        if node.op == "get_attr":
            own[node] = getattr(graph, node.target)
        elif node.target is torch.ops.aten.detach.default:
            node.replace_all_uses_with(node.args[0])
        elif node.target in _VIEWS and set(node.all_input_nodes) <= own.keys():
            arguments = map_arg((node.args, node.kwargs), own.__getitem__)
            own[node] = value = node.target(*arguments[0], **arguments[1])
            if isinstance(value, Tensor):
                graph.register_buffer(f"{node.name}_made", value)
                with graph.graph.inserting_before(node):
                    made = graph.graph.get_attr(f"{node.name}_made")
                node.replace_all_uses_with(made)
                own[made] = value
    graph.graph.eliminate_dead_code()
    graph.recompile()
    return graph


_LAYER_NORM_GRADIENTS = """
def of_all(
    upstream: Tensor, x: Tensor, shape: List[int], mean: Tensor, rstd: Tensor,
    weight: Optional[Tensor], bias: Optional[Tensor]
) -> Tuple[Tensor, Tensor, Tensor]:
    return torch.ops.aten.native_layer_norm_backward(
        upstream, x, shape, mean, rstd, weight, bias, [True, True, True]
    )

def of_input(
    upstream: Tensor, x: Tensor, shape: List[int], mean: Tensor, rstd: Tensor,
    weight: Optional[Tensor], bias: Optional[Tensor]
) -> Tuple[Tensor]:
    return torch.ops.aten.native_layer_norm_backward(
        upstream, x, shape, mean, rstd, weight, bias, [True, False, False]
    )[:1]
"""
"""Layer normalisation's gradients: the tracer knows neither the list of flags that
PyTorch's operation takes, nor the gaps in what it gives back."""


@cache
def _layer_norm_gradients() -> torch.jit.CompilationUnit:
    # Never freed: a trace points at the functions that it calls and does not own them.
    return torch.jit.CompilationUnit(_LAYER_NORM_GRADIENTS)


def _without_python(graph: GraphModule, tensors: list[Tensor]) -> Run:
    """The graph as TorchScript, or as it is where that cannot be had.

    TorchScript is deprecated in PyTorch 2.13, in which nothing else repeats operations
    from C++ without a compiler.
    """
    try:
        gradients = _layer_norm_gradients()

        def of_all(*arguments: Any) -> Any:
            return gradients.of_all(*arguments)

        def of_input(*arguments: Any) -> Any:
            return gradients.of_input(*arguments)

        for node in graph.graph.nodes:
            if node.target is torch.ops.aten.native_layer_norm_backward.default:
                node.target = of_all if all(node.args[-1]) else of_input
                node.args = node.args[:-1]
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # of deprecation, and of fixed shapes
            graph.recompile()
            run: Run = torch.jit.trace(  # type: ignore[no-untyped-call]
                graph, tuple(tensors), check_trace=False
            )
        return run
    except Exception as error:
        log.info(f"updates are repeated from Python, which is slower: {error}")
        return graph
