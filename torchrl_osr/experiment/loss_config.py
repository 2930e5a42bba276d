"""The typed schema of the losses' configuration.

``_target_`` names what Hydra's ``instantiate`` calls with the other entries.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from omegaconf import MISSING


@dataclass
class AdversaryConfig:
    """Keywords of ``Adversary``; its docstring has their meaning.

    Attributes:
        objective: action_diff or min_Q.
        method: sample or gradient.
        epsilon: half-width of the box, in the observations' units.
        num_samples: draws, or starts of the gradient steps.
        num_steps: gradient steps.
        step_size: of a gradient step, in units of epsilon.
    """

    _target_: str = "torchrl_osr.Adversary"
    objective: str = MISSING
    method: str = MISSING
    epsilon: float = MISSING
    num_samples: int = MISSING
    num_steps: int = MISSING
    step_size: float = MISSING


@dataclass
class CriticLossConfig:
    """Keywords that ``OSRLoss`` and ``OSRVLoss`` share.

    Attributes:
        recovery_weight: lambda of OSR, alpha of OSR-v.
        num_random: K, sampled actions of each kind.
        temperature: of the log-sum-exp.
        adversary: finds the perturbed states in the place of the noise.
        num_qvalue_nets: number of critics.
        loss_function: l2, l1 or smooth_l1.
        alpha_init: initial entropy temperature.
        fixed_alpha: keep it.
        deactivate_vmap: critics one by one, which is faster on a CPU.
    """

    recovery_weight: float = MISSING
    num_random: int = MISSING
    temperature: float = MISSING
    adversary: AdversaryConfig | None = None
    num_qvalue_nets: int = MISSING
    loss_function: str = MISSING
    alpha_init: float = MISSING
    fixed_alpha: bool = MISSING
    deactivate_vmap: bool = MISSING


@dataclass
class OSRLossConfig(CriticLossConfig):
    """Keywords of ``OSRLoss``; its docstring has their meaning.

    Attributes:
        recovery_direction: forward or reverse.
        action_reduction: sum or mean.
        recovery_target: inverse_dynamics or data.
        recovery_states: both, perturbed or clean.
        actor_states: both or clean.
        min_q_weight: alpha.
        importance_sample: weigh the drawn actions by their densities.
        clip_diff_min: lower bound of the conservative gap.
        clip_diff_max: upper bound of the conservative gap.
        max_q_backup: the target takes the best of num_random actions.
        deterministic_backup: leave the entropy out of the target.
        with_lagrange: learn a multiplier of the conservative term.
        lagrange_thresh: the gap that it tolerates.
        diversity_weight: EDAC's eta.
        chunk_size: states that go through plain critics at a time on a CPU, or null.
    """

    _target_: str = "torchrl_osr.OSRLoss"
    recovery_direction: str = MISSING
    action_reduction: str = MISSING
    recovery_target: str = MISSING
    recovery_states: str = MISSING
    actor_states: str = MISSING
    min_q_weight: float = MISSING
    importance_sample: bool = MISSING
    clip_diff_min: float = MISSING
    clip_diff_max: float = MISSING
    max_q_backup: bool = MISSING
    deterministic_backup: bool = MISSING
    with_lagrange: bool = MISSING
    lagrange_thresh: float = MISSING
    diversity_weight: float = MISSING
    chunk_size: int | None = MISSING


@dataclass
class OSRVLossConfig(CriticLossConfig):
    """Keywords of ``OSRVLoss``; its docstring has their meaning.

    Attributes:
        policy_values: mean or logsumexp.
    """

    _target_: str = "torchrl_osr.OSRVLoss"
    policy_values: str = MISSING


@dataclass
class TargetConfig:
    """A function or class to be called, by its full name."""

    _target_: str = MISSING


@dataclass
class InverseDynamicsLossConfig:
    """Keywords of ``InverseDynamicsLoss``; its docstring has their meaning.

    Attributes:
        states: both or clean.
        loss_function: nll or mse.
        latent_weight: of the latent's divergence, where the model has a latent.
    """

    states: str = MISSING
    loss_function: str = MISSING
    latent_weight: float = MISSING


@dataclass
class InverseDynamicsConfig:
    """Which inverse dynamics model, and how it is trained.

    Attributes:
        network: the function that builds it.
        loss: its loss.
        shuffle_next: train it with the next state of another row, an ablation.
    """

    network: TargetConfig = field(default_factory=TargetConfig)
    loss: InverseDynamicsLossConfig = field(default_factory=InverseDynamicsLossConfig)
    shuffle_next: bool = False
