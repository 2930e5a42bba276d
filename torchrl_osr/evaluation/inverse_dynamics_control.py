"""The inverse dynamics model as a controller: back to a trajectory, state by state.

Figure 3 of "Recovering from Out-of-sample States via Inverse Dynamics in Offline
Reinforcement Learning", https://openreview.net/forum?id=4gLWjSaw4o: does the model lead
a robot that was knocked over back to where the behaviour policy would be? Nothing is
learnt here; the model is asked which action leads from the present state to a target.

Shapes: ``E`` episodes side by side, ``T`` states of a reference (each its own), ``S``
observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
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
from torchrl.objectives import LossModule

from torchrl_osr._checks import check_choice

TargetRule = Literal["time", "nearest"]
"""Which state of the reference is next, see :class:`InverseDynamicsController`."""


def time_target(reference: Tensor, step: int) -> Tensor:
    """Return the reference's state one step after ``step``, ``[S]``.

    Past its end a reference stays at its last state.

    Args:
        reference: the states of an episode from its reset on, ``[T, S]``.
        step: steps of the agent until now.
    """
    return reference[min(step + 1, len(reference) - 1)]


def nearest_target(reference: Tensor, observation: Tensor) -> Tensor:
    """Return the successor of the reference's state that is nearest, ``[S]``.

    The first of several that are equally near. The last state has no successor, and
    is nobody's nearest.

    Args:
        reference: the states of an episode from its reset on, ``[T, S]``.
        observation: the present state in the same unit, ``[S]``.
    """
    distances = (reference[:-1] - observation).square().sum(-1)
    return reference[int(distances.argmin()) + 1]


class InverseDynamicsController:
    r"""Drive agents along references by the inverse dynamics model.

    .. math::
        a_t = \text{mode of } I(a \mid s_t, s^{ref}), \quad
        s^{ref} = \begin{cases}
            s^{ref}_{t+1} & \text{"time"} \\
            s^{ref}_{k+1},\ k = \arg\min_i \lVert s_t - s^{ref}_i \rVert_2
            & \text{"nearest"}
        \end{cases}

    * ``"time"``: the reference's next state at the same time. It asks a robot that was
      held up to be at once where it would have been: out of reach, if the gait is out
      of phase, and then no pair of states that the model has seen.
    * ``"nearest"``: what came after the reference's nearest state. Any phase of the
      gait can be taken up again, and the pair is the nearest to those of the data.

    The paper says "we set the target state of IDM to the corresponding state in the
    expert trajectory" and no more. That reads as ``"time"``; ``"nearest"`` is ours.

    A controller counts its calls, and is a
    :data:`~torchrl_osr.evaluation.episodes.Policy` for one evaluation: every call has
    all ``E`` rows, as
    ``EpisodeEvaluator(..., fixed_batch=True)`` sees to.

    Args:
        inverse_dynamics_network: a trained model of ``I(a | s, s')``, reads
            ``"observation"`` and ``("next", "observation")``.
        references: raw observations of one episode for each row, from the reset on,
            ``[T, S]`` each; they may differ in ``T``.

    Keyword Args:
        rule: which target, see above. Default ``"time"``.
        observation_norm: how the training data were standardised
            (``standard_normal=True``); distances are in its unit. Default: not at all.

    Attributes:
        step: calls until now, the present time.

    Raises:
        ValueError: if ``rule`` is unknown, there is no reference, or one has no next
            state.

    Examples:
        >>> import torch
        >>> from torchrl_osr.evaluation.inverse_dynamics_control import (
        ...     InverseDynamicsController,
        ... )
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
        """Return actions ``[E, A]`` for raw observations ``[E, S]`` of the next step.

        Raises:
            ValueError: if there is not one row for each reference.
        """
        if len(observation) != len(self._references):
            raise ValueError(
                f"{len(observation)} observations for {len(self._references)} "
                "references: every call needs all rows, fixed_batch=True."
            )
        present = self._standard(observation)
        following = self.targets(present)
        batch = TensorDict(
            {"observation": present, "next": {"observation": following}}, [len(present)]
        )
        # A latent variable at its mean: as the policy's losses read the model.
        with set_interaction_type(InteractionType.DETERMINISTIC):
            action: Tensor = self._network.get_dist(batch).deterministic_sample
        self.step += 1
        return action

    def targets(self, observation: Tensor) -> Tensor:
        """Return the target of each row for the next call, ``[E, S]``.

        Args:
            observation: standardised, ``[E, S]``.
        """
        if self.rule == "time":
            rows = [time_target(each, self.step) for each in self._references]
        else:
            pairs = zip(self._references, observation, strict=True)
            rows = [nearest_target(reference, row) for reference, row in pairs]
        return torch.stack(rows)

    def _standard(self, observation: Tensor) -> Tensor:
        if self._norm is None:
            return observation
        standard: Tensor = (observation - self._norm.loc) / self._norm.scale
        return standard


def frozen_model(loss: LossModule) -> ProbabilisticTensorDictSequential:
    """Return the inverse dynamics model that a loss keeps frozen, with its numbers.

    It shares them with the loss.

    Args:
        loss: of a trained policy, as
            :func:`~torchrl_osr.experiment.trained_run.load_trained` returns it.

    Raises:
        ValueError: if the loss has none, as CQL and SAC-N have not.
    """
    params = getattr(loss, "inverse_dynamics_network_params", None)
    if params is None:
        raise ValueError(
            f"this {type(loss).__name__} holds no inverse dynamics model, as losses "
            "with recovery_weight=0 do not; take a run with loss=osr."
        )
    model: ProbabilisticTensorDictSequential = deepcopy(loss.inverse_dynamics_network)
    params.to_module(model, preserve_module_state=False)
    return model
