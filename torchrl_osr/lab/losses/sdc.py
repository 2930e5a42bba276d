r"""SDC: actions that lead from perturbed states to where the data lead.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation, ``n`` samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torchrl.modules.distributions.utils import rsample_and_log_prob

from torchrl_osr import functional
from torchrl_osr._checks import check_positive, check_weight
from torchrl_osr._entries import entry
from torchrl_osr.lab.dynamics.conditional_vae import ConditionalVAE
from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble
from torchrl_osr.lab.losses.correction import maximum_mean_discrepancy
from torchrl_osr.objectives.base import Terms
from torchrl_osr.objectives.mixed_states import States
from torchrl_osr.objectives.osr import OSRLoss
from torchrl_osr.objectives.step import Step


class SDCLoss(OSRLoss):
    r"""State Deviation Correction (SDC) on CQL(H), in our reading.

    .. math::
        \max_\pi\, \mathbb E_D\, Q(s, \pi(s)) \quad \text{s.t.} \quad
        \mathbb E_D\, MMD^2\big( M(\cdot \mid \hat s, \pi(\cdot \mid \hat s)),\,
        U(\cdot \mid s) \big) \le \eta

    with perturbed states :math:`\hat s`, a frozen model :math:`M` of the dynamics and a
    frozen model :math:`U` of the data's next states. The constraint has a Lagrange
    multiplier, learned by dual ascent: ``loss_deviation`` moves the policy,
    ``loss_multiplier`` the multiplier. "State Deviation Correction for Offline
    Reinforcement Learning" (Zhang et al., AAAI 2022,
    https://doi.org/10.1609/aaai.v36i8.20886).

    **This is our reading**: the authors have published no code and no settings that we
    could find. Kernel, its width, :math:`\eta` and the number of samples are ours.

    Args:
        actor_network, qvalue_network: as in :class:`~torchrl_osr.OSRLoss`.
        dynamics_network: :math:`M`; trained before, or given by :meth:`load_network`.
        transition_network: :math:`U`, likewise.

    Keyword Args:
        num_samples: ``n`` of :math:`M` and of :math:`U`. Default 4.
        kernel_width: of
            :func:`~torchrl_osr.lab.losses.correction.maximum_mean_discrepancy`, in
            units of the observation. Default 1.
        threshold: :math:`\eta`. Default 0.05.
        recovery_weight: OSR's term is there for ``recovery_target="data"`` alone.
            Default 0: none.
        actor_states: where the policy seeks values. Default ``"clean"``.
        options: of :class:`~torchrl_osr.OSRLoss`.

    Raises:
        ValueError: if an option is out of its range; in the call, if the batch is
            empty.
        KeyError: in the call, if the batch has no perturbed states.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr import StatePerturbation
        >>> from torchrl_osr.lab.losses import SDCLoss
        >>> from torchrl_osr.lab.dynamics import ConditionalVAE, DynamicsEnsemble
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> loss = SDCLoss(
        ...     tanh_gaussian_actor(11, 3), critic_ensemble(11, 3),
        ...     DynamicsEnsemble(11, 3),
        ...     ConditionalVAE(11, 11, condition_key="observation", change=True,
        ...                    target_key=("next", "observation")))
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3),
        ...     "next": {"observation": torch.randn(4, 11), "reward": torch.ones(4, 1),
        ...              "done": no, "terminated": no}}, [4])
        >>> losses = loss(StatePerturbation(std=3e-3)(batch))
        >>> [key for key in losses.keys() if key.startswith("loss_")][-2:]
        ['loss_deviation', 'loss_multiplier']
    """

    transition_network: ConditionalVAE
    dynamics_network: DynamicsEnsemble
    dynamics_network_params: TensorDictParams
    target_dynamics_network_params: TensorDictParams
    transition_network_params: TensorDictParams
    target_transition_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        dynamics_network: DynamicsEnsemble,
        transition_network: ConditionalVAE,
        *,
        num_samples: int = 4,
        kernel_width: float = 1.0,
        threshold: float = 0.05,
        recovery_weight: float = 0.0,
        actor_states: States = "clean",
        **options: Any,
    ) -> None:
        check_positive("num_samples", num_samples, minimum=1)
        check_positive("kernel_width", kernel_width)
        check_weight("threshold", threshold)
        super().__init__(
            actor_network,
            qvalue_network,
            recovery_weight=recovery_weight,
            actor_states=actor_states,
            **options,
        )
        self._hold_frozen("dynamics_network", dynamics_network)
        self._hold_frozen("transition_network", transition_network)
        self.num_samples, self.kernel_width = num_samples, kernel_width
        self.threshold = threshold
        self.log_multiplier = nn.Parameter(torch.zeros(()))

    @property
    def reads_perturbed(self) -> bool:
        """Whether the batch must hold perturbed states: always."""
        return True

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        losses, metrics = super()._output_keys()
        return (
            [*losses, "loss_deviation", "loss_multiplier"],
            [*metrics, "deviation", "multiplier"],
        )

    def _terms_of(self, step: Step) -> Terms:
        losses, metrics = super()._terms_of(step)
        deviation = self.deviation(step)
        terms = functional.lagrange_terms(
            deviation, self.log_multiplier, self.threshold
        )
        for name, term in zip(("deviation", "multiplier"), terms, strict=True):
            losses[f"loss_{name}"] = self._reduce(term, step.tensordict, step.of_data)
        metrics["deviation"] = self._mean(deviation, step.tensordict, step.of_data)
        metrics["multiplier"] = self.log_multiplier.detach().exp()
        return losses, metrics

    def deviation(self, step: Step) -> Tensor:
        """Discrepancy of where the policy and where the data lead, ``[B]``."""
        model, aims = self.dynamics_network, self.transition_network
        number = (self.num_samples,)
        action, _ = rsample_and_log_prob(step.policy("perturbed"), number)
        action = action.squeeze(1)  # of the one set of states
        batch = *number, *step.tensordict.batch_size, -1
        clean = entry(step.states[0], aims.in_keys[0]).expand(batch)
        perturbed = entry(step.states[2], model.in_keys[0]).expand(batch)
        with self.dynamics_network_params.to_module(model, preserve_module_state=False):
            change = model.sample(model.predict(perturbed, action))[..., :-1]
        held = self.transition_network_params
        with torch.no_grad(), held.to_module(aims, preserve_module_state=False):
            aim = aims.sample(clean)
        return maximum_mean_discrepancy(perturbed + change, aim, self.kernel_width)
