r"""The state-recovery term by itself, to be added to any loss that trains an actor.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``D`` sets of states
(2 for D_tot, 1 for either half).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    dispatch,
)
from torch import Tensor
from torchrl.modules import TanhDelta, TanhNormal
from torchrl.modules.distributions.utils import safeatanh_noeps

from torchrl_osr import functional
from torchrl_osr._checks import check_literals, check_weight
from torchrl_osr._entries import column, nested, state_keys
from torchrl_osr.objectives.base import BaseLoss
from torchrl_osr.objectives.distributions import (
    action_bounds,
    check_num_actions,
    check_same_bounds,
    check_same_size,
)
from torchrl_osr.objectives.mixed_states import States, transitions
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
    paper. A module should squash its action itself, with a tanh at its end: beyond the
    bounds the gradient is finite, but huge. Where that tanh has saturated there is no
    gradient; with a ``TanhDelta`` there is.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.TanhNormal`, or deterministic.
        inverse_dynamics_network: a *trained* model of ``I(a | s, s')`` with the
            actor's bounds (see :class:`~torchrl_osr.InverseDynamicsLoss`). Frozen here:
            in the state dict, moved by ``.to()``, without gradient.

    Keyword Args:
        recovery_weight: :math:`\lambda`. Default 0.5. May be assigned later.
        recovery_direction: ``"forward"`` (default) is the paper's ``KL(I || pi)``,
            ``"reverse"`` the ``KL(pi || I)`` of the authors' code, which a
            deterministic actor needs.
        action_reduction: ``"sum"`` (default) over action dimensions, or ``"mean"``.
        recovery_states: ``"both"`` (default) for D_tot, ``"perturbed"``, or
            ``"clean"``, which needs no perturbed entry.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``, without the metric.
        use_prioritized_weights: weigh rows by ``"priority_weight"``; ``"auto"``
            (default) does when the entry is there.

    Raises:
        TypeError: if a distribution is another one.
        ValueError: if bounds differ, the weight is negative, an option is unknown, or
            a deterministic actor is not given ``recovery_direction="reverse"``; in the
            call, if the batch is empty or holds several steps a row.
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
            action: what a deterministic actor writes. Defaults to ``"action"``.
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
        inverse_dynamics_network: ProbabilisticTensorDictSequential,
        *,
        recovery_weight: float = 0.5,
        recovery_direction: Literal["forward", "reverse"] = "forward",
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
        self.recovery_direction = recovery_direction
        self.recovery_states = recovery_states
        self.action_reduction = action_reduction
        name = "inverse_dynamics_network"
        low, high = bounds = action_bounds(inverse_dynamics_network, name)
        self.register_buffer("action_low", low, persistent=False)
        self.register_buffer("action_high", high, persistent=False)
        self._check_actor(actor_network, bounds)
        if not self.is_deterministic:
            check_same_size(actor_network, inverse_dynamics_network)
        self.convert_to_functional(actor_network, "actor_network")
        self._hold_inverse_dynamics(inverse_dynamics_network)
        self.register_coeff_buffer("recovery_weight", float(recovery_weight))

    def _check_actor(
        self, network: TensorDictModuleBase, bounds: tuple[Tensor, Tensor]
    ) -> None:
        """Note what the actor ends in; raise unless the term is defined for it."""
        kind = ProbabilisticTensorDictModule
        heads = [module for module in network.modules() if isinstance(module, kind)]
        self.has_distribution = bool(heads)
        self.is_deterministic = not heads or heads[-1].distribution_class is TanhDelta
        if self.is_deterministic and self.recovery_direction == "forward":
            raise ValueError(
                "actor_network is deterministic, which is infinitely far from a "
                "density in the forward direction. Pass recovery_direction='reverse': "
                "it pulls the action to the mean of the inverse dynamics model."
            )
        if not self.is_deterministic:
            check_same_bounds(action_bounds(network, "actor_network"), bounds)
        elif heads:
            kwargs = {"low": -1.0, "high": 1.0} | heads[-1].distribution_kwargs
            low, high = (torch.as_tensor(kwargs[key]) for key in ("low", "high"))
            check_same_bounds((low.to(bounds[0]), high.to(bounds[1])), bounds)

    def _input_keys(self) -> list[NestedKey]:
        states = state_keys(self.actor_network.in_keys)
        network_keys = self.inverse_dynamics_network.in_keys
        keys = [*states, *network_keys, nested("next", self.tensor_keys.done)]
        if self.recovery_states != "clean":
            states += state_keys(network_keys)
            keys += [nested(self.tensor_keys.perturbed, key) for key in states]
        return keys

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        return ["loss_recovery"], ["recovery_kl"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``"loss_recovery"`` and its unweighted mean ``"recovery_kl"``.

        Args:
            tensordict: a batch ``[B]`` with the entries of :attr:`in_keys`.
        """
        self._check_not_empty(tensordict)
        done = column(tensordict, nested("next", self.tensor_keys.done)).bool()
        states = self.recovery_states
        model: TanhNormal = frozen_distribution(
            self, tensordict, done=done, states=states
        )
        mixed = transitions(
            tensordict,
            state_keys(self.actor_network.in_keys),
            done=done,
            perturbed=self.tensor_keys.perturbed,
            states=states,
        )
        divergence = self._divergence(mixed, model).mean(0)
        loss = self.recovery_weight * self._reduce(divergence, tensordict, ~done)
        mean = self._mean(divergence, tensordict, ~done)
        return self._output(tensordict, {"loss_recovery": loss}, {"recovery_kl": mean})

    def _divergence(self, states: TensorDictBase, model: TanhNormal) -> Tensor:
        """The recovery term (11) at ``states``, ``[D, B]``."""
        with self.actor_network_params.to_module(
            self.actor_network, preserve_module_state=False
        ):
            if self.has_distribution:
                pi = self.actor_network.get_dist(states)
                # Not TanhDelta's action, which may have saturated.
                loc = pi.base_dist.param if self.is_deterministic else pi.loc
            else:
                loc = self._pre_tanh(self.actor_network(states))
        sizes = model.loc.shape[-1], loc.shape[-1]
        check_num_actions("inverse_dynamics_network", *sizes)
        if self.is_deterministic:
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

    def _pre_tanh(self, output: TensorDictBase) -> Tensor:
        """The written action before the tanh, ``[D, B, A]``."""
        key = self.tensor_keys.action
        action = output.get(key, None)
        if action is None:
            raise KeyError(f"The actor writes no {key!r}: call set_keys(action=...).")
        width = self.action_high - self.action_low
        squashed = 2 * (action - self.action_low) / width - 1
        # Clamped a little inside the bounds, where the slope is finite.
        return cast(Tensor, safeatanh_noeps(squashed))
