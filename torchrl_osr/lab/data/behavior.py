"""Behaviour policies: small tanh-Gaussian actors in NumPy.

For a single observation NumPy costs a quarter of a torch call.
Shapes: ``B`` batch, ``S`` observation, ``A`` action, ``H`` hidden width.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_osr._files import read_arrays, read_json

FloatArray = NDArray[np.float32]

BEHAVIOR_POLICIES_DIR = Path(__file__).parent / "behavior_policies"

# The bounds that the actors were trained with.
LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


class Affine(NamedTuple):
    """Weight ``[out, in]`` and bias ``[out]`` of one linear layer."""

    weight: FloatArray
    bias: FloatArray

    def __call__(self, inputs: FloatArray) -> FloatArray:
        return np.asarray(inputs @ self.weight.T + self.bias)


@dataclass(frozen=True)
class BehaviorPolicy:
    """A tanh-Gaussian actor; weights ``[H, S]``, ``[H, H]`` and twice ``[A, H]``."""

    hidden0: Affine
    hidden1: Affine
    mean: Affine
    log_std: Affine

    def sample(self, observation: NDArray[Any], rng: np.random.Generator) -> FloatArray:
        """Draw actions ``[A]`` or ``[B, A]`` for states that are not standardised."""
        features = self._features(observation)
        loc = self.mean(features)
        log_std = np.clip(self.log_std(features), LOG_STD_MIN, LOG_STD_MAX)
        noise = rng.standard_normal(loc.shape, dtype=np.float32)
        return np.asarray(np.tanh(loc + np.exp(log_std) * noise))

    def deterministic(self, observation: NDArray[Any]) -> FloatArray:
        """Return squashed mean actions ``[A]`` or ``[B, A]``, see :meth:`sample`."""
        return np.asarray(np.tanh(self.mean(self._features(observation))))

    def _features(self, observation: NDArray[Any]) -> FloatArray:
        inputs = np.asarray(observation, dtype=np.float32)
        hidden = np.maximum(self.hidden0(inputs), np.float32(0))
        return np.maximum(self.hidden1(hidden), np.float32(0))


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
    arrays = {name: array.astype(np.float32) for name, array in arrays.items()}
    layers = (each.name for each in fields(BehaviorPolicy))
    return BehaviorPolicy(
        *(Affine(arrays[f"{n}.weight"], arrays[f"{n}.bias"]) for n in layers)
    )
