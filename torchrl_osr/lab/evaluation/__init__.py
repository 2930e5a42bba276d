"""Evaluation of trained policies: episodes, disturbances, statistics and figures."""

from torchrl_osr.lab.evaluation.episodes import (
    EpisodeEvaluator,
    UnitPolicy,
    deterministic_policy,
    measure_of,
    summarize,
)
from torchrl_osr.lab.evaluation.grey_box import fitted_grey_box, rolled_out_values
from torchrl_osr.lab.evaluation.inverse_dynamics_fit import inverse_dynamics_report
from torchrl_osr.lab.evaluation.offline import fitted_values
from torchrl_osr.lab.evaluation.recoverable import load_recoverable_states, recovers
from torchrl_osr.lab.evaluation.recovery import DataDistance
from torchrl_osr.lab.evaluation.robustness import Disturbance, evaluate_paired

__all__ = [
    "DataDistance",
    "Disturbance",
    "EpisodeEvaluator",
    "UnitPolicy",
    "deterministic_policy",
    "evaluate_paired",
    "fitted_grey_box",
    "fitted_values",
    "inverse_dynamics_report",
    "load_recoverable_states",
    "measure_of",
    "recovers",
    "rolled_out_values",
    "summarize",
]
