r"""The noise of equation (5): :math:`\hat s = s + \beta\,\epsilon`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from torchrl_osr._checks import check_choice, check_weight
from torchrl_osr._entries import nested


class StatePerturbation(Transform):
    r"""Add a perturbed state to every row: ``("perturbed", key)`` from ``key``.

    Appended to a replay buffer it makes the mixed data set D_tot of section 4.1: one
    freshly perturbed state for each clean one, the next state untouched. It works out
    of place, needs no train mode, leaves the batch size alone and draws from a
    generator of its own, so that the rest of a run stays the same bits with and without
    it. In an environment it adds the same entry to observations and specs.

    Args:
        std: :math:`\beta`, the noise's standard deviation per dimension, in units of
            the observation.

    Keyword Args:
        in_keys: the states to perturb. Default ``["observation"]``.
        noise: ``"gaussian"`` (default), or ``"uniform"`` with the same standard
            deviation (half-width :math:`\sqrt 3\,\beta`).
        perturbed: where to write the perturbed states. Default ``"perturbed"``.
        seed: of the generator. Default: torch's initial seed.

    Raises:
        ValueError: if ``std`` is negative or infinite, or ``noise`` unknown.
        KeyError: in the call, if a state is missing.
        TypeError: in the call, if a state is not floating point.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from torchrl_osr import StatePerturbation
        >>> buffer = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(100), batch_size=16,
        ...     transform=StatePerturbation(std=1e-3))
        >>> data = TensorDict({"observation": torch.randn(100, 11)}, [100])
        >>> indices = buffer.extend(data)
        >>> buffer.sample()["perturbed", "observation"].shape
        torch.Size([16, 11])
    """

    def __init__(
        self,
        std: float,
        *,
        in_keys: Sequence[NestedKey] = ("observation",),
        noise: Literal["gaussian", "uniform"] = "gaussian",
        perturbed: NestedKey = "perturbed",
        seed: int | None = None,
    ) -> None:
        check_weight("std", std)
        check_choice("noise", noise, ("gaussian", "uniform"))
        in_keys = [in_keys] if isinstance(in_keys, str) else list(in_keys)
        super().__init__(
            in_keys=in_keys, out_keys=[nested(perturbed, key) for key in in_keys]
        )
        self.register_buffer("std", torch.tensor(std, dtype=torch.float64))
        self.noise = noise
        self.seed = torch.initial_seed() if seed is None else seed
        self._generator: torch.Generator | None = None
        self._loaded: Tensor | None = None

    def _generator_on(self, device: torch.device) -> torch.Generator:
        """Return the noise's generator, made on the device of the first batch."""
        if self._generator is None or self._generator.device != device:
            self._generator = torch.Generator(device).manual_seed(self.seed)
            self._continue(self._generator)
        return self._generator

    def _continue(self, generator: torch.Generator) -> None:
        """Set the loaded state, unless it is that of a generator on another device."""
        loaded = self._loaded
        # A CUDA generator's state is 16 bytes, a CPU one's 5056: the size tells.
        if loaded is not None and loaded.numel() == generator.get_state().numel():
            generator.set_state(loaded)
            self._loaded = None

    def _perturb(self, state: Tensor, key: NestedKey) -> Tensor:
        if not state.is_floating_point():
            raise TypeError(
                f"{key!r} must be floating point to be perturbed, got {state.dtype}; "
                "append DoubleToFloat or ToTensorImage first."
            )
        generator = self._generator_on(state.device)
        if self.noise == "gaussian":
            noise = torch.randn(
                state.shape, generator=generator, dtype=state.dtype, device=state.device
            )
        else:
            noise = torch.rand(
                state.shape, generator=generator, dtype=state.dtype, device=state.device
            )
            noise = (2 * noise - 1) * 3**0.5
        return torch.addcmul(state, noise, self.std.to(state))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add the perturbed states to a batch of any shape."""
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            state = tensordict.get(key, None)
            if state is None:
                raise KeyError(
                    f"StatePerturbation reads {key!r}, but the batch has "
                    f"{sorted(map(str, tensordict.keys(True, True)))}."
                )
            if self.std.device != state.device:
                # Once: a copy from the host at each draw keeps a GPU waiting, and
                # cannot be captured in a CUDA graph.
                self.to(state.device)
            tensordict.set(out_key, self._perturb(state, key))
        return tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the perturbed entries: unbounded, of the states' shape and dtype."""
        if not isinstance(observation_spec, Composite):
            raise TypeError(
                f"StatePerturbation needs a Composite spec, got {observation_spec}."
            )
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            spec = observation_spec[key]
            observation_spec[out_key] = Unbounded(
                shape=spec.shape, dtype=spec.dtype, device=spec.device
            )
        return observation_spec

    def get_extra_state(self) -> Tensor:
        """Return the generator's state, for the state dict."""
        if self._generator is None and self._loaded is not None:
            return self._loaded
        generator = self._generator or torch.Generator().manual_seed(self.seed)
        return generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Continue the noise from a saved state; on another device it starts anew."""
        self._loaded = state.cpu()
        if self._generator is not None:
            # Into the generator that is there, which a CUDA graph may hold.
            self._continue(self._generator)
