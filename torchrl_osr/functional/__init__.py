"""The paper's equations as pure tensor functions.

"Recovering from Out-of-sample States via Inverse Dynamics in Offline Reinforcement
Learning" (Jiang et al., NeurIPS 2023), https://openreview.net/forum?id=4gLWjSaw4o

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``M``
sampled actions of one state, ``n`` discrete actions. Every function returns one number
a sample; the loss modules weigh and reduce. Where the printed paper and these
files differ, the line says so and why.

Symbols: ``pi`` policy, ``I`` inverse dynamics model, ``s`` clean state, ``s^``
perturbed state, ``s~`` a state of the mixed data set (clean and perturbed).
"""

from torchrl_osr.functional.critics import (
    conservative_gap,
    gradient_diversity,
    lagrange_terms,
    soft_maximum,
    uncertainty_penalty,
    value_constraint,
    value_smoothness,
)
from torchrl_osr.functional.divergences import (
    categorical_kl,
    deterministic_recovery,
    gaussian_kl,
    jeffreys_divergence,
    state_recovery,
)
from torchrl_osr.functional.policy import (
    action_distance,
    bootstrap_value,
    cloning_error,
    discrete_policy_value,
    rebrac_objective,
    soft_policy_value,
    td3_bc_objective,
    temperature_objective,
)

__all__ = [
    "action_distance",
    "bootstrap_value",
    "categorical_kl",
    "cloning_error",
    "conservative_gap",
    "deterministic_recovery",
    "discrete_policy_value",
    "gaussian_kl",
    "gradient_diversity",
    "jeffreys_divergence",
    "lagrange_terms",
    "rebrac_objective",
    "soft_maximum",
    "soft_policy_value",
    "state_recovery",
    "td3_bc_objective",
    "temperature_objective",
    "uncertainty_penalty",
    "value_constraint",
    "value_smoothness",
]
