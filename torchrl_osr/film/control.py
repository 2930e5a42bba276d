"""The inverse dynamics model as a controller that follows a reference trajectory.

Figure 3 of "Recovering from Out-of-sample States via Inverse Dynamics in Offline
Reinforcement Learning", https://openreview.net/forum?id=4gLWjSaw4o, where the model
leads a knocked robot back to the trajectory of the behaviour policy. Nothing is learnt
here; the model gives the action that leads from the present state to a target.

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

TargetRule = Literal["time", "nearest"]
"""Choice of the target state, see :class:`InverseDynamicsController`."""


class InverseDynamicsController:
    r"""Drive agents along references by the inverse dynamics model.

    .. math::
        a_t = \text{mode of } I(a \mid s_t, s^{ref}), \quad
        s^{ref} = \begin{cases}
            s^{ref}_{t+1} & \text{"time"} \\
            s^{ref}_{k+1},\ k = \arg\min_i \lVert s_t - s^{ref}_i \rVert_2
            & \text{"nearest"}
        \end{cases}

    * ``"time"``: the reference's next state at the same time. After a delay the gait is
      out of phase: the target is then out of reach, and the pair of states unlike those
      that the model was trained on.
    * ``"nearest"``: the successor of the reference's nearest state, the last one left
      out. Any phase of the gait can be taken up again, and the pair is as close to the
      data as possible.

    The paper only says "we set the target state of IDM to the corresponding state in
    the expert trajectory". That reads as ``"time"``; ``"nearest"`` is ours.

    A controller counts its calls, so it is a policy for one evaluation in which every
    call has all ``E`` rows: ``EpisodeEvaluator(..., fixed_batch=True)``.

    Args:
        inverse_dynamics_network: a trained model of ``I(a | s, s')``, reads
            ``"observation"`` and ``("next", "observation")``.
        references: raw observations of one episode for each row, from the reset on,
            ``[T, S]`` each; they may differ in ``T``.

    Keyword Args:
        rule: for the target, see above. Default ``"time"``.
        observation_norm: how the training data were standardised
            (``standard_normal=True``); distances are in its unit. Default: not at all.

    Attributes:
        step: number of calls.

    Raises:
        ValueError: if ``rule`` is unknown, there is no reference, or one has no next
            state.

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
        rule: TargetRule = "time",
        observation_norm: ObservationNorm | None = None,
    ) -> None:
        check_choice("rule", rule, ("time", "nearest"))
        if not references:
            raise ValueError("references must have one trajectory for each row, got 0.")
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
        """Actions ``[E, A]`` at raw observations ``[E, S]``.

        Raises:
            ValueError: if there is not one row for each reference.
        """
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
        """Target of each row for the next call, standardised, ``[E, S]``.

        Args:
            observation: standardised, ``[E, S]``.
        """
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
