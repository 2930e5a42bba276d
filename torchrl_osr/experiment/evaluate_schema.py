"""The typed schema of ``examples/evaluate.py``.

:func:`register` makes it known to Hydra, which then refuses a mistyped key or a value
of the wrong type by name.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING


@dataclass
class LevelConfig:
    """One disturbance at one strength.

    Attributes:
        kind: what is disturbed; knock, push and start end, the others stay.
        strength: for the figure's axis, in the unit of its kind.
        wrap: the wrapper of ``torchrl_osr.envs``, with ``_target_`` and ``_partial_``.
        attack: options of ``attacked_policy``, in the place of a wrapper.
    """

    kind: str = MISSING
    strength: float = MISSING
    wrap: Any = None
    attack: Any = None


@dataclass
class SuiteConfig:
    """A list of disturbances.

    Attributes:
        name: of the files that it writes.
        levels: by name.
    """

    name: str = MISSING
    levels: dict[str, LevelConfig] = MISSING


@dataclass
class EvaluateConfig:
    """Everything that ``examples/evaluate.py`` reads.

    Attributes:
        checkpoint: a run's folder, or one checkpoint's file in it.
        suite: the disturbances.
        episodes: pairs of episodes for each checkpoint and level, at least 2.
        last: at most so many of a run's newest checkpoints.
        seed: of the first checkpoint's first episode; the next checkpoint's is 1000
            more.
        force: do a finished evaluation again.
        num_threads: torch threads; several fight where the machine is shared.
        progress: a progress bar, when on a terminal.
    """

    checkpoint: str = MISSING
    suite: SuiteConfig = field(default_factory=SuiteConfig)
    episodes: int = MISSING
    last: int = MISSING
    seed: int = MISSING
    force: bool = MISSING
    num_threads: int = MISSING
    progress: bool = MISSING


def register() -> None:
    """Make the schema known to Hydra as ``evaluate_schema``."""
    ConfigStore.instance().store(name="evaluate_schema", node=EvaluateConfig)
