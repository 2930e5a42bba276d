"""From a suite's configuration to levels that can be played."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from hydra.utils import instantiate
from numpy.typing import NDArray

from torchrl_osr.envs.observation_attack import attacked_policy, networks_of
from torchrl_osr.evaluation.robustness import Level
from torchrl_osr.experiment.trained_run import TrainedRun

DATA_UNIT = "data"
"""As a wrapper's ``unit``: the data's standard deviations."""


def make_levels(
    levels: Mapping[str, Any],
    trained: TrainedRun,
    scale: NDArray[np.floating],
    *,
    seed: int = 0,
) -> list[Level]:
    """Instantiate the wrappers and attacks of a suite.

    Args:
        levels: by name, see
            :class:`~torchrl_osr.experiment.evaluate_schema.LevelConfig`.
        trained: whose networks an attack looks at.
        scale: standard deviation of each observation entry in the data, ``[S]``; takes
            the place of a wrapper's ``unit: data``.

    Keyword Args:
        seed: of the attacks' draws. Default 0.

    Raises:
        ValueError: if a level has both wrapper and attack, or neither, or an attack's
            unit, the data's standard deviation, is not the networks'.
    """
    made = []
    for name, each in levels.items():
        if (each.wrap is None) == (each.attack is None):
            raise ValueError(f"level {name!r} needs either wrap or attack.")
        wrap = policy = None
        if each.wrap is not None:
            wrap = instantiate(each.wrap)
            if wrap.keywords.get("unit") == DATA_UNIT:
                wrap = partial(wrap, unit=scale)
        else:
            if not trained.config.data.standardize:
                raise ValueError(
                    f"level {name!r} is not possible for {trained.folder}: attacks are "
                    "in standard deviations, which data.standardize=false leaves out."
                )
            policy = attacked_policy(
                *networks_of(trained.loss), trained.observation_norm, **each.attack,
                seed=seed,
            )  # fmt: skip
        made.append(Level(name, each.kind, each.strength, wrap, policy))
    return made
