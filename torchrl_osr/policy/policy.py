"""A trained policy by itself: observations in, actions out, in the environment's units.

Shapes: ``B`` batch (any leading dimensions, or none), ``S`` observation, ``A`` action,
or the number of actions where they are discrete.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torchrl.modules import NormalParamExtractor

from torchrl_osr._checks import check_choice
from torchrl_osr.modules.actor import SCALE_MAPPING
from torchrl_osr.policy.graph import write_graph
from torchrl_osr.policy.mlp import build_mlp, check_size
from torchrl_osr.policy.tensor_file import write_tensors

DISTRIBUTIONS = ("TanhNormal", "TanhDelta", "OneHotCategorical")
"""What an actor may end in, by TorchRL's names."""

SUFFIX = ".safetensors"
"""How the name of a saved policy ends."""

PACKAGES = ("torchrl-osr", "torch", "torchrl", "tensordict")
MAX_CRITICS = 1000

# How far an action may be out of its bounds, as a share of half their distance: a
# caller's own arithmetic rounds.
ROUNDING = 1e-5

Array = TypeVar("Array", NDArray[Any], Tensor)


class Policy(nn.Module):
    """A trained policy and its critics, in the units of the environment.

    :func:`~torchrl_osr.load_policy` and
    :func:`~torchrl_osr.policy.policy_from_loss` make one. Standardisation of
    observations and scaling of actions are inside. As a module it maps observations
    ``[B, S]`` to deterministic actions and checks nothing:
    ``TensorDictModule(policy, ["observation"], ["action"])`` is a TorchRL policy.

    Args:
        record: JSON-compatible description of the networks, the bounds and the origin.
        tensors: the module's state, which must fit the record.

    Raises:
        ValueError: they do not fit, or a tensor is not finite.

    Attributes:
        record: the description; ``record["source"]`` has what is known of the run.
        low, high: bounds of the actions, ``[A]``; empty where actions are discrete.
    """

    loc: Tensor
    scale: Tensor
    low: Tensor
    high: Tensor
    _center: Tensor
    _half: Tensor
    actor: nn.Module

    def __init__(
        self, record: Mapping[str, Any], tensors: Mapping[str, Tensor]
    ) -> None:
        super().__init__()
        self.record = dict(record) | {"source": dict(record["source"])}
        self.distribution = record["distribution"]
        check_choice("distribution", self.distribution, DISTRIBUTIONS)
        self.discrete = self.distribution == "OneHotCategorical"
        self.observation_size = check_size(
            "observation_size", record["observation_size"]
        )
        self.action_size = check_size("action_size", record["action_size"])
        self._set_bounds(record["low"], record["high"])
        for name in ("loc", "scale"):
            empty = torch.empty(self.observation_size, device="meta")
            self.register_buffer(name, empty)
        parameters = (2 if self.distribution == "TanhNormal" else 1) * self.action_size
        self.actor = build_mlp(record["actor"], self.observation_size, parameters)
        self.extractor = NormalParamExtractor(SCALE_MAPPING)
        sizes = (self.observation_size + self.action_size, 1)
        if self.discrete:
            sizes = (self.observation_size, self.action_size)
        critics = record["critics"]
        number = check_size("number of critics", critics["number"], 0, MAX_CRITICS)
        self.critics = nn.ModuleList(build_mlp(critics, *sizes) for _ in range(number))
        self._fill(tensors)

    def _set_bounds(self, low: list[float], high: list[float]) -> None:
        size = 0 if self.discrete else self.action_size
        if not len(low) == len(high) == size:
            raise ValueError(f"low and high must have {size} entries each.")
        bounds = torch.tensor([low, high], dtype=torch.float32)
        half = (bounds[1] - bounds[0]) / 2
        if not ((half > 0) & half.isfinite()).all():
            raise ValueError(f"low={low} must be below high={high}, and both finite.")
        values = {"low": bounds[0], "high": bounds[1]}
        values |= {"_center": bounds.mean(0), "_half": half}
        for name, value in values.items():
            # Not in the state: they are in the record. A view could not be exported.
            self.register_buffer(name, value.clone(), persistent=False)

    def _fill(self, tensors: Mapping[str, Tensor]) -> None:
        """Give the networks their weights; until here they took no memory."""
        here = {name: tuple(each.shape) for name, each in self.state_dict().items()}
        there = {name: tuple(each.shape) for name, each in tensors.items()}
        for name in sorted(here.keys() | there.keys()):
            if here.get(name) != there.get(name):
                raise ValueError(
                    f"{name} has shape {there.get(name)}, expected {here.get(name)}."
                )
        for name, each in tensors.items():
            if each.dtype != torch.float32 or not each.isfinite().all():
                raise ValueError(f"{name} must be float32 and finite.")
        if not (tensors["scale"] > 0).all():
            raise ValueError("scale, of the observations, must be above 0.")
        self.load_state_dict(dict(tensors), assign=True)
        self.requires_grad_(False).eval()

    @torch.no_grad()
    def act(
        self, observation: Array, *, generator: torch.Generator | None = None
    ) -> Array:
        """Actions for observations, NumPy for NumPy and torch for torch.

        Args:
            observation: as the environment gives it, one ``[S]`` or many ``[B, S]``.

        Keyword Args:
            generator: draw from the policy's distribution with it. Default: the
                deterministic action, which is the only one of a TD3+BC policy.

        Returns:
            Actions as the environment takes them: float32, ``[A]`` or ``[B, A]``,
            within the bounds; of a discrete policy int64 indices, ``[]`` or ``[B]``.

        Raises:
            ValueError: the observation has another size, or entries that are NaN or
                infinite.
        """
        rows = self._numbers("observation", observation, self.observation_size)
        action = self(rows) if generator is None else self._sample(rows, generator)
        return _like(observation, action)

    @torch.no_grad()
    def value(self, observation: Array, action: Array | None = None) -> Array:
        """Smallest of the critics' values, for gates and alarms.

        It estimates the discounted sum of the rewards that the run was trained on:
        ``record["source"]`` has the discount, and scale and shift of the rewards. The
        minimum is what the losses' own targets take. Conservative losses keep values
        low on purpose: set thresholds by values of states that are known to be good.

        Args:
            observation: as for :meth:`act`.
            action: in the environment's units, as :meth:`act` returns it. Default: the
                policy's deterministic one.

        Returns:
            float32, ``[]`` or ``[B]``.

        Raises:
            ValueError: there are no critics, a size or an entry of the observation or
                of the action is wrong, or the action is out of its bounds.
        """
        self._check_critics()
        rows = self._numbers("observation", observation, self.observation_size)
        actions = self(rows) if action is None else self._actions(action, rows)
        return _like(observation, self.smallest_value(rows, actions))

    def save(self, path: Path | str) -> None:
        """Write everything to one file, ``policy.safetensors`` for instance.

        :func:`~torchrl_osr.load_policy` reads it. Weights and statistics are tensors;
        sizes, bounds, origin, versions and checksums are JSON in the file's metadata.

        Raises:
            ImportError: safetensors is not installed.
            OSError: the file cannot be written.
            ValueError: its name ends otherwise.
        """
        if Path(path).suffix != SUFFIX:
            raise ValueError(f"the path must end in {SUFFIX}, got {path}.")
        write_tensors(Path(path), self.state_dict(), self._stamped())

    def export(
        self, path: Path | str, output: Literal["action", "value"] = "action"
    ) -> None:
        """Write a graph that needs none of this package, for batches of any size.

        It maps ``observation`` ``[B, S]`` to the deterministic ``action`` ``[B, A]``,
        or ``observation`` and ``action`` to ``value`` ``[B]``, all float32. Discrete
        actions are int64, ``[B]``. A graph checks nothing: NaN in is NaN out.

        Args:
            path: ends in ``.onnx`` for ONNX, or in ``.pt2`` for :mod:`torch.export`.
            output: what it computes, as :meth:`act` or as :meth:`value`.

        Raises:
            ImportError: for ONNX, if onnx or onnxscript is not installed.
            OSError: the file cannot be written.
            ValueError: an argument is none of those, or there are no critics.
        """
        check_choice("output", output, ("action", "value"))
        inputs = {"observation": self.loc.repeat(2, 1)}
        part = copy.deepcopy(self)  # a graph keeps all weights, needed or not
        graph: nn.Module = part
        if output == "action":
            part.critics = nn.ModuleList()
        else:
            self._check_critics()
            inputs["action"] = self(inputs["observation"])
            part.actor, graph = nn.Identity(), _Value(part)
        write_graph(Path(path), graph, inputs, output, self._stamped())

    def forward(self, observation: Tensor) -> Tensor:
        """Deterministic actions, see :meth:`act`; nothing is checked."""
        return self._in_units(self.mode(self.actor(self._standardized(observation))))

    def smallest_value(self, observation: Tensor, action: Tensor) -> Tensor:
        """Smallest of the critics' values, see :meth:`value`; nothing is checked."""
        state = self._standardized(observation)
        if self.discrete:
            index = action.unsqueeze(-1)
            values = [critic(state).gather(-1, index) for critic in self.critics]
        else:
            unit = (action - self._center) / self._half
            values = [critic(state, unit) for critic in self.critics]
        return torch.stack(values).amin(0).squeeze(-1)

    def _sample(self, observation: Tensor, generator: torch.Generator) -> Tensor:
        raw: Tensor = self.actor(self._standardized(observation))
        if self.distribution == "TanhDelta":
            return self._in_units(self.mode(raw))
        if self.discrete:
            # The largest of logits with Gumbel noise has their softmax's distribution.
            noise = torch.empty(raw.shape, device=generator.device)
            noise.exponential_(generator=generator)
            return (raw - noise.log().to(raw.device)).argmax(-1)
        loc, scale = self.extractor(raw)
        noise = torch.empty(loc.shape, device=generator.device)
        noise.normal_(generator=generator)
        return self._in_units((loc + scale * noise.to(raw.device)).tanh())

    def _standardized(self, observation: Tensor) -> Tensor:
        # Gymnasium's MuJoCo tasks have float64.
        return (observation.to(self.loc.dtype) - self.loc) / self.scale

    def mode(self, raw: Tensor) -> Tensor:
        """Deterministic action: an index, or within the network's bounds -1 and 1."""
        if self.discrete:
            return raw.argmax(-1)
        loc = raw.chunk(2, -1)[0] if self.distribution == "TanhNormal" else raw
        return loc.tanh()

    def _in_units(self, action: Tensor) -> Tensor:
        if self.discrete:
            return action
        # Rounding may lead out of the bounds by one bit.
        return (action * self._half + self._center).clamp(self.low, self.high)

    def _numbers(self, name: str, value: Any, size: int) -> Tensor:
        """The value as finite float32 rows on the policy's device."""
        rows = _tensor(value).to(self.loc.device, torch.float32)
        if not rows.ndim or rows.shape[-1] != size:
            raise ValueError(
                f"the {name} has shape {tuple(rows.shape)}, expected ({size},) or "
                f"(batch, {size})."
            )
        if not rows.isfinite().all():
            raise ValueError(f"the {name} has entries that are NaN or infinite.")
        return rows

    def _actions(self, value: Any, observation: Tensor) -> Tensor:
        """The value as actions that were taken in these observations."""
        batch = tuple(observation.shape[:-1])
        low: Any
        high: Any
        if self.discrete:
            action = _tensor(value).to(self.loc.device)
            if action.is_floating_point() or action.dtype == torch.bool:
                raise ValueError(f"the action is {action.dtype}, expected integers.")
            expected, low, high = batch, 0, self.action_size - 1
            outside = (action < low) | (action > high)
        else:
            action = self._numbers("action", value, self.action_size)
            expected = (*batch, self.action_size)
            low, high = self.low.tolist(), self.high.tolist()
            margin = ROUNDING * self._half
            outside = (action < self.low - margin) | (action > self.high + margin)
        if action.shape != expected:
            raise ValueError(
                f"the action has shape {tuple(action.shape)}, expected {expected} for "
                f"an observation of shape {tuple(observation.shape)}."
            )
        if outside.any():
            raise ValueError(f"the action is out of its bounds {low} and {high}.")
        return action.long() if self.discrete else action

    def _check_critics(self) -> None:
        if not self.critics:
            raise ValueError("this policy has no critics: the loss had none.")

    def _stamped(self) -> dict[str, Any]:
        """The record, with the versions that write it."""
        versions = {name.replace("-", "_"): version(name) for name in PACKAGES}
        return self.record | {"versions": versions}


class _Value(nn.Module):
    """Calls a policy's critics: a graph has one ``forward``."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.policy.smallest_value(observation, action)


def _tensor(value: Any) -> Tensor:
    # A copy: torch warns of arrays that are read-only.
    return value if isinstance(value, Tensor) else torch.from_numpy(np.array(value))


def _like(given: Array, result: Tensor) -> Array:
    """The result, of the kind and on the device of what was given."""
    if isinstance(given, Tensor):
        return result.to(given.device)
    return result.cpu().numpy()
