r"""The state-recovery term by itself, to be added to any loss that trains an actor.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``D`` sets of states
(2 for D_tot, 1 for either half).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, cast

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from torch import Tensor
from torchrl.modules import IndependentNormal, TanhNormal
from torchrl.modules.distributions.utils import safeatanh_noeps

from torchrl_osr import functional
from torchrl_osr._checks import check_literals, check_weight
from torchrl_osr._entries import column, entry, nested, state_keys
from torchrl_osr.objectives.base import BaseLoss, Terms
from torchrl_osr.objectives.cloning import (
    cloning_distance,
    is_deterministic,
    policy_at,
)
from torchrl_osr.objectives.distributions import (
    action_bounds,
    bounds_of,
    check_num_actions,
    check_same_bounds,
    head_of,
)
from torchrl_osr.objectives.mixed_states import (
    States,
    first_step,
    of_data,
    transitions,
)
from torchrl_osr.objectives.step import frozen_distribution


class StateRecoveryLoss(BaseLoss):
    r"""The state-recovery term :math:`L_{sr}`, for the actor of another loss.

    .. math::
        \lambda\, \mathbb E_{\tilde s, s' \sim D_{tot}}
            KL(I(a \mid \tilde s, s') \,\|\, \pi(a \mid \tilde s))

    Give it the actor of an IQLLoss, SACLoss, TD3BCLoss or another TorchRL loss and add
    ``"loss_recovery"`` to that loss's entries. Its parameters are the very tensors of
    that loss, whose optimizer is enough; its gradient reaches nothing but the actor.
    Rows that are ``done`` do not count. "Recovering from Out-of-sample States via
    Inverse Dynamics in Offline Reinforcement Learning", equations (11) and (12),
    https://openreview.net/forum?id=4gLWjSaw4o.

    A deterministic actor (a :class:`~torchrl.modules.TanhDelta`, or a module that
    writes the action) is pulled to the model's mean, by
    :func:`~torchrl_osr.functional.deterministic_recovery`: an addition, not in the
    paper. So is the mean of an :class:`~torchrl.modules.IndependentNormal`. A module
    should squash its action itself, with a tanh at its end: beyond the bounds the
    gradient is finite, but huge. Where that tanh has saturated there is no gradient;
    with a ``TanhDelta`` there is.

    With ``recovery_target="data"`` it is noisy behaviour cloning, which needs no model:
    :math:`-\log\pi(a \mid \tilde s)`, and the squared distance
    :math:`\|\pi(\tilde s) - a\|^2` of a deterministic actor.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.TanhNormal` or an
            :class:`~torchrl.modules.IndependentNormal`, or deterministic.
        inverse_dynamics_network: a *trained* model of ``I(a | s, s')`` with the
            actor's bounds (see :class:`~torchrl_osr.InverseDynamicsLoss`). Frozen here:
            in the state dict, moved by ``.to()``, without gradient. Needed unless
            ``recovery_target="data"``, which leaves it out.

    Keyword Args:
        recovery_weight: :math:`\lambda`. Default 0.5. May be assigned later.
        recovery_target: what the policy is pulled to: ``"inverse_dynamics"`` (default)
            or ``"data"``, the data's action.
        recovery_direction: ``"forward"`` is the paper's ``KL(I || pi)``, ``"reverse"``
            the ``KL(pi || I)`` of the authors' code. ``None`` (default) is forward for
            a tanh-Gaussian actor and reverse for others, which have no forward one.
        action_reduction: ``"sum"`` (default) over action dimensions, or ``"mean"``.
        recovery_states: ``"both"`` (default) for D_tot, ``"perturbed"``, or
            ``"clean"``, which needs no perturbed entry.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``, without the metric.
        use_prioritized_weights: weigh rows by ``"priority_weight"``; ``"auto"``
            (default) does when the entry is there.

    Raises:
        TypeError: if a distribution is another one.
        ValueError: if bounds differ, the weight is negative, an option is unknown, the
            model is missing, or an actor has no forward direction; in the call, if the
            batch is empty or holds several steps a row.
        KeyError: in the call, if the batch has no perturbed entry.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr import StatePerturbation, StateRecoveryLoss
        >>> from torchrl_osr.modules import (
        ...     tanh_gaussian_actor, tanh_gaussian_inverse_dynamics)
        >>> actor = tanh_gaussian_actor(11, 3)  # the one given to IQLLoss, for instance
        >>> recovery = StateRecoveryLoss(actor, tanh_gaussian_inverse_dynamics(11, 3))
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11),
        ...     "next": {"observation": torch.randn(4, 11),
        ...              "done": torch.zeros(4, 1, dtype=torch.bool)}}, [4])
        >>> sorted(recovery(StatePerturbation(std=1e-3)(batch)).keys())
        ['loss_recovery', 'recovery_kl']
        >>> set(recovery.parameters()) == set(actor.parameters())
        True
    """

    @dataclass
    class _AcceptedKeys:
        """The tensordict entries that :meth:`set_keys` can rename.

        Attributes:
            action: the data's action, and what an actor writes. Defaults to
                ``"action"``.
            done: end of a trajectory, below ``"next"``. Defaults to ``"done"``.
            priority_weight: importance weight of a row. Defaults to
                ``"priority_weight"``.
            perturbed: where the perturbed states are. Defaults to ``"perturbed"``.
        """

        action: NestedKey = "action"
        done: NestedKey = "done"
        priority_weight: NestedKey = "priority_weight"
        perturbed: NestedKey = "perturbed"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    _schedulable_buffers = frozenset({"recovery_weight"})

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None = None,
        *,
        recovery_weight: float = 0.5,
        recovery_target: Literal["inverse_dynamics", "data"] = "inverse_dynamics",
        recovery_direction: Literal["forward", "reverse"] | None = None,
        recovery_states: States = "both",
        action_reduction: Literal["sum", "mean"] = "sum",
        reduction: Literal["none", "mean", "sum"] | None = None,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
    ) -> None:
        check_literals(StateRecoveryLoss.__init__, locals())
        check_weight("recovery_weight", recovery_weight)
        super().__init__(
            reduction=reduction,
            use_prioritized_weights=use_prioritized_weights,
            scalar_output_mode="exclude",
        )
        self.recovery_target = recovery_target
        self.recovery_states = recovery_states
        self.action_reduction = action_reduction
        self._note_head(actor_network, recovery_direction)
        if recovery_target == "inverse_dynamics":
            self._check_and_hold(actor_network, inverse_dynamics_network)
        self.convert_to_functional(actor_network, "actor_network")
        self.register_coeff_buffer("recovery_weight", float(recovery_weight))

    def _note_head(self, network: TensorDictModuleBase, direction: str | None) -> None:
        """Note what the actor ends in, and the direction of the divergence."""
        head, _ = head_of(network)
        self.is_normal = head is IndependentNormal
        self.is_deterministic = is_deterministic(network)
        self.has_distribution = head is not None
        by_mean = self.is_deterministic or self.is_normal
        self.recovery_direction: Any = direction or (
            "reverse" if by_mean else "forward"
        )
        if by_mean and self.recovery_direction == "forward":
            raise ValueError(
                "actor_network is deterministic, or a Gaussian without a tanh: the "
                "divergence in the forward direction is infinite, or has no closed "
                "form. Pass recovery_direction='reverse', or none: it pulls the action "
                "to the mean of the inverse dynamics model."
            )
        if not by_mean:
            action_bounds(network, "actor_network")

    def _check_and_hold(
        self,
        network: TensorDictModuleBase,
        model: ProbabilisticTensorDictSequential | None,
    ) -> None:
        """Hold the model; raise unless it goes with the actor."""
        if model is None:
            raise ValueError(
                "recovery_target='inverse_dynamics' needs an inverse_dynamics_network; "
                "pass one, or recovery_target='data' for noisy behaviour cloning."
            )
        low, high = bounds = action_bounds(model, "inverse_dynamics_network")
        self.register_buffer("action_low", low, persistent=False)
        self.register_buffer("action_high", high, persistent=False)
        if not (self.is_deterministic or self.is_normal):
            check_same_bounds(action_bounds(network, "actor_network"), bounds)
        elif self.has_distribution and not self.is_normal:
            check_same_bounds(bounds_of(head_of(network)[1]), bounds)
        self._hold_inverse_dynamics(model)

    def _input_keys(self) -> list[NestedKey]:
        states = state_keys(self.actor_network.in_keys)
        network_keys = [self.tensor_keys.action]
        if self.recovery_target == "inverse_dynamics":
            network_keys = self.inverse_dynamics_network.in_keys
        keys = [*states, *network_keys, nested("next", self.tensor_keys.done)]
        if self.recovery_states != "clean":
            states += state_keys(network_keys, self.tensor_keys.action)
            keys += [nested(self.tensor_keys.perturbed, key) for key in states]
        return keys

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        return ["loss_recovery"], [self._metric]

    @property
    def _metric(self) -> str:
        if self.recovery_target == "inverse_dynamics":
            return "recovery_kl"
        return "recovery_error" if self.is_deterministic else "recovery_nll"

    def _terms(self, tensordict: TensorDictBase) -> Terms:
        tensordict = first_step(tensordict)
        done = column(tensordict, nested("next", self.tensor_keys.done)).bool()
        states = self.recovery_states
        mixed = transitions(
            tensordict,
            state_keys(self.actor_network.in_keys),
            done=done,
            perturbed=self.tensor_keys.perturbed,
            states=states,
        )
        if self.recovery_target == "data":
            action = entry(tensordict, self.tensor_keys.action)
            pi = self._policy(mixed)
            divergence = cloning_distance(pi, action, self.tensor_keys.action).mean(0)
            if self.action_reduction == "mean":
                divergence = divergence / action.shape[-1]
        else:
            model: TanhNormal = frozen_distribution(
                self, tensordict, done=done, states=states
            )
            divergence = self._divergence(mixed, model).mean(0)
        valid, data = ~done, of_data(tensordict)
        if data is not None:
            valid = valid & data
        loss = self.recovery_weight * self._reduce(divergence, tensordict, valid)
        mean = self._mean(divergence, tensordict, valid)
        return {"loss_recovery": loss}, {self._metric: mean}

    def _divergence(self, states: TensorDictBase, model: TanhNormal) -> Tensor:
        """The recovery term (11) at ``states``, ``[D, B]``."""
        pi = self._policy(states)
        if not self.has_distribution:
            loc = self._pre_tanh(pi)
        elif self.is_normal:
            loc = self._pre_tanh(pi.mean)
        else:
            # Not TanhDelta's action, which may have saturated.
            loc = pi.base_dist.param if self.is_deterministic else pi.loc
        sizes = model.loc.shape[-1], loc.shape[-1]
        check_num_actions("inverse_dynamics_network", *sizes)
        if self.is_deterministic or self.is_normal:
            return functional.deterministic_recovery(
                loc, model.loc, model.scale, action_reduction=self.action_reduction
            )
        return functional.state_recovery(
            loc,
            pi.scale,
            model.loc,
            model.scale,
            direction=self.recovery_direction,
            action_reduction=self.action_reduction,
        )

    def _policy(self, states: TensorDictBase) -> Any:
        """The policy's distribution at ``states``, or the action that it writes."""
        params, key = self.actor_network_params, self.tensor_keys.action
        return policy_at(self.actor_network, params, states, key)

    def _pre_tanh(self, action: Tensor) -> Tensor:
        """An action before the tanh, ``[D, B, A]``."""
        width = self.action_high - self.action_low
        squashed = 2 * (action - self.action_low) / width - 1
        # Clamped a little inside the bounds, where the slope is finite.
        return cast(Tensor, safeatanh_noeps(squashed))
