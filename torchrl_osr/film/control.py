"""The inverse dynamics model as a controller that follows a reference trajectory.

Figure 3 of "Recovering from Out-of-sample States via Inverse Dynamics in Offline
Reinforcement Learning", https://openreview.net/forum?id=4gLWjSaw4o

Shapes: ``E`` episodes side by side, ``T`` states of a reference (each its own), ``S``
observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDict
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    set_interaction_type,
)
from torch import Tensor
from torchrl.envs import ObservationNorm

from torchrl_osr._checks import check_choice


class InverseDynamicsController:
    r"""Drive agents along references by the inverse dynamics model.

    .. math::
        a_t = \text{mode of } I(a \mid s_t, s^{ref}), \quad
        s^{ref} = \begin{cases}
            s^{ref}_{t+1} & \text{"time"} \\
            s^{ref}_{k+1},\ k = \arg\min_i \lVert s_t - s^{ref}_i \rVert_2
            & \text{"nearest"}
        \end{cases}

    ``"time"`` is how the paper reads: "the corresponding state in the expert
    trajectory". A push shifts the phase of the gait, and then that target is out of
    reach; ``"nearest"``, which is ours, takes up the gait in any phase.

    A controller counts its calls, so it is a policy for one evaluation in which every
    call has all ``E`` rows: ``EpisodeEvaluator(..., fixed_batch=True)``.

    Args:
        inverse_dynamics_network: a trained model of ``I(a | s, s')``.
        references: raw observations of one episode for each row, from the reset on,
            ``[T, S]`` each; they may differ in ``T``.

    Keyword Args:
        rule: for the target, see above. Default ``"time"``.
        observation_norm: how the training data were standardised
            (``standard_normal=True``); distances are in its unit. Default: not at all.

    Attributes:
        step: number of calls.

    Raises:
        ValueError: if ``rule`` is unknown, or a reference has no next state.

    Examples:
        >>> import torch
        >>> from torchrl_osr.film import InverseDynamicsController
        >>> from torchrl_osr.modules import tanh_gaussian_inverse_dynamics
        >>> model = tanh_gaussian_inverse_dynamics(4, 2, num_cells=[8])
        >>> controller = InverseDynamicsController(model, [torch.zeros(9, 4)])
        >>> controller(torch.ones(1, 4)).shape, controller.step
        (torch.Size([1, 2]), 1)
    """

    def __init__(
        self,
        inverse_dynamics_network: ProbabilisticTensorDictSequential,
        references: Sequence[Tensor],
        *,
        rule: Literal["time", "nearest"] = "time",
        observation_norm: ObservationNorm | None = None,
    ) -> None:
        check_choice("rule", rule, ("time", "nearest"))
        for row, reference in enumerate(references):
            if reference.ndim != 2 or len(reference) < 2:
                raise ValueError(
                    f"reference {row} has shape {tuple(reference.shape)}; expected "
                    "[T, S] with at least two states."
                )
        self._network, self._norm = inverse_dynamics_network, observation_norm
        self._references = [self._standard(each) for each in references]
        self.rule, self.step = rule, 0

    @torch.no_grad()
    def __call__(self, observation: Tensor) -> Tensor:
        """Actions ``[E, A]`` at raw observations ``[E, S]``, one for each reference."""
        if len(observation) != len(self._references):
            raise ValueError(
                f"{len(observation)} observations for {len(self._references)} "
                "references: every call needs all rows, fixed_batch=True."
            )
        present = self._standard(observation)
        target = self.targets(present)
        batch = TensorDict(
            {"observation": present, "next": {"observation": target}}, [len(present)]
        )
        # Latent variables at their mean, as the policy's losses use the model.
        with set_interaction_type(InteractionType.DETERMINISTIC):
            action: Tensor = self._network.get_dist(batch).deterministic_sample
        self.step += 1
        return action

    def targets(self, observation: Tensor) -> Tensor:
        """Targets ``[E, S]`` of the next call, standardised like ``observation``."""
        if self.rule == "time":
            # Past its end a reference stays at its last state.
            rows = [
                each[min(self.step + 1, len(each) - 1)] for each in self._references
            ]
        else:
            rows = [
                reference[int((reference[:-1] - row).square().sum(-1).argmin()) + 1]
                for reference, row in zip(self._references, observation, strict=True)
            ]
        return torch.stack(rows)

    def _standard(self, observation: Tensor) -> Tensor:
        if self._norm is None:
            return observation
        standard: Tensor = (observation - self._norm.loc) / self._norm.scale
        return standard
