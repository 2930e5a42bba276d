"""Behaviour policies: small tanh-Gaussian actors stored as plain arrays.

The forward pass is NumPy: for a single observation it costs a quarter of a torch call,
and a roll-out makes hundreds of thousands of them.

Shapes: ``B`` batch, ``S`` observation, ``A`` action, ``H`` hidden width. Weights are
``[out, in]``, as in :class:`torch.nn.Linear`.
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
"""Folder of the policies that ship with the package."""

# The bounds that the actors were trained with.
LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


class Affine(NamedTuple):
    """Weight ``[out, in]`` and bias ``[out]`` of one linear layer."""

    weight: FloatArray
    bias: FloatArray

    def __call__(self, inputs: FloatArray) -> FloatArray:
        outputs: FloatArray = inputs @ self.weight.T + self.bias
        return outputs


@dataclass(frozen=True)
class BehaviorPolicy:
    r"""A tanh-Gaussian actor evaluated in NumPy.

    .. math::
        a = \tanh(\mu(s) + \sigma(s)\,\epsilon), \quad \epsilon \sim N(0, I)

    Args:
        hidden0: first hidden layer, weight ``[H, S]``.
        hidden1: second hidden layer, weight ``[H, H]``.
        mean: head of the pre-tanh mean, weight ``[A, H]``.
        log_std: head of the log standard deviation, weight ``[A, H]``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_osr.lab.data import load_behavior_policy
        >>> policy = load_behavior_policy("hopper", "medium")
        >>> policy.sample(np.zeros(11), np.random.default_rng(0)).shape
        (3,)
    """

    hidden0: Affine
    hidden1: Affine
    mean: Affine
    log_std: Affine

    @property
    def observation_size(self) -> int:
        """Number of observation entries ``S``."""
        return int(self.hidden0.weight.shape[1])

    @property
    def action_size(self) -> int:
        """Number of action entries ``A``."""
        return int(self.mean.weight.shape[0])

    def sample(
        self, observation: NDArray[np.floating[Any]], rng: np.random.Generator
    ) -> FloatArray:
        """Random actions ``[A]`` or ``[B, A]`` in -1 to 1, float32.

        Args:
            observation: ``[S]`` or ``[B, S]``, not standardised.
            rng: source of the noise.
        """
        features = self._features(observation)
        loc = self.mean(features)
        log_std = np.clip(self.log_std(features), LOG_STD_MIN, LOG_STD_MAX)
        noise = rng.standard_normal(loc.shape, dtype=np.float32)
        action: FloatArray = np.tanh(loc + np.exp(log_std) * noise)
        return action

    def deterministic(self, observation: NDArray[np.floating[Any]]) -> FloatArray:
        """Squashed mean actions ``[A]`` or ``[B, A]``, see :meth:`sample`."""
        action: FloatArray = np.tanh(self.mean(self._features(observation)))
        return action

    def _features(self, observation: NDArray[np.floating[Any]]) -> FloatArray:
        inputs = np.asarray(observation, dtype=np.float32)
        hidden = np.maximum(self.hidden0(inputs), np.float32(0))
        return np.maximum(self.hidden1(hidden), np.float32(0))


def load_behavior_card(folder: Path | str | None = None) -> dict[str, Any]:
    """``card.json``: ``{env_name: {"env": id, "policies": {policy_name: {...}}}}``.

    Args:
        folder: of the card. Default: the policies of the package.
    """
    return read_json(Path(folder or BEHAVIOR_POLICIES_DIR) / "card.json")


def behavior_policy_path(
    env_name: str, policy_name: str, folder: Path | str | None = None
) -> Path:
    """File of a policy that the card names, see :func:`load_behavior_policy`."""
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
    """Load a behaviour policy by name, in float32.

    Args:
        env_name: short environment name, such as ``"hopper"``.
        policy_name: ``"medium"``, ``"expert"``, ``"replay_1"`` ... ``"replay_8"``.

    Keyword Args:
        folder: with ``card.json`` and ``<env_name>/<policy_name>.npz``, as
            ``examples/train_behavior.py`` writes it. Default: the policies of the
            package.

    Raises:
        ValueError: unknown name (the message lists the known ones), or a damaged file.
    """
    arrays = read_arrays(behavior_policy_path(env_name, policy_name, folder))

    def layer(name: str) -> Affine:
        parts = (arrays[f"{name}.{part}"] for part in Affine._fields)
        return Affine(*(part.astype(np.float32) for part in parts))

    names = [each.name for each in fields(BehaviorPolicy)]
    return BehaviorPolicy(**{name: layer(name) for name in names})
