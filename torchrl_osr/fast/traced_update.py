"""Losses and gradients as a traced list of tensor operations.

An update of small networks has some hundreds of short operations. Python, TorchRL and
autograd take longer around each of them than the operation itself. Therefore they are
traced once, by :func:`torch.fx.experimental.proxy_tensor.make_fx`, forward and
backward, and repeated with the next batches. The same operations on the same numbers in
the same order give the same bits, without a compiler.

On a CPU, TorchScript's interpreter repeats them. PyTorch deprecates it, but offers
nothing else that repeats operations from C++ without a compiler. On a GPU, a CUDA graph
does.
"""

from __future__ import annotations

import enum
import gc
import logging
import types
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor, nn
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import make_fx
from torch.jit._fuser import optimized_execution
from torch.utils.hooks import RemovableHandle
from torchrl.data import TensorSpec
from torchrl.objectives import LossModule

log = logging.getLogger(__name__)

MAX_CHANGES = 20
"""Changes of a loss's attributes after which it is no longer traced."""

CHECK_INTERVAL = 1000
"""Updates between two comparisons of a trace with the loss itself."""


class LossGradients:
    """Compute the losses of a batch, and add the gradients of their sum to ``grad``.

    See :class:`~torchrl_osr.fast.FastUpdate` for the options. ``parameters`` get a
    gradient, by default all of the loss module. On a GPU, clear ``grad`` between calls.
    """

    def __init__(
        self,
        loss_module: LossModule,
        autocast_dtype: torch.dtype | None = None,
        *,
        parameters: Sequence[nn.Parameter] | None = None,
        trace: bool = True,
        warm_up: int = 100,
    ) -> None:
        self.loss_module, self.autocast_dtype = loss_module, autocast_dtype
        self.parameters, self.warm_up = parameters, max(warm_up, 1)
        self.device = next(loss_module.parameters()).device
        self.may_trace = trace and self.device.type in ("cpu", "cuda")
        self._countdown, self._changes, self._replays = self.warm_up, -1, 0
        self._state: _State | None = None
        self.trace: _Trace | None = None

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Return detached losses and metrics; add to the parameters' ``grad``."""
        if self.may_trace:
            self._look_for_changes()
            if self.trace is None:
                self._countdown -= 1
                if self._countdown < 0:
                    self._try_to_trace(batch)
            elif self.trace.fits(batch):
                return self._replay(self.trace, batch)
        losses = self._losses(batch)
        inputs = self.parameters and [p for p in self.parameters if p.requires_grad]
        _total(losses).backward(inputs=inputs)
        return losses.detach()

    def _losses(self, batch: TensorDictBase) -> TensorDictBase:
        enabled = self.autocast_dtype is not None
        with torch.autocast(self.device.type, self.autocast_dtype, enabled=enabled):
            return self.loss_module(batch)

    def _look_for_changes(self) -> None:
        """Forget the trace, and wait again, if the loss has changed."""
        if self._state is not None and self._state.holds():
            return
        self._state, self.trace = _State(self.loss_module), None
        self._countdown, self._changes = self.warm_up, self._changes + 1
        if self.loss_module._compiled_call_impl is not None:
            self.may_trace = False
        elif self._changes >= MAX_CHANGES:
            self._give_up("its attributes keep changing")

    def _try_to_trace(self, batch: TensorDictBase) -> None:
        assert self._state is not None
        generator, tensors = self._draws().get_state(), self._state.tensors
        before = [each.detach().clone() for each in tensors]
        try:
            trace = _Trace(self._losses, self.loss_module, batch, self.parameters)
            if all(map(torch.equal, tensors, before)) and self._state.holds():
                self.trace, self._replays = trace, 0
            else:
                self._give_up("it writes into its own tensors")
        except Exception as error:  # whatever a loss does that cannot be traced
            self._give_up(f"{type(error).__name__}: {error}".splitlines()[0])
            if self.device.type == "cuda":  # it would wait for the end of the capture
                fresh = torch.Generator(self.device).graphsafe_get_state()
                self._draws().graphsafe_set_state(fresh)
        finally:
            self._draws().set_state(generator)
            if self.trace is None:
                for tensor, value in zip(tensors, before, strict=True):
                    tensor.data.copy_(value)

    def _replay(self, trace: _Trace, batch: TensorDictBase) -> TensorDictBase:
        """Repeat the trace; at first and now and then, compare it with the loss."""
        draws = self._draws()
        start = None if self._replays % CHECK_INTERVAL else draws.get_state()
        self._replays += 1
        # Optimised, TorchScript joins matrix products, which rounds otherwise.
        with torch.no_grad(), optimized_execution(False):
            outputs = trace.run(*trace.tensors(batch))
        if start is not None:
            end = draws.get_state()
            draws.set_state(start)
            wanted = trace.update(*trace.tensors(batch))
            if not all(map(torch.equal, [*outputs, end], [*wanted, draws.get_state()])):
                outputs = wanted
                self._give_up("it reads numbers from outside of its attributes")
        return trace.spread(outputs, batch)

    def _draws(self) -> torch.Generator:
        """Return the generator that the loss draws from: torch's own of its device."""
        if self.device.type == "cpu":
            return torch.default_generator
        return torch.cuda.default_generators[self.device.index]

    def _give_up(self, why: str) -> None:
        self.may_trace, self.trace = False, None
        name = type(self.loss_module).__name__
        log.warning(f"{name} runs without a trace, slower: {why}")


