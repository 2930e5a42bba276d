"""A trained policy alone: observations in, actions out, in the environment's units.

Shapes: ``B`` batch (any leading dimensions, or none), ``S`` observation, ``A`` action.
"""

from __future__ import annotations

import copy
import io
import json
import logging
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from torchrl_osr._checks import check_choice, needed_by
from torchrl_osr._files import RECORD, read_tensors, write_atomically, write_tensors
from torchrl_osr.modules.actor import mlp
from torchrl_osr.policy.monitor import DataMonitor

DISTRIBUTIONS = ("TanhNormal", "TanhDelta", "OneHotCategorical")
"""Distributions that an actor may end in, by TorchRL's names."""

ACTIVATIONS = {
    each.__name__: each
    for each in (nn.ELU, nn.GELU, nn.LeakyReLU, nn.ReLU, nn.SiLU, nn.Tanh)
}
"""Activations that a network in a file may have."""

SUFFIX, GRAPHS = ".safetensors", (".onnx", ".pt2")
"""How the names of saved and of exported policies end."""

Array = TypeVar("Array", NDArray[Any], Tensor)


class Policy(nn.Module):
    """A trained policy and its critics, in the units of the environment.

    :func:`~torchrl_osr.load_policy` and :func:`~torchrl_osr.policy.policy_from_loss`
    make one. Standardisation of observations and scaling of actions are inside. As a
    module it maps observations ``[B, S]`` to deterministic actions and checks nothing:
    ``TensorDictModule(policy, ["observation"], ["action"])`` is a TorchRL policy. Of
    discrete actions it writes the number: ``GymEnv(..., categorical_action_encoding=
    True)`` takes it.

    Attributes:
        record: sizes of the networks, and what is known of the run in ``"source"``.
        loc, scale: of the training observations, ``[S]``.
        low, high: bounds of the actions, ``[A]``; empty where actions are discrete.
        data_monitor: see :meth:`attach`, or ``None``.
    """

    loc: Tensor
    scale: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self, record: Mapping[str, Any], tensors: Mapping[str, Tensor]
    ) -> None:
        super().__init__()
        self.record, self.distribution = dict(record), record["distribution"]
        check_choice("distribution", self.distribution, DISTRIBUTIONS)
        self.discrete = self.distribution == "OneHotCategorical"
        self.observation_size = inputs = record["observation_size"]
        self.action_size = actions = record["action_size"]
        outputs = actions * (2 if self.distribution == "TanhNormal" else 1)
        pair = (inputs, actions) if self.discrete else (inputs + actions, 1)
        numbers = {"loc": inputs, "scale": inputs}
        numbers |= dict.fromkeys(("low", "high"), 0 if self.discrete else actions)
        with torch.device("meta"):  # without memory, until the weights are assigned
            self.actor: nn.Module = _built(record["actor"], inputs, outputs)
            self.critics = nn.ModuleList(
                _built(record["critics"], *pair)
                for _ in range(record["critics"]["number"])
            )
            for name, size in numbers.items():
                self.register_buffer(name, torch.empty(size))
            self.data_monitor: DataMonitor | None = None
            if "monitor" in record:
                self.attach(DataMonitor(record["monitor"]))
        self.load_state_dict(dict(tensors), assign=True)
        self.requires_grad_(False).eval()

    @torch.no_grad()
    def act(self, observation: Array | Mapping[str, Any]) -> Array:
        """Return deterministic actions, NumPy for NumPy and torch for torch.

        Args:
            observation: as the environment gives it, one ``[S]`` or many ``[B, S]``. A
                dictionary of the log's columns is joined in their order, another one in
                the alphabetical order of its keys. NaN or infinity is a ValueError.

        Returns:
            Actions as the environment takes them: float32, ``[A]`` or ``[B, A]``,
            within the bounds; of a discrete policy int64 indices, ``[]`` or ``[B]``.
        """
        given, rows = self._given(observation)
        return _like(given, self(rows))

    @torch.no_grad()
    def value(
        self, observation: Array | Mapping[str, Any], action: Array | None = None
    ) -> Array:
        """Return the smallest of the critics' values, float32, ``[]`` or ``[B]``.

        It estimates the discounted sum of the training rewards. Conservative losses
        keep values low on purpose: take thresholds from values of known good states.

        Args:
            observation: as for :meth:`act`.
            action: as :meth:`act` returns it. Default: the policy's deterministic one.
        """
        self._check_critics()
        given, rows = self._given(observation)
        actions = self(rows) if action is None else self._actions(action, rows)
        return _like(given, self.smallest_value(rows, actions))

    @torch.no_grad()
    def monitor(self, observation: Array | Mapping[str, Any]) -> tuple[Array, Array]:
        """Return how far states are from the data, and whether that is an alarm.

        Args:
            observation: as for :meth:`act`. NaN and infinity raise an alarm.

        Returns:
            Scores, float32, and alarms, bool, both ``[]`` or ``[B]``; see
            :class:`~torchrl_osr.policy.DataMonitor`.
        """
        if self.data_monitor is None:
            raise ValueError(
                "this policy has no monitor: attach torchrl_osr.policy.fit_monitor()."
            )
        given, rows = self._given(observation, finite=False)
        score, alarm = self.data_monitor(rows)
        return _like(given, score), _like(given, alarm)

    def attach(self, monitor: DataMonitor) -> None:
        """Attach a monitor, which :meth:`save` and :meth:`export` write too."""
        self.data_monitor, self.record["monitor"] = monitor, monitor.record

    def save(self, path: Path | str) -> None:
        """Write everything to one file, ``policy.safetensors`` for instance.

        :func:`~torchrl_osr.load_policy` reads it. Weights, statistics and bounds are
        tensors; sizes, origin and versions are JSON in the file's metadata.
        """
        write_tensors(Path(path), self.state_dict(), self.record)

    def export(
        self, path: Path | str, output: Literal["action", "value"] = "action"
    ) -> None:
        """Write a graph that works without this package, for batches of any size.

        It maps ``observation`` ``[B, S]`` to the deterministic ``action`` ``[B, A]``,
        or ``observation`` and ``action`` to ``value`` ``[B]``, all float32. Discrete
        actions are int64, ``[B]``. A graph checks nothing: NaN in is NaN out.

        With a monitor, ``score`` ``[B]`` and ``alarm`` ``[B]``, bool, follow
        ``action``. An action that is not finite becomes the middle of the bounds then.

        Args:
            path: ends in ``.onnx`` for ONNX, or in ``.pt2`` for :mod:`torch.export`.
            output: what it computes, as :meth:`act` or as :meth:`value`.
        """
        path = Path(path)
        check_choice("output", output, ("action", "value"))
        check_choice("the suffix of the path", path.suffix, GRAPHS)
        inputs = {"observation": self.loc.repeat(2, 1)}
        part = copy.deepcopy(self)  # a graph keeps all weights, needed or not
        names: list[str] = [output]
        if output == "value":
            self._check_critics()
            inputs["action"] = self(inputs["observation"])
            part.actor, part.data_monitor = nn.Identity(), None
            part.forward = part.smallest_value  # type: ignore[method-assign,assignment]
        else:
            part.critics = nn.ModuleList()
            if self.data_monitor is not None:
                part.forward = part._monitored  # type: ignore[method-assign,assignment]
                names += ["score", "alarm"]
        rows = torch.export.Dim("batch")
        given: dict[str, Any] = {"args": (), "kwargs": inputs}
        given["dynamic_shapes"] = {name: {0: rows} for name in inputs}
        record = json.dumps(self.record)
        if path.suffix == ".onnx":
            content = _onnx(part, given, names, record)
        else:
            file, program = io.BytesIO(), torch.export.export(part, **given)
            torch.export.save(program, file, extra_files={RECORD: record})
            content = file.getvalue()
        write_atomically(path, content)

    def forward(self, observation: Tensor) -> Tensor:
        """Return deterministic actions, see :meth:`act`; nothing is checked."""
        action = self.mode(self.actor(self._standardized(observation)))
        if self.discrete:
            return action
        center, half = self._units()
        # Rounding may lead out of the bounds by one bit.
        return (action * half + center).clamp(self.low, self.high)

    def _monitored(self, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return finite actions, scores and alarms, see :meth:`export`."""
        assert self.data_monitor is not None
        action = Policy.forward(self, observation)  # this method takes its place
        if not self.discrete:
            action = torch.where(action.isnan(), self._units()[0], action)
        return action, *self.data_monitor(observation)

    def smallest_value(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return the smallest value, see :meth:`value`; nothing is checked."""
        state = self._standardized(observation)
        if self.discrete:
            index = action.unsqueeze(-1)
            values = [critic(state).gather(-1, index) for critic in self.critics]
        else:
            center, half = self._units()
            unit = (action - center) / half
            values = [critic(state, unit) for critic in self.critics]
        return torch.stack(values).amin(0).squeeze(-1)

    def mode(self, raw: Tensor) -> Tensor:
        """Return the deterministic action: an index, or within -1 and 1."""
        if self.discrete:
            return raw.argmax(-1)
        loc = raw.chunk(2, -1)[0] if self.distribution == "TanhNormal" else raw
        return loc.tanh()

    def _standardized(self, observation: Tensor) -> Tensor:
        # Gymnasium's MuJoCo tasks have float64.
        return (observation.to(self.loc.dtype) - self.loc) / self.scale

    def _units(self) -> tuple[Tensor, Tensor]:
        """Return the middle and the half-width of the bounds."""
        return (self.low + self.high) / 2, (self.high - self.low) / 2

    def _given(self, observation: Any, *, finite: bool = True) -> tuple[Any, Tensor]:
        """Return the observation as one vector, and as rows on the policy's device."""
        data = self.record.get("source", {}).get("data")
        names = data.get("observation_names") if isinstance(data, Mapping) else None
        given = joined(observation, names or ())
        return given, self._rows("observation", given, self.observation_size, finite)

    def _rows(self, name: str, value: Any, size: int, finite: bool = True) -> Tensor:
        rows = _tensor(value).to(self.loc.device, torch.float32)
        if not rows.ndim or rows.shape[-1] != size:
            raise ValueError(
                f"the {name} has shape {tuple(rows.shape)}, expected ({size},) or "
                f"(batch, {size})."
            )
        if finite and not rows.isfinite().all():
            raise ValueError(f"the {name} has entries that are NaN or infinite.")
        return rows

    def _actions(self, value: Any, observation: Tensor) -> Tensor:
        """Return the value as actions that were taken in these observations."""
        if self.discrete:
            action = _tensor(value).to(self.loc.device)
            shape = observation.shape[:-1]
            least, most = torch.tensor(0), torch.tensor(self.action_size - 1)
        else:
            action = self._rows("action", value, self.action_size)
            shape = torch.Size([*observation.shape[:-1], self.action_size])
            margin = 5e-6 * (self.high - self.low)  # a caller's own arithmetic rounds
            least, most = self.low - margin, self.high + margin
        whole = not self.discrete or not action.is_floating_point()
        inside = ((action >= least) & (action <= most)).all()
        if action.shape != shape or not (inside and whole):
            raise ValueError(
                f"the action must have shape {tuple(shape)} and lie within "
                f"{least.tolist()} and {most.tolist()}; its shape is "
                f"{tuple(action.shape)}, its type {action.dtype}."
            )
        return action.long() if self.discrete else action

    def _check_critics(self) -> None:
        if not self.critics:
            raise ValueError("this policy has no critics: the loss had none.")


def load_policy(path: Path | str) -> Policy:
    """Load a saved policy on the CPU; nothing is unpickled.

    Args:
        path: a ``.safetensors`` file of :meth:`~torchrl_osr.policy.Policy.save`, or
            the folder of a finished run, for its last policy.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_osr import CQLLoss, load_policy
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> from torchrl_osr.policy import policy_from_loss
        >>> loss = CQLLoss(tanh_gaussian_actor(3, 1), critic_ensemble(3, 1))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     policy_from_loss(loss).save(f"{folder}/policy.safetensors")
        ...     policy = load_policy(f"{folder}/policy.safetensors")
        >>> policy.act(np.zeros(3)).shape
        (1,)
    """
    if (path := Path(path)).is_dir():
        path /= f"policy{SUFFIX}"
    tensors, record = read_tensors(path)
    del record["checksum"]  # of the file
    try:
        return Policy(record, tensors)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path} is no saved policy: {error!r}") from error


