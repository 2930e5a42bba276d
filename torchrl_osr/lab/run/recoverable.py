"""Which of the recoverable states a run comes back from.

What ``torchrl-osr evaluate suite=recoverable`` does; the states themselves are those of
:mod:`torchrl_osr.lab.evaluation.recoverable`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from torchrl_osr.lab.data.environment import environment_id
from torchrl_osr.lab.evaluation import Policy, deterministic_policy
from torchrl_osr.lab.evaluation.recoverable import (
    GROUPS,
    RecoverableStates,
    disturbances_of,
    load_recoverable_states,
    recovers,
)
from torchrl_osr.lab.evaluation.robustness import aligned_columns
from torchrl_osr.lab.evaluation.statistics import saved_share
from torchrl_osr.lab.run.trained_run import load_trained


def states_for(run: DictConfig, half: str) -> RecoverableStates:
    """The states of a run's task.

    Args:
        run: its configuration.
        half: ``"public"`` or ``"held-out"``.

    Raises:
        ValueError: there are none, or the run is of another version of the task.
    """
    states = load_recoverable_states(run.env.name, half)
    if run.env.id != (of := environment_id(run.env.name)):
        raise ValueError(
            f"the recoverable states of {run.env.name} are of {of}, and the run is of "
            f"{run.env.id}."
        )
    return states


def play_states(
    files: Sequence[Path],
    half: str,
    *,
    together: Policy | None = None,
    trust: Sequence[str] = (),
    advance: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Play every checkpoint from every state.

    Args:
        files: checkpoints of one run, or of one task.
        half: of the states.

    Keyword Args:
        together: one policy of all of them. Default: each plays by itself.
        trust: modules of the user's own that the run may name.
        advance: called after each checkpoint.

    Returns:
        JSON-compatible: ``env``, ``data``, ``half``; of each state ``group``,
        ``disturbance`` (kind and strength) and ``walk``; and ``evaluations``, with
        ``step`` and, for each state, 1 if it came ``back`` and 0 if not.
    """
    run = load_trained(files[0], trust=trust).config
    states, evaluations = states_for(run, half), []
    for file in files if together is None else files[:1]:
        trained = load_trained(file, trust=trust)
        alone = deterministic_policy(trained.actor, trained.observation_norm)
        back = recovers(states, together or alone)
        evaluations.append({"step": trained.step, "back": back.astype(int).tolist()})
        advance()
    return {
        "env": run.env.name,
        "data": run.data.source,
        "half": half,
        "group": states.group.tolist(),
        "disturbance": states.disturbance,
        "walk": states.walk.tolist(),
        "evaluations": evaluations,
    }


def shares(results: Mapping[str, Any]) -> dict[str, tuple[int, float, float, float]]:
    """Number of states, and the share that all checkpoints save, with its interval.

    Args:
        results: of :func:`play_states`.

    Returns:
        By group; and for the recoverable ones also by disturbance.
    """
    of_each = "group", "disturbance", "walk"
    group, disturbance, walk = (np.array(results[key]) for key in of_each)
    back = np.mean([each["back"] for each in results["evaluations"]], axis=0)[None]
    rows = {name: group == name for name in GROUPS}
    hard = rows[GROUPS[-1]]
    for name in disturbances_of(disturbance[hard]):
        rows[f"  {name}"] = hard & (disturbance == name)
    return {
        name: (int(chosen.sum()), *saved_share(back[:, chosen], walk[chosen]))
        for name, chosen in rows.items()
        if chosen.any()
    }


def recoverable_table(results: Mapping[str, Any]) -> str:
    """Text table of :func:`shares`."""
    header = ("states", "number", "comes back %", "[95 %]")
    rows = [
        (name, str(number), f"{100 * mean:.0f}", f"[{100 * low:.0f}, {100 * high:.0f}]")
        for name, (number, mean, low, high) in shares(results).items()
    ]
    number = len(results["evaluations"])
    title = f"{results['env']} {results['data']}, {results['half']} recoverable states"
    if number > 1:
        title += f": mean of {number} checkpoints"
    return "\n".join([title, *aligned_columns([header, *rows])])
