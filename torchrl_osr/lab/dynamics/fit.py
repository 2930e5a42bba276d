"""Accuracy and calibration of a dynamics model, one step and several steps ahead.

Shapes: ``N`` rows, ``D`` predicted entries, ``L`` rows of a piece of a trajectory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_osr.lab.dynamics.ensemble import (
    DynamicsEnsemble,
    gaussian_error,
    has_next_state,
)

HORIZONS = (1, 2, 5, 10, 20)
"""Steps after which a roll-out is compared with the recording."""


@torch.no_grad()
def dynamics_report(
    model: DynamicsEnsemble,
    held_out: TensorDictBase,
    pieces: TensorDictBase | None = None,
) -> dict[str, Any]:
    """Measure an ensemble's errors on rows ``[N]``, and how well it predicts them.

    Returns:
        ``"nll"`` of the elites, in nats, summed over entries; ``"mse"`` of all
        networks, in standardised targets; ``"r2"`` of the elites' mean for each entry,
        the reward last; the shares of errors ``"within_1_sigma"`` and
        ``"within_2_sigma"``, 0.683 and 0.954 if calibrated; Spearman's correlation of
        disagreement and error, ``"disagreement_rank"``; :func:`rollout_errors`.
    """
    rows = held_out[has_next_state(held_out, model.in_keys[0])]
    _, targets = model.inputs_and_targets(rows)
    mean, scale = model.predict(*(rows[key] for key in model.in_keys))
    unit = model.target_scale
    mse = ((mean - targets) / unit).square().mean().item()
    disagreement = model.disagreement(mean)
    mean, scale = mean[model.elites], scale[model.elites]
    deviation = (mean - targets).abs() / scale
    error = mean.mean(0) - targets
    r2 = 1 - error.square().sum(0) / (targets - targets.mean(0)).square().sum(0)
    twice_nll = gaussian_error(mean, 2 * scale.log(), targets) + math.log(2 * math.pi)
    both = torch.stack([disagreement, (error / unit).norm(dim=-1)])
    ranks = both.argsort().argsort().double()
    report = {
        "nll": targets.shape[-1] * twice_nll.mean().item() / 2,
        "mse": mse,
        "r2_mean": r2.mean().item(),
        "r2": r2.tolist(),
        "within_1_sigma": (deviation < 1).float().mean().item(),
        "within_2_sigma": (deviation < 2).float().mean().item(),
        "disagreement_rank": torch.corrcoef(ranks)[0, 1].item(),
        "rows": len(rows),
    }
    if pieces is not None:
        report["rollout"] = rollout_errors(model, pieces)
    return report


@torch.no_grad()
def rollout_errors(
    model: DynamicsEnsemble, pieces: TensorDictBase, horizons: Sequence[int] = HORIZONS
) -> list[dict[str, float]]:
    """Measure errors of the elites' mean, rolled out with the actions of ``[n, L]``.

    ``"rmse"`` is in standard deviations of each entry; ``"standing_still"`` is that of
    the first state.
    """
    key, action_key = model.in_keys
    unit = model.input_scale[: model.observation_dim]
    first = state = pieces[key][:, 0]
    found = []
    for step in range(pieces.batch_size[1] if len(pieces) else 0):
        mean, _ = model.predict(state, pieces[action_key][:, step])
        state = state + mean[model.elites].mean(0)[:, :-1]
        if step + 1 in horizons:
            row: dict[str, float] = {"steps": step + 1}
            for name, guess in (("rmse", state), ("standing_still", first)):
                error = (guess - pieces["next", key][:, step]) / unit
                row[name] = error.square().mean(-1).mean().sqrt().item()
            found.append(row)
    return found


def describe_dynamics(report: Mapping[str, Any]) -> str:
    """Return one line of text with the numbers of a report."""
    line = (
        "dynamics, {rows} held-out rows: NLL {nll:.2f}, R2 {r2_mean:.2f}, within 1 and "
        "2 sigma {within_1_sigma:.0%} and {within_2_sigma:.0%}, disagreement and error "
        "{disagreement_rank:.2f}"
    ).format(**report)
    if report.get("rollout"):
        errors = [f"{each['rmse']:.2f} ({each['steps']})" for each in report["rollout"]]
        line += f", error after steps {', '.join(errors)}"
    return line
