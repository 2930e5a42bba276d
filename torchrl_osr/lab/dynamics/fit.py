"""Accuracy and calibration of a dynamics model, one step and several steps ahead.

Shapes: ``N`` rows, ``S`` observation, ``E`` networks, ``D = S + 1`` predicted entries,
``L`` rows of a piece of a trajectory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble, has_next_state
from torchrl_osr.lab.dynamics.equations import gaussian_error

HORIZONS = (1, 2, 5, 10, 20)
"""Steps after which a roll-out is compared with what happened."""


@torch.no_grad()
def dynamics_report(
    model: DynamicsEnsemble,
    held_out: TensorDictBase,
    pieces: TensorDictBase | None = None,
) -> dict[str, Any]:
    """How well an ensemble's elites predict held-out rows, and know their errors.

    Args:
        model: whose elites are judged.
        held_out: transitions ``[N]``.
        pieces: see :func:`rollout_errors`. Default: none.

    Returns:
        ``"nll"``, mean negative log-likelihood of the elites in nats, summed over the
        entries; ``"mse"``, mean squared error of standardised targets over *all*
        networks, a share of the targets' variance; ``"r2"``, share of each entry's
        variance that the mean of the elites explains, ``D`` numbers, the last of the
        reward, and their mean ``"r2_mean"``; ``"within_1_sigma"`` and
        ``"within_2_sigma"``, shares of errors of the elites that are smaller than one
        and two of their standard deviations (0.683 and 0.954 are calibrated);
        ``"disagreement_rank"``, Spearman's correlation of the elites' disagreement with
        the error of their mean; ``"largest_disagreement"``; ``"rows"``. With pieces
        also ``"rollout"``.

    Raises:
        ValueError: if no row has a next state.
    """
    rows = held_out[has_next_state(held_out, model.in_keys[0])]
    if not len(rows):
        raise ValueError("No held-out row has a next state.")
    _, targets = model.inputs_and_targets(rows)
    mean, scale = model.predict(*(rows[key] for key in model.in_keys))
    unit = model.target_scale
    mse = ((mean - targets) / unit).square().mean().item()
    apart = model.disagreement(mean)
    mean, scale = mean[model.elites], scale[model.elites]
    deviation = (mean - targets).abs() / scale
    wrong = mean.mean(0) - targets
    r2 = 1 - wrong.square().sum(0) / (targets - targets.mean(0)).square().sum(0)
    twice_nll = gaussian_error(mean, 2 * scale.log(), targets) + math.log(2 * math.pi)
    report = {
        "nll": targets.shape[-1] * twice_nll.mean().item() / 2,
        "mse": mse,
        "r2_mean": r2.mean().item(),
        "r2": r2.tolist(),
        "within_1_sigma": (deviation < 1).float().mean().item(),
        "within_2_sigma": (deviation < 2).float().mean().item(),
        "disagreement_rank": _rank_correlation(apart, (wrong / unit).norm(dim=-1)),
        "largest_disagreement": apart.max().item(),
        "rows": len(rows),
    }
    if pieces is not None:
        report["rollout"] = rollout_errors(model, pieces)
    return report


@torch.no_grad()
def rollout_errors(
    model: DynamicsEnsemble,
    pieces: TensorDictBase,
    horizons: Sequence[int] = HORIZONS,
) -> list[dict[str, float]]:
    """Errors of the mean of the elites, rolled out with the recorded actions.

    Args:
        model: of the dynamics.
        pieces: consecutive transitions ``[N, L]``, see
            :func:`~torchrl_osr.lab.data.consecutive_rows`.
        horizons: numbers of steps; those above ``L`` are left out.

    Returns:
        For each horizon ``"steps"``, ``"rmse"`` over rows and entries, in standard
        deviations of each entry in the model's data, ``"median"`` of the rows' own such
        errors, ``"standing_still"``, what the ``"rmse"`` of the first state would be,
        and ``"pieces"``, their number. An empty list without pieces.
    """
    number, length = pieces.batch_size
    if not number:
        return []
    key, action_key = model.in_keys
    unit = model.input_scale[: model.observation_dim]
    first = state = pieces[key][:, 0]
    found = []
    for step in range(length):
        mean, _ = model.predict(state, pieces[action_key][:, step])
        state = state + mean[model.elites].mean(0)[:, :-1]
        if step + 1 not in horizons:
            continue
        truth = pieces["next", key][:, step]
        errors = [
            ((guess - truth) / unit).square().mean(-1) for guess in (state, first)
        ]
        rolled, still = (each.mean().sqrt().item() for each in errors)
        found.append(
            {
                "steps": step + 1,
                "rmse": rolled,
                "median": errors[0].sqrt().median().item(),
                "standing_still": still,
                "pieces": number,
            }
        )
    return found


def describe_dynamics(report: Mapping[str, Any]) -> str:
    """One line of text with the numbers of a report; ``None`` is a dash."""
    rank, r2 = (
        "-" if report[key] is None else f"{report[key]:.2f}"
        for key in ("disagreement_rank", "r2_mean")
    )
    line = (
        f"dynamics, {report['rows']} held-out rows: NLL {report['nll']:.2f}, "
        f"R2 {r2}, within 1 and 2 sigma {100 * report['within_1_sigma']:.0f} and "
        f"{100 * report['within_2_sigma']:.0f} %, disagreement and error {rank}"
    )
    if report.get("rollout"):
        errors = [f"{each['rmse']:.2f} ({each['steps']})" for each in report["rollout"]]
        line += f", error after steps {', '.join(errors)}"
    return line


def _rank_correlation(first: Tensor, second: Tensor) -> float:
    """Spearman's correlation of two columns ``[N]`` without equal numbers."""
    ranks = torch.stack([each.argsort().argsort().double() for each in (first, second)])
    return torch.corrcoef(ranks)[0, 1].item()
