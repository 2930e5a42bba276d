r"""The noise of equation (5): :math:`\hat s = s + \beta\,\epsilon`."""

from __future__ import annotations

import copy
import hashlib
import itertools
import multiprocessing
import os
from collections.abc import Sequence
from typing import Any, Self

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from torchrl_osr._checks import check_weight
from torchrl_osr._entries import entry, nested

_number = itertools.count()
_process = [os.getpid()]  # torch.compile cannot trace the call
if hasattr(os, "register_at_fork"):  # Windows has no forks
    os.register_at_fork(after_in_child=lambda: _process.__setitem__(0, os.getpid()))


class StatePerturbation(Transform):
    r"""Add a perturbed state to every row: ``("perturbed", key)`` from ``key``.

    Appended to a replay buffer it makes the mixed data set D_tot of section 4.1: one
    freshly perturbed state for each clean one, the next state untouched. It leaves
    the states as they are, keeps the batch size and has its own random generator, which
    leaves the other draws of a run unchanged. In an environment it adds the same entry
    to observations and specs.

    Append it after transforms that rescale the state (``ObservationNorm``).

    Each transform draws its own noise, also without a ``seed``, as a copy, or in a
    worker process of a ``DataLoader``. ``load_state_dict`` continues the noise of the
    saved transform.

    Args:
        std: :math:`\beta`, the standard deviation of the Gaussian noise, in units of
            the observation: a number, or one for each entry of the observation.

    Keyword Args:
        in_keys: the states to perturb. Default ``["observation"]``. Integers become
            floats here alone: convert images before (``ToTensorImage``).
        perturbed: where to write the perturbed states. Default ``"perturbed"``.
        seed: of the generator. Default: derived from torch's initial seed, the process
            and the number of transforms before this one.

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
        std: float | Sequence[float] | Tensor,
        *,
        in_keys: Sequence[NestedKey] = ("observation",),
        perturbed: NestedKey = "perturbed",
        seed: int | None = None,
    ) -> None:
        numbers = torch.as_tensor(std, dtype=torch.float64, device="cpu")
        for each in numbers.flatten().tolist():
            check_weight("std", each)
        keys = [in_keys] if isinstance(in_keys, str) else list(in_keys)
        perturbed_keys = [nested(perturbed, key) for key in keys]
        super().__init__(in_keys=keys, out_keys=perturbed_keys)
        self.register_buffer("std", numbers.to(torch.get_default_dtype(), copy=True))
        self.seed = _derived("new", next(_number)) if seed is None else seed
        self._copies, self._process = 0, _process[0]
        self._generator: torch.Generator | None = None
        self._loaded: Tensor | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state of a copy: a seed of its own, and no draws."""
        self._copies += 1
        state: dict[str, Any] = super().__getstate__()
        own = {"seed": _derived("copy", self.seed, self._copies), "_copies": 0}
        # TorchRL copies transforms to find a parent: the environment is left out.
        none = dict.fromkeys(("_generator", "_loaded", "_container", "_parent"))
        return state | own | none

    def clone(self) -> Self:
        """Return a copy, for another environment."""
        return copy.deepcopy(self)

    def _generator_on(self, device: torch.device) -> torch.Generator:
        """Return the noise's generator, made on the device of the first batch."""
        if self._process != _process[0]:  # inherited by another process
            self.seed, self._process = _derived("process", self.seed), _process[0]
            self._generator = self._loaded = None
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

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add the perturbed states to a batch of any shape."""
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            state = entry(tensordict, key)
            state = state.to(_floating(state.dtype))
            if self.std.device != state.device:
                self.to(state.device)  # once: a copy at each draw keeps a GPU waiting
            generator = self._generator_on(state.device)
            noise = state.new_empty(state.shape).normal_(generator=generator)
            tensordict.set(out_key, torch.addcmul(state, noise, self.std.to(state)))
        return tensordict

    _call = forward

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the perturbed entries: unbounded, of the states' shape."""
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            spec = observation_spec[key]
            observation_spec[out_key] = Unbounded(
                shape=spec.shape, dtype=_floating(spec.dtype), device=spec.device
            )
        return observation_spec

    def get_extra_state(self) -> Tensor:
        """Return the generator's state, for the state dict."""
        if self._generator is None and self._loaded is not None:
            return self._loaded
        own = torch.Generator(self.std.device).manual_seed(self.seed)
        return (self._generator or own).get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Continue the noise from a saved state; another device starts it again."""
        self._loaded, self._process = state.cpu(), _process[0]
        if self._generator is not None:
            self._continue(self._generator)


def _floating(dtype: torch.dtype) -> torch.dtype:
    return dtype if dtype.is_floating_point else torch.get_default_dtype()


def _derived(*parts: str | int) -> int:
    """Return the seed of a stream that belongs to these parts, in this process."""
    here = torch.initial_seed(), multiprocessing.current_process().name
    digest = hashlib.sha256(repr((*parts, *here)).encode()).digest()
    return int.from_bytes(digest[:7], "big")