def _total(losses: TensorDictBase) -> Any:
    return sum(value for key, value in losses.items() if key.startswith("loss"))


_OPAQUE = (
    *(type, types.FunctionType, types.MethodType, types.ModuleType),
    *(enum.Enum, TensorSpec),
)


class _State:
    """Attributes of a loss and its parts, and torch's modes: they decide what it does.

    Its parts are the modules and other objects that it refers to. Numbers in the
    tensors do not count, because a trace reads them each time.
    """

    def __init__(self, loss_module: LossModule) -> None:
        self.tensors: list[Tensor] = []
        self._attributes: list[tuple[dict[str, Any], Any]] = []
        seen: set[int] = set()
        stack: list[Any] = [loss_module]
        while stack:
            each = stack.pop()
            if id(each) in seen:
                continue
            seen.add(id(each))
            if isinstance(each, Tensor):
                self.tensors.append(each)
            elif isinstance(each, TensorDictBase):
                stack += each.values(True, True)
            elif isinstance(each, dict):
                stack += each.values()
            elif isinstance(each, (list, tuple, set)):
                stack += each
            elif hasattr(each, "__dict__") and not isinstance(each, _OPAQUE):
                stack += vars(each).values()
                self._attributes.append((vars(each), _copied(vars(each))))
        self._traits = self._traits_now()

    def holds(self) -> bool:
        try:
            return self._traits == self._traits_now() and all(
                now == before for now, before in self._attributes
            )
        except (RuntimeError, ValueError):  # for arrays == has no answer
            return False

    def _traits_now(self) -> list[Any]:
        modes = (
            torch.is_grad_enabled(),
            *map(torch.is_autocast_enabled, ("cpu", "cuda")),
            *map(torch.get_autocast_dtype, ("cpu", "cuda")),
            torch.get_default_dtype(),
            interaction_type(),
            RemovableHandle.next_id,  # rises with every hook
        )
        return [modes, [(each.data_ptr(), each.requires_grad) for each in self.tensors]]


def _copied(value: Any) -> Any:
    """Copy the containers in a value; keep everything else by reference."""
    if isinstance(value, dict):
        return {key: _copied(each) for key, each in value.items()}
    if type(value) in (list, tuple):
        return type(value)(map(_copied, value))
    return set(value) if isinstance(value, set) else value


