"""Evaluation of trained policies: episodes, statistics, disturbances and figures.

* :class:`EpisodeEvaluator` plays complete episodes; :func:`summarize` has their scores.
* :func:`evaluate_paired` plays them with and without a :class:`Disturbance`;
  :func:`summarize_disturbances` has the score lost, survival and time to recovery.
* :class:`DataDistance` measures how far a state is from the data.
* :func:`inverse_dynamics_report` judges an inverse dynamics model.
"""

from torchrl_osr.lab.evaluation.data_distance import DataDistance
from torchrl_osr.lab.evaluation.episodes import (
    EpisodeEvaluator,
    EpisodeResults,
    Policy,
    Watch,
    Wrap,
    deterministic_policy,
    measure_of,
    summarize,
)
from torchrl_osr.lab.evaluation.inverse_dynamics_fit import (
    describe_inverse_dynamics,
    inverse_dynamics_report,
)
from torchrl_osr.lab.evaluation.recovery import (
    STEPS_AFTER,
    STEPS_BEFORE,
    Recorder,
    Recovery,
    Trajectory,
    disturbed_at,
    measure_recovery,
)
from torchrl_osr.lab.evaluation.robustness import (
    Disturbance,
    DisturbanceResults,
    PairedResults,
    check_disturbances,
    decrease_interval,
    evaluate_paired,
    evaluation_json,
    impossible_disturbances,
    robustness_table,
    summarize_disturbances,
)
from torchrl_osr.lab.evaluation.robustness_figure import (
    distance_curves,
    robustness_figure,
)
from torchrl_osr.lab.evaluation.statistics import (
    NUM_RESAMPLES,
    interquartile_mean,
    mean_interval,
    nested_resamples,
    percentile_interval,
    performance_profile,
    stratified_resamples,
    wilson_interval,
)
from torchrl_osr.lab.evaluation.training_summary import (
    NUM_RECENT,
    learning_curve,
    read_scalars,
    score_table,
)

__all__ = [
    "NUM_RECENT",
    "NUM_RESAMPLES",
    "STEPS_AFTER",
    "STEPS_BEFORE",
    "DataDistance",
    "Disturbance",
    "DisturbanceResults",
    "EpisodeEvaluator",
    "EpisodeResults",
    "PairedResults",
    "Policy",
    "Recorder",
    "Recovery",
    "Trajectory",
    "Watch",
    "Wrap",
    "check_disturbances",
    "decrease_interval",
    "describe_inverse_dynamics",
    "deterministic_policy",
    "distance_curves",
    "disturbed_at",
    "evaluate_paired",
    "evaluation_json",
    "impossible_disturbances",
    "interquartile_mean",
    "inverse_dynamics_report",
    "learning_curve",
    "mean_interval",
    "measure_of",
    "measure_recovery",
    "nested_resamples",
    "percentile_interval",
    "performance_profile",
    "read_scalars",
    "robustness_figure",
    "robustness_table",
    "score_table",
    "stratified_resamples",
    "summarize",
    "summarize_disturbances",
    "wilson_interval",
]
