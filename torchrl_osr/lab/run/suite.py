"""The configuration of ``torchrl-osr evaluate``: its schema, and what is made of it.

:func:`register` makes the schema known to Hydra, which then refuses a mistyped key or a
value of the wrong type by name. :func:`make_disturbances` builds a suite's wrappers and
attacks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from hydra.core.config_store import ConfigStore
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import MISSING
from tensordict import TensorDict
from torchrl.modules import TanhNormal

from torchrl_osr.lab.envs import attacked_policy, critics_of
from torchrl_osr.lab.evaluation import Disturbance
from torchrl_osr.lab.run.trained_run import TrainedRun
from torchrl_osr.objectives.networks import CATEGORICAL

DATA_UNIT = "data"
"""As a wrapper's ``unit``: the data's standard deviations."""


@dataclass
class DisturbanceConfig:
    """One kind of disturbance at one strength: either a wrapper or an attack.

    Attributes:
        kind: what is disturbed; those of kind knock, push and start end, all others
            last the whole episode.
        strength: for the figure's axis, in the unit of its kind.
        wrap: the wrapper of ``torchrl_osr.lab.envs``, with ``_target_`` and
        ``_partial_``.
        attack: options of ``attacked_policy``.
    """

    kind: str = MISSING
    strength: float = MISSING
    wrap: Any = None
    attack: Any = None


@dataclass
class SuiteConfig:
    """A list of disturbances, or states that others fail from.

    Attributes:
        name: part of the names of the result files.
        disturbances: by name.
        half: of the recoverable states, in place of disturbances.
    """

    name: str = MISSING
    disturbances: dict[str, DisturbanceConfig] = MISSING
    half: str | None = None


@dataclass
class EvaluateConfig:
    """All keys of ``torchrl-osr evaluate``.

    Attributes:
        checkpoint: a run's folder, or one checkpoint's file in it.
        sweep: in its place a folder: every finished run in or below it.
        switching: the sweep's runs are one policy, of which the best one acts.
        jobs: runs of a sweep that are evaluated at once.
        suite: the disturbances.
        episodes: pairs of episodes for each checkpoint and disturbance, at least 2.
        last: number of the run's newest checkpoints, or fewer if it has fewer.
        seed: of the first checkpoint's first episode; the next checkpoint's is 1000
            more.
        force: repeat a finished evaluation.
        num_threads: torch threads; several fight where the machine is shared.
        progress: a progress bar, when on a terminal.
        trust: modules of your own that the run may name, see docs/extend.md.
    """

    checkpoint: str | None = None
    sweep: str | None = None
    switching: bool = MISSING
    jobs: int = MISSING
    suite: SuiteConfig = field(default_factory=SuiteConfig)
    episodes: int = MISSING
    last: int = MISSING
    seed: int = MISSING
    force: bool = MISSING
    num_threads: int = MISSING
    progress: bool = MISSING
    trust: list[str] = MISSING


def register() -> None:
    """Make the schema known to Hydra as ``evaluate_schema``."""
    ConfigStore.instance().store(name="evaluate_schema", node=EvaluateConfig)


def make_disturbances(
    configs: Mapping[str, Any],
    trained: TrainedRun,
    scale: NDArray[np.floating],
    *,
    seed: int = 0,
) -> list[Disturbance]:
    """Build the wrappers and attacks of a suite.

    Args:
        configs: a :class:`DisturbanceConfig` by name.
        trained: its networks are those that are attacked.
        scale: standard deviation of each observation entry in the data, ``[S]``; takes
            the place of a wrapper's ``unit: data``.

    Keyword Args:
        seed: of the attacks' draws. Default 0.

    Raises:
        ValueError: if a disturbance has both wrapper and attack, or neither.
    """
    made = []
    for name, config in configs.items():
        if (config.wrap is None) == (config.attack is None):
            raise ValueError(f"disturbance {name!r} needs either wrap or attack.")
        wrap = policy = None
        if config.wrap is not None:
            wrap = instantiate(config.wrap)
            if wrap.keywords.get("unit") == DATA_UNIT:
                wrap = partial(wrap, unit=scale)
        else:
            policy = attacked_policy(
                trained.actor.get_dist,
                critics_of(trained.loss),
                trained.observation_norm,
                **config.attack,
                seed=seed,
            )
        made.append(Disturbance(name, config.kind, config.strength, wrap, policy))
    return made


def impossible_attacks(
    configs: Mapping[str, Any], trained: TrainedRun
) -> dict[str, str]:
    """Those attacks of a suite that a run's policy cannot meet, and why, by name."""
    obstacles = {
        name: _obstacle(config.attack.kind, trained)
        for name, config in configs.items()
        if config.attack is not None
    }
    return {name: obstacle for name, obstacle in obstacles.items() if obstacle}


def _obstacle(kind: str, trained: TrainedRun) -> str:
    """Reason why a run's policy cannot be attacked, or nothing."""
    if not trained.config.data.standardize:
        return (
            "attacks are in standard deviations of the data, and the run has "
            "data.standardize=false"
        )
    observation = torch.zeros_like(trained.observation_norm.loc)
    distribution = trained.actor.get_dist(TensorDict({"observation": observation}))
    if isinstance(distribution, CATEGORICAL):
        return "attacks are on policies of real actions, and the run's are discrete"
    if kind == "min_Q" and not hasattr(trained.loss, "qvalue_network"):
        return (
            f"min_Q asks critics, and {type(trained.loss).__name__} has none; leave it "
            "out by ~suite.disturbances.<name>"
        )
    if kind == "action_diff" and not isinstance(distribution, TanhNormal):
        return (
            "action_diff compares tanh-Gaussian distributions, and the policy's is a "
            f"{type(distribution).__name__}"
        )
    return ""
