"""A whole update as one CUDA graph: recorded once, then launched at a stroke.

On a GPU an update of small networks is some hundreds of short kernels, which Python
takes longer to launch than the GPU to compute. A graph has them launched together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule
from torch import Tensor, nn
from torchrl import torchrl_logger
from torchrl.objectives import HardUpdate, LossModule, TargetNetUpdater
from torchrl.trainers import Trainer

WARM_UP = 3
"""Updates before the capture: what happens only once (the optimizer's state, cuBLAS'
workspaces, compilation) must not become a part of the graph."""


def check_updater(updater: TargetNetUpdater | None) -> None:
    """Raise a ValueError if target networks are updated by a count on the host."""
    if isinstance(updater, HardUpdate):
        raise ValueError(
            "cudagraph=True repeats one and the same update, but HardUpdate counts "
            "updates on the host: use SoftUpdate, or cudagraph=False."
        )


def networks_of(loss_module: LossModule) -> Iterator[nn.Module]:
    """Yield all modules of a loss, and those of the networks that TorchRL hides."""
    for module in loss_module.modules():
        yield module
        for value in vars(module).values():
            if isinstance(value, nn.Module):
                yield from value.modules()


def generators_of(modules: Iterable[nn.Module]) -> list[torch.Generator]:
    """Return the generators that modules have as attributes."""
    values = (value for module in modules for value in vars(module).values())
    return [value for value in values if isinstance(value, torch.Generator)]


def make_capturable(
    loss_module: LossModule, optimizer: torch.optim.Optimizer, device: torch.device
) -> None:
    """Put on the device what would be counted on the host, or copied from it each time.

    These are the optimizer's counts of steps, also those that a run without a graph has
    left in a checkpoint, and the bounds of the networks' distributions: TorchRL 0.14.1
    makes a tensor of a number at every call.
    """
    for group in optimizer.param_groups:
        if "capturable" in group:
            group["capturable"] = True
        for parameter in group["params"]:
            state = optimizer.state.get(parameter, {})
            if "step" in state:
                count = torch.as_tensor(state["step"], dtype=torch.float32)
                state["step"] = count.to(device)
    for module in networks_of(loss_module):
        if not isinstance(module, ProbabilisticTensorDictModule):
            continue
        options = module.distribution_kwargs
        # Otherwise TensorDictParams, which move with their module.
        if isinstance(options, dict):
            module.distribution_kwargs = options | {
                name: torch.as_tensor(options[name], device=device)
                for name in ("low", "high")
                if options.get(name) is not None
            }


def restore(generator: torch.Generator, state: Tensor) -> None:
    """Set a CUDA generator's state after a capture that failed.

    The old one may still take itself to be captured; it is replaced as a whole.
    """
    fresh = torch.Generator(generator.device).set_state(state)
    generator.graphsafe_set_state(fresh)


class CapturedUpdate:
    """Runs an update, from the fourth call on by replaying a CUDA graph of it.

    Every call is one executed update. The first three run as they are, on the stream of
    the capture; the capture itself executes nothing. The losses are added up on the
    device, inside the graph, and are not read before :meth:`means` is asked for.

    A graph repeats kernels, not Python: what ``update`` decides on the host (by an
    option that is reassigned, a count, a learning rate that is a number) stays as it
    was at the capture. Every generator's state is right all the time: a replay advances
    it by as much as the draws in the graph.

    An update that cannot be captured, because something in it waits for a number, is
    announced with a warning, and the run goes on without a graph.

    Args:
        update: does one update, on the same tensors each time; returns its detached
            losses and metrics.
        generators: returns what ``update`` draws from besides torch's own generator;
            asked when it is captured, for some are made at their first draw.
        device: the CUDA device.
    """

    def __init__(
        self,
        update: Callable[[], TensorDictBase],
        generators: Callable[[], Iterable[torch.Generator]],
        device: torch.device,
    ) -> None:
        self._update, self._generators, self._device = update, generators, device
        self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        self._graph: torch.cuda.CUDAGraph | None = None
        self._totals: TensorDictBase | None = None
        self._calls = self._calls_read = 0

    def __call__(self) -> None:
        """Do one update."""
        if self._calls == WARM_UP:
            self._graph = self._capture()
        if self._graph is None:
            self._run()
        else:
            self._graph.replay()
        self._calls += 1

    def means(self) -> TensorDictBase:
        """Return the mean losses and metrics of the calls since the last time."""
        if self._totals is None:
            raise RuntimeError("There was no update yet.")
        means: TensorDictBase = self._totals / (self._calls - self._calls_read)
        self._totals.zero_()
        self._calls_read = self._calls
        return means

    def _step(self) -> None:
        """Update and add up the losses: what is captured."""
        losses = self._update()
        if self._totals is None:
            dtype = torch.get_default_dtype()
            self._totals = losses.apply(lambda x: torch.zeros_like(x, dtype=dtype))
        self._totals.add_(losses)

    def _run(self) -> None:
        """Do a step without a graph, on the stream of the capture."""
        current = torch.cuda.current_stream(self._device)
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream):
            self._step()
        current.wait_stream(self._stream)

    def _capture(self) -> torch.cuda.CUDAGraph | None:
        """Return the graph of a step; or warn, with everything as it was before."""
        graph = torch.cuda.CUDAGraph()
        generators = list(self._generators())
        default = torch.cuda.default_generators[self._device.index or 0]
        states = [(each, each.get_state()) for each in (default, *generators)]
        try:
            for generator in generators:
                graph.register_generator_state(generator)
            # The outer context leaves the stream; the inner one stays where it fails.
            side = torch.cuda.stream(self._stream)
            with side, torch.cuda.graph(graph, stream=self._stream):
                self._step()
            return graph
        except Exception as error:  # whatever it is, it is so only when captured
            for generator, state in states:
                restore(generator, state)
            torchrl_logger.warning(
                f"The update cannot be captured in a CUDA graph, and runs on without, "
                f"more slowly: {type(error).__name__}: {error}. Below is where: "
                "something in the loss, the optimizer or a hook reads a number back to "
                "the host, or copies one from it. Change that, or pass cudagraph=False "
                "to do without the graph and this warning.",
                exc_info=True,
            )
            return None


def capture(
    trainer: Trainer, generator: torch.Generator, transform: nn.Module
) -> CapturedUpdate:
    """Return a trainer's ``update``, to be captured.

    Args:
        trainer: its loss module and optimizer are made capturable.
        generator: that the batches are drawn with.
        transform: of the replay buffer.

    Raises:
        ValueError: if a hook would have to read numbers after each update.
    """
    if trainer._post_optim_log_ops:
        raise ValueError(
            "cudagraph=True leaves no room for post_optim_log hooks, which read "
            "numbers after each update: register them as post_optim_complete_log, or "
            "use cudagraph=False."
        )
    device = next(trainer.loss_module.parameters()).device
    make_capturable(trainer.loss_module, trainer.optimizer, device)

    def generators() -> list[torch.Generator]:
        modules = (*transform.modules(), *networks_of(trainer.loss_module))
        return [generator, *generators_of(modules)]

    return CapturedUpdate(trainer.update, generators, device)
