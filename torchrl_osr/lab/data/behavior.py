"""Behaviour policies: small tanh-Gaussian actors in NumPy.

For a single observation NumPy costs a quarter of a torch call.
Shapes: ``B`` batch, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_osr._files import read_arrays, read_json

FloatArray = NDArray[np.float32]

BEHAVIOR_POLICIES_DIR = Path(__file__).parent / "behavior_policies"

# The bounds that the actors were trained with.
LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


@dataclass(frozen=True)
class BehaviorPolicy:
    """A tanh-Gaussian actor: layers ``hidden0``, ``hidden1``, ``mean``, ``log_std``.

    Each layer has a ``.weight`` ``[out, in]`` and a ``.bias`` ``[out]`` in ``arrays``.
    """

    arrays: Mapping[str, FloatArray]

    def sample(self, observation: NDArray[Any], rng: np.random.Generator) -> FloatArray:
        """Draw actions ``[A]`` or ``[B, A]`` for states that are not standardised."""
        features = self._features(observation)
        loc = self._layer("mean", features)
        log_std = np.clip(self._layer("log_std", features), LOG_STD_MIN, LOG_STD_MAX)
        noise = rng.standard_normal(loc.shape, dtype=np.float32)
        return np.asarray(np.tanh(loc + np.exp(log_std) * noise))

    def deterministic(self, observation: NDArray[Any]) -> FloatArray:
        """Return squashed mean actions ``[A]`` or ``[B, A]``, see :meth:`sample`."""
        return np.asarray(np.tanh(self._layer("mean", self._features(observation))))

    def _features(self, observation: NDArray[Any]) -> FloatArray:
        inputs = np.asarray(observation, dtype=np.float32)
        hidden = np.maximum(self._layer("hidden0", inputs), np.float32(0))
        return np.maximum(self._layer("hidden1", hidden), np.float32(0))

    def _layer(self, name: str, inputs: FloatArray) -> FloatArray:
        weight, bias = (self.arrays[f"{name}.{each}"] for each in ("weight", "bias"))
        return np.asarray(inputs @ weight.T + bias)


def load_behavior_card(folder: Path | str | None = None) -> dict[str, Any]:
    """Read ``card.json``: ``{env_name: {"env": id, "policies": {name: {...}}}}``."""
    return read_json(Path(folder or BEHAVIOR_POLICIES_DIR) / "card.json")


def behavior_policy_path(
    env_name: str, policy_name: str, folder: Path | str | None = None
) -> Path:
    """Return the file of a policy that the card names."""
    card = load_behavior_card(folder)
    there = card.get(env_name, {}).get("policies", {})
    if policy_name not in there:
        raise ValueError(
            f"no behaviour policy {policy_name!r} for {env_name!r}; there are "
            f"{', '.join(there) or 'policies for ' + ', '.join(card)}."
        )
    return Path(folder or BEHAVIOR_POLICIES_DIR) / env_name / f"{policy_name}.npz"


def load_behavior_policy(
    env_name: str, policy_name: str, *, folder: Path | str | None = None
) -> BehaviorPolicy:
    """Load ``"medium"``, ``"expert"``, or ``"replay_1"`` to ``"replay_8"`` in float32.

    ``examples/train_behavior.py`` writes a ``folder`` of your own.
    """
    arrays = read_arrays(behavior_policy_path(env_name, policy_name, folder))
    return BehaviorPolicy({name: arrays[name].astype(np.float32) for name in arrays})