class _Trace:
    """The operations of one update: arguments as of :class:`LossGradients`."""

    def __init__(
        self,
        losses: Callable[[TensorDictBase], TensorDictBase],
        loss_module: LossModule,
        batch: TensorDictBase,
        parameters: Sequence[nn.Parameter] | None,
    ) -> None:
        given = loss_module.parameters() if parameters is None else parameters
        self._losses = losses
        self._parameters = [each for each in given if each.requires_grad]
        self._keys: list[NestedKey] = list(batch.keys(True, True))
        self._written: list[NestedKey] = []
        self._kind = self._kind_of(batch)
        self._empty = TensorDict({}, batch.batch_size, device=batch.device)
        tensors = self.tensors(batch)
        if tensors[0].device.type == "cuda":
            self.run: Any = _CudaGraph(self.update, tensors)
        else:
            self.run = _without_python(make_fx(self.update)(*tensors), tensors)

    def update(self, *tensors: Tensor) -> list[Tensor]:
        """Return losses, entries written to the batch, and gradients."""
        inputs = dict(zip(self._keys, tensors, strict=True))
        batch = self._empty.copy().update(inputs)
        losses = self._losses(batch)
        found = torch.autograd.grad(_total(losses), self._parameters, allow_unused=True)
        pairs = zip(self._parameters, found, strict=True)
        given = [(each, value) for each, value in pairs if value is not None]
        self._trained, self._names = [each for each, _ in given], list(losses.keys())
        items = batch.items(True, True)
        self._written = [key for key, value in items if inputs.get(key) is not value]
        return [
            *(value.detach() for value in losses.values()),
            *(batch.get(key) for key in self._written),
            *(_laid_out(value, like=each) for each, value in given),
        ]

    @torch.no_grad()
    def spread(self, outputs: list[Tensor], batch: TensorDictBase) -> TensorDictBase:
        """Put written entries into the batch, add gradients, and return the losses."""
        number = len(self._names) + len(self._written)
        # A CUDA graph writes its outputs once more at the next update.
        copied = [each.clone() if each.is_cuda else each for each in outputs[:number]]
        remaining = iter([*copied, *outputs[number:]])
        losses = TensorDict({name: next(remaining) for name in self._names}, [])
        for key in self._written:
            batch.set(key, next(remaining))
        for parameter, gradient in zip(self._trained, remaining, strict=True):
            grad = parameter.grad
            parameter.grad = gradient if grad is None else grad + gradient
        return losses

    def fits(self, batch: TensorDictBase) -> bool:
        """Return whether a batch is of the kind that was traced."""
        return bool(self._kind_of(batch) == self._kind)

    def tensors(self, batch: TensorDictBase) -> list[Tensor]:
        """Return the entries of a batch in the order of the trace."""
        return [batch.get(key) for key in self._keys]

    def _kind_of(self, batch: TensorDictBase) -> Any:
        entries = {
            key: (value.shape, value.dtype, value.requires_grad)
            for key, value in batch.items(True, True)
            if key in self._keys or key not in self._written
        }
        return batch.batch_size, entries


class _CudaGraph:
    """The kernels of a function of tensors, launched together.

    The results are overwritten by the next call.
    """

    def __init__(self, function: Callable[..., Any], tensors: list[Tensor]) -> None:
        self._given = [each.clone() for each in tensors]
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):  # libraries allocate in their first call
            function(*self._given)
        torch.cuda.current_stream().wait_stream(stream)
        gc.collect()  # to free another graph during the capture would end it
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, stream=stream):
            self._found: list[Tensor] = function(*self._given)

    def __call__(self, *tensors: Tensor) -> list[Tensor]:
        torch._foreach_copy_(self._given, tensors)
        self._graph.replay()
        return self._found


def _laid_out(gradient: Tensor, like: Tensor) -> Tensor:
    """Give a gradient the strides of its parameter, as ``backward`` does.

    Fused optimizers go through both by address and do not look at strides (torch 2.13).
    """
    if gradient.stride() == like.stride():
        return gradient
    return torch.empty_like(like).copy_(gradient)


@cache
def _layer_norm_backward() -> torch.jit.CompilationUnit:
    # TorchScript's tracer does not know the list of flags that the operation takes.
    # Never freed: a trace points at the functions that it calls and does not own them.
    return torch.jit.CompilationUnit("""
def layer_norm_backward(
    upstream: Tensor, x: Tensor, shape: List[int], mean: Tensor, rstd: Tensor,
    weight: Optional[Tensor], bias: Optional[Tensor]
) -> Tuple[Tensor, Tensor, Tensor]:
    return torch.ops.aten.native_layer_norm_backward(
        upstream, x, shape, mean, rstd, weight, bias, [True, True, True]
    )
""")


def _without_python(graph: GraphModule, tensors: list[Tensor]) -> Any:
    """Return the graph as TorchScript."""
    unit = _layer_norm_backward()

    def layer_norm_backward(*arguments: Any) -> Any:
        return unit.layer_norm_backward(*arguments[:-1])

    for node in graph.graph.nodes:
        if node.target is torch.ops.aten.native_layer_norm_backward.default:
            node.target = layer_norm_backward
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # of deprecation, and of fixed shapes
        graph.recompile()
        return torch.jit.trace(graph, tuple(tensors), check_trace=False)  # type: ignore[no-untyped-call]
