"""When a task ends, as its simulator decides it from an observation.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import torch
from torch import Tensor

Termination = Callable[[Tensor], Tensor]
"""Maps next observations ``[B, S]``, in the task's own units, to bool ``[B]``."""


def never(observation: Tensor) -> Tensor:
    """No state ends the task: ``False`` for each of ``[B, S]``."""
    return torch.zeros(
        observation.shape[:-1], dtype=torch.bool, device=observation.device
    )


def hopper(observation: Tensor) -> Tensor:
    """Hopper has fallen: Gymnasium's ``is_healthy`` does not hold.

    Healthy is a height above 0.7, an angle between -0.2 and 0.2, and all but the height
    between -100 and 100 (Gymnasium bounds velocities before they are clipped to 10 in
    the observation; no clipped one is beyond).
    """
    height, angle = observation[..., 0], observation[..., 1]
    state = observation[..., 1:].abs().amax(-1)
    return ~((height > 0.7) & (angle.abs() < 0.2) & (state < 100))


def walker2d(observation: Tensor) -> Tensor:
    """Walker2d has fallen: its height is not between 0.8 and 2, or its angle beyond 1.

    Gymnasium's ``is_healthy`` does not hold.
    """
    height, angle = observation[..., 0], observation[..., 1]
    return ~((height > 0.8) & (height < 2) & (angle.abs() < 1))


KNOWN: dict[str, Termination] = {
    "HalfCheetah": never,
    "Hopper": hopper,
    "Walker2d": walker2d,
}
"""By the name of the task, for the versions 2 to 5 of Gymnasium, which agree."""


def termination(env_id: str) -> Termination:
    """The rule by which a task ends, time limits apart.

    The rules are those of the code of Gymnasium's environments, with their default
    options (Farama-Foundation/Gymnasium, ``gymnasium/envs/mujoco``).

    Args:
        env_id: Gymnasium id.

    Raises:
        ValueError: there is no rule for this task.

    Examples:
        >>> import torch
        >>> from torchrl_osr.lab.dynamics import termination
        >>> standing, fallen = torch.zeros(2, 11)
        >>> standing[0], fallen[0] = 1.2, 0.6
        >>> termination("Hopper-v5")(torch.stack([standing, fallen]))
        tensor([False,  True])
    """
    found = re.fullmatch(r"(\w+)-v[2-5]", env_id)
    if found is None or found[1] not in KNOWN:
        raise ValueError(
            f"no rule is known by which {env_id} ends (there are those of "
            f"{', '.join(KNOWN)}), and roll-outs of a model need one: take "
            "dynamics.terminations=never if it is ended by a time limit alone, or "
            "call torchrl_osr.lab.dynamics.imagine with a function of your own."
        )
    return KNOWN[found[1]]
