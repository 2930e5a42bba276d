"""Randomness of a population's members: each its own, as in a process of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torchrl.checkpoint import GlobalRNGState

Draw = Callable[[torch.Generator], Tensor]


class _EachItsOwn(torch.autograd.Function):
    """A draw below :func:`torch.vmap`, made above it, with each member's generator."""

    @staticmethod
    def forward(member: Tensor, generators: Any, draw: Draw) -> Tensor:
        raise RuntimeError("Members' draws can only be made under torch.vmap.")

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Keep nothing: noise has no gradient."""

    @staticmethod
    def vmap(
        info: Any, in_dims: Any, member: Tensor, generators: Any, draw: Draw
    ) -> tuple[Tensor, int]:
        del info, in_dims, member
        return torch.stack([draw(generator) for generator in generators]), 0


class MemberNoise(TorchFunctionMode):
    """Takes what a loss draws under :func:`torch.vmap` from the members' generators.

    Each of them gives the numbers that torch's default generator would give, had it the
    same state: in the order of the draws, in their shapes and types. The random
    functions that are not here raise under ``vmap(..., randomness="error")``.

    Args:
        member: a batched tensor of that vmap: any; it marks the level.
        generators: one for each member.
    """

    def __init__(self, member: Tensor, generators: Sequence[torch.Generator]) -> None:
        super().__init__()
        self._member, self._generators = member, tuple(generators)

    def _each(self, draw: Draw) -> Tensor:
        noise: Tensor = _EachItsOwn.apply(  # type: ignore[no-untyped-call]
            self._member, self._generators, draw
        )
        return noise

    def _like(self, function: Any, like: Tensor, options: dict[str, Any]) -> Tensor:
        options = {"dtype": like.dtype, "device": like.device} | options
        shape = like.shape
        return self._each(lambda each: function(shape, generator=each, **options))

    def __torch_function__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        options = dict(kwargs or {})
        # Whoever brings a generator of his own draws the same for all members, which
        # no single run does: vmap objects.
        if options.get("generator") is not None:
            return function(*args, **options)
        options.pop("generator", None)
        if function in (torch.rand, torch.randn):
            return self._each(lambda each: function(*args, generator=each, **options))
        if function is torch.rand_like:
            return self._like(torch.rand, args[0], options)
        if function is torch.randn_like:
            return self._like(torch.randn, args[0], options)
        # What torch's Normal calls; in torch before 2.13 it is the second.
        if function is Tensor.normal_ and len(args) == 1 and not options:
            # In place it cannot be, for what is filled is not one per member.
            noise = self._like(torch.randn, args[0], {})
            args[0].fill_(torch.nan)  # whoever reads it, and not the result, sees it
            return noise
        if function is torch.normal and not options and isinstance(args[1], Tensor):
            return args[0] + args[1] * self._like(torch.randn, args[1], {})
        return function(*args, **options)


class OwnRandomness:
    """The process's global random generators, as a member's own process had them.

    Made with their present state.
    """

    def __init__(self) -> None:
        self._state = GlobalRNGState().state_dict()
        self._generators: dict[torch.device, torch.Generator] = {}

    def generator(self, device: torch.device) -> torch.Generator:
        """Return what stands in for torch's default generator of a device, from now on.

        Its state is always the default one's: what either draws, both have drawn.
        """
        if device not in self._generators:
            self._generators[device] = torch.Generator(device)
            self._generators[device].set_state(self._default(device))
        return self._generators[device]

    def _default(self, device: torch.device) -> torch.Tensor:
        """Return the state of torch's default generator of a device."""
        if device.type == "cpu":
            return torch.as_tensor(self._state["torch_cpu"])
        index = torch.cuda.current_device() if device.index is None else device.index
        return torch.as_tensor(self._state["torch_cuda"][index])

    @contextmanager
    def active(self) -> Iterator[None]:
        """Let the global generators be the member's."""
        outside = GlobalRNGState().state_dict()
        for device, generator in self._generators.items():
            self._default(device).copy_(generator.get_state())
        GlobalRNGState().load_state_dict(self._state)
        try:
            yield
        finally:
            self._state = GlobalRNGState().state_dict()
            for device, generator in self._generators.items():
                generator.set_state(self._default(device))
            GlobalRNGState().load_state_dict(outside)
