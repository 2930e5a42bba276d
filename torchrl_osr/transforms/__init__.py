"""Transforms for replay buffers and environments."""

from torchrl_osr.transforms.state_perturbation import StatePerturbation

__all__ = ["StatePerturbation"]