def _built(sizes: Mapping[str, Any], inputs: int, outputs: int) -> nn.Module:
    activation = ACTIVATIONS[sizes["activation"]]
    norm, cells = bool(sizes["layer_norm"]), sizes["num_cells"]
    return mlp(inputs, outputs, cells, activation, layer_norm=norm)


def _onnx(
    graph: nn.Module, given: dict[str, Any], names: list[str], record: str
) -> bytes:
    with needed_by("ONNX needs", "export"):
        import onnxscript  # noqa: F401
    given = given | {"input_names": list(given["kwargs"]), "output_names": names}
    # torch 2.13's exporter calls what torch deprecates, and misses torchvision.
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            onnx: Any = torch.onnx.export(graph, **given, dynamo=True, verbose=False)
    finally:
        log.setLevel(level)
    onnx.model.metadata_props[RECORD] = record
    return onnx.model_proto.SerializeToString()


def joined(observation: Any, columns: Sequence[str] = ()) -> Any:
    """Return a dictionary's vectors as one, in the order of columns or alphabet."""
    if not isinstance(observation, Mapping):
        return observation
    known = {*columns} == {*observation}
    single = (x for x in observation.values() if not isinstance(x, Mapping))
    if columns and not known and any(np.ndim(x) == 0 for x in single):
        raise ValueError(
            f"the observation has numbers named {[*observation]}, and the columns of "
            f"the log are {[*columns]}: give these, or one vector in their order."
        )
    keys = columns if known else sorted(observation)
    parts = [joined(observation[key]) for key in keys]
    if all(isinstance(part, Tensor) for part in parts):
        return torch.cat([part if part.ndim else part[None] for part in parts], -1)
    return np.concatenate([np.atleast_1d(part) for part in parts], -1)


def _tensor(value: Any) -> Tensor:
    # A copy: torch warns of arrays that are read-only.
    return value if isinstance(value, Tensor) else torch.from_numpy(np.array(value))


def _like(given: Array, result: Tensor) -> Array:
    """Return the result as what was given: NumPy, or torch on its device."""
    if isinstance(given, Tensor):
        return result.to(given.device)
    return result.cpu().numpy()
