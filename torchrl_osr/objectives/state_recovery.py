r"""The state-recovery term alone, as an addition to any loss that trains an actor.

Shapes: ``R`` rows, ``A`` action, ``D`` sets of states (2 for D_tot, 1 for either half).
"""

from __future__ import annotations

import copy
from typing import Any, Literal, Self

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    dispatch,
)
from torch import Tensor
from torchrl.modules import Delta, IndependentNormal, TanhDelta, TanhNormal
from torchrl.modules.distributions.utils import safeatanh_noeps
from torchrl.objectives import LossModule

from torchrl_osr import functional as F
from torchrl_osr._checks import check_choice
from torchrl_osr._entries import nested, state_keys
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses
from torchrl_osr.objectives.networks import (
    CATEGORICAL,
    ONE_HOT,
    action_bounds,
    check_action,
    check_num_actions,
    distribution,
    head_of,
    squashing_bounds,
    written_entry,
)
from torchrl_osr.objectives.transitions import States, Transitions


class StateRecoveryLoss(ActorCriticLoss):
    r"""The state-recovery term :math:`L_{sr}`, for the actor of another loss.

    .. math::
        \lambda\, \mathbb E_{\tilde s, s' \sim D_{tot}}
            KL(I(a \mid \tilde s, s') \,\|\, \pi(a \mid \tilde s))

    Give it the actor of an IQLLoss, SACLoss, TD3BCLoss or another TorchRL loss and add
    ``"loss_recovery"`` to that loss's entries, or join both by :class:`WithRecovery`.
    The two share the actor's tensors, and the optimizer of that loss is enough. The
    gradient reaches the actor only. Rows that are ``done`` or synthetic do not count.
    Equations (11) and (12) of the paper of :class:`~torchrl_osr.OSRLoss`.

    Two more actors are pulled to the model's mean: a deterministic one (a
    :class:`~torchrl.modules.TanhDelta`, or a module that writes the action), and the
    mean of an :class:`~torchrl.modules.IndependentNormal`. Their term is
    :math:`(x - \mu_I)^2 / (2\sigma_I^2)`, with :math:`x` the action before the tanh.
    It is (11) with equal widths, and not in the paper. A module should end in a tanh;
    beyond the bounds its gradient is finite, but huge.

    With ``recovery_target="data"`` it is noisy behaviour cloning, which needs no model:
    :math:`-\log\pi(a \mid \tilde s)`, and the squared distance
    :math:`\|\pi(\tilde s) - a\|^2` of a deterministic actor.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.TanhNormal` or an
            :class:`~torchrl.modules.IndependentNormal`, or is deterministic.
        inverse_dynamics_network: a *trained* model of ``I(a | s, s')`` with the
            actor's bounds (see :class:`~torchrl_osr.InverseDynamicsLoss`), frozen here.
            Not needed with ``recovery_target="data"``.

    Keyword Args:
        recovery_weight: weight :math:`\lambda`. Default 0.5. May be assigned later.
        recovery_target: what the policy is pulled to: ``"inverse_dynamics"`` (default)
            or ``"data"``, the data's action.
        recovery_direction: of a tanh-Gaussian actor: ``"forward"`` (default) is the
            paper's ``KL(I || pi)``, ``"reverse"`` the authors' code's ``KL(pi || I)``.
        action_reduction: over action dimensions: ``"sum"`` (default) or ``"mean"``.
        recovery_states: ``"both"`` (default) for D_tot, ``"perturbed"``, or
            ``"clean"``, which needs no perturbed entry.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Examples:
        >>> from torchrl_osr import StateRecoveryLoss
        >>> from torchrl_osr.modules import (
        ...     tanh_gaussian_actor, tanh_gaussian_inverse_dynamics)
        >>> actor = tanh_gaussian_actor(11, 3)  # the one given to IQLLoss, for instance
        >>> recovery = StateRecoveryLoss(actor, tanh_gaussian_inverse_dynamics(11, 3))
        >>> recovery.out_keys
        ['loss_recovery', 'recovery_kl']
        >>> set(recovery.parameters()) == set(actor.parameters())
        True
    """

    _schedulable_buffers = frozenset({"recovery_weight"})

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None = None,
        *,
        recovery_weight: float = 0.5,
        recovery_target: Literal["inverse_dynamics", "data"] = "inverse_dynamics",
        recovery_direction: Literal["forward", "reverse"] = "forward",
        recovery_states: States = "both",
        action_reduction: Literal["sum", "mean"] = "sum",
        **options: Any,
    ) -> None:
        check_choice("recovery_target", recovery_target, ("inverse_dynamics", "data"))
        super().__init__(**options)
        self.convert_to_functional(actor_network, "actor_network")
        self.recovery_target, self.recovery_states = recovery_target, recovery_states
        self.recovery_direction = recovery_direction
        self.action_reduction = action_reduction
        head, _ = head_of(actor_network)
        deterministic = head in (None, Delta, TanhDelta)  # without a density
        if not deterministic and head is not IndependentNormal:
            action_bounds(actor_network, "actor_network")  # or a TypeError
        own = squashing_bounds(actor_network)
        self.metric = "recovery_kl"
        if recovery_target == "data":
            self.metric = "recovery_error" if deterministic else "recovery_nll"
            self.register_bounds(own)
        elif inverse_dynamics_network is None:
            raise ValueError(
                "StateRecoveryLoss needs an inverse_dynamics_network: pass one, or "
                "recovery_target='data' for noisy behaviour cloning."
            )
        else:
            name = "inverse_dynamics_network"
            self.register_bounds(own or action_bounds(inverse_dynamics_network, name))
            self.register_model(inverse_dynamics_network)
        self.register_coefficient("recovery_weight", recovery_weight)
        self.declare(["loss_recovery"], [self.metric])

    def input_keys(self) -> list[NestedKey]:
        states = state_keys(self.actor_network.in_keys)
        read: list[NestedKey] = [self.tensor_keys.action]
        if self.recovery_target != "data":
            read = self.inverse_dynamics_network.in_keys
        keys = [*states, *read, nested("next", self.tensor_keys.done)]
        if self.recovery_states != "clean":
            states += state_keys(read, self.tensor_keys.action)
            keys += [nested(self.tensor_keys.perturbed, key) for key in states]
        return keys

    def losses(self, batch: Transitions) -> Losses:
        network, key = self.actor_network, self.tensor_keys.action
        mixed = batch.states_of(state_keys(network.in_keys), self.recovery_states)
        pi = policy_at(network, self.actor_network_params, mixed, key)
        if self.recovery_target == "data":
            recovery = cloning_distance(pi, batch.a, key).mean(0)
            self.check_actions(batch, batch.a.shape)
        else:
            model = self.inverse_dynamics(batch, self.recovery_states)
            recovery = self.divergence(pi, model).mean(0)
        term = self.recovery_weight * self.reduce(recovery, batch, batch.has_next)
        metric = self.mean(recovery, batch, batch.has_next)
        return {"loss_recovery": term}, {self.metric: metric}

    def divergence(self, pi: Any, model: Any) -> Tensor:
        """Return the recovery term (11) of a policy and a model, ``[D, R]``."""
        # Of equal widths, only the means are left in the divergence.
        scale = model.scale
        if isinstance(pi, TanhNormal):
            loc, scale = pi.loc, pi.scale
        elif isinstance(pi, TanhDelta):
            loc = pi.base_dist.param  # not its action, which may have saturated
        else:
            action = pi if isinstance(pi, Tensor) else pi.mean
            width = self.action_high - self.action_low
            # Clamped a little inside the bounds, where the slope is finite.
            loc = safeatanh_noeps(2 * (action - self.action_low) / width - 1)
        check_num_actions("inverse_dynamics_network", model.loc, loc)
        return F.state_recovery(
            *(loc, scale, model.loc, model.scale),
            direction=self.recovery_direction,
            action_reduction=self.action_reduction,
        )


class WithRecovery(LossModule):
    """Join a loss and a term of its actor to one loss.

    Optimizers, checkpoints and loggers treat the two as one. Give ``SoftUpdate`` and
    ``policy_from_loss`` the part ``loss``. Shared parameters count once. Each part has
    its own reduction, masks and weights.

    Args:
        loss: trains an actor, such as TorchRL's ``IQLLoss``.
        recovery: a term of the same actor; another actor is a ValueError.

    Examples:
        >>> from torchrl_osr import CQLLoss, StateRecoveryLoss
        >>> from torchrl_osr.modules import (
        ...     critic_ensemble, tanh_gaussian_actor, tanh_gaussian_inverse_dynamics)
        >>> from torchrl_osr.objectives import WithRecovery
        >>> actor = tanh_gaussian_actor(11, 3)
        >>> cql = CQLLoss(actor, critic_ensemble(11, 3))
        >>> recovery = StateRecoveryLoss(actor, tanh_gaussian_inverse_dynamics(11, 3))
        >>> loss = WithRecovery(cql, recovery)
        >>> [key for key in loss.out_keys if key.startswith("loss_")]
        ['loss_actor', 'loss_alpha', 'loss_qvalue', 'loss_cql', 'loss_recovery']
    """

    def __init__(self, loss: LossModule, recovery: LossModule) -> None:
        super().__init__()
        pair = loss.actor_network_params, recovery.actor_network_params
        ours, theirs = (set(map(id, each.parameters())) for each in pair)
        if ours != theirs:
            raise ValueError(
                "the recovery term is of another actor than the loss's: build both "
                "with the same actor_network."
            )
        self.loss, self.recovery = loss, recovery

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        # tensordict 0.14.3's TensorDictParams copies without the memo: both parts would
        # have an actor of their own.
        new = type(self)(self.loss, self.recovery)
        new.training = self.training
        new.loss = copy.deepcopy(self.loss, memo)
        new.recovery = copy.deepcopy(self.recovery, memo)
        new.recovery.actor_network_params = new.loss.actor_network_params
        return new

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that one of the two reads."""
        return list(dict.fromkeys([*self.loss.in_keys, *self.recovery.in_keys]))

    @property
    def out_keys(self) -> list[NestedKey]:
        """The entries that the two write."""
        return [*self.loss.out_keys, *self.recovery.out_keys]

    @property
    def value_estimator(self) -> Any:
        """The one of the loss."""
        return self.loss.value_estimator

    def reset_parameters_recursive(self) -> None:
        """Draw the parameters of both anew."""
        for part in (self.loss, self.recovery):
            part.reset_parameters_recursive()

    def make_value_estimator(self, *args: Any, **options: Any) -> Self:
        """Choose the TD target of the loss."""
        self.loss.make_value_estimator(*args, **options)
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return losses and metrics of both, see ``out_keys``."""
        return self.loss(tensordict).update(self.recovery(tensordict))


def policy_at(
    network: TensorDictModuleBase,
    params: TensorDictBase,
    states: TensorDictBase,
    key: NestedKey,
) -> Any:
    """Return an actor's distribution at states ``[D, R]``, or the action it writes."""
    if head_of(network)[0] is None:
        return written_entry(network, params, states, key)
    return distribution(network, params, states)


def cloning_distance(policy: Any, data_action: Tensor, key: NestedKey) -> Tensor:
    r"""Return the objective of behaviour cloning, ``[D, R]``.

    :math:`-\log\pi(a \mid s)`; for a policy without a density the squared distance
    :math:`\|\pi(s) - a\|^2`. The policy is one of :func:`policy_at`.
    """
    if isinstance(policy, (Tensor, TanhDelta, Delta)):
        action = policy if isinstance(policy, Tensor) else policy.deterministic_sample
        check_action(data_action, action.shape[1:], key)
        return (action - data_action).square().sum(-1)
    if isinstance(policy, CATEGORICAL):
        return -at_actions(policy.logits, data_action, policy, key)
    shape = policy.batch_shape + policy.event_shape
    check_action(data_action, shape[1:], key)
    log_prob: Tensor = policy.log_prob(data_action.expand(shape))
    # torch's Normal has a density for each dimension.
    return -(log_prob if policy.event_shape else log_prob.sum(-1))


def at_actions(
    values: Tensor, action: Tensor, distribution: Any, key: NestedKey
) -> Tensor:
    """Return the values ``[..., R, n]`` of a batch's discrete actions, ``[..., R]``.

    They are one-hot ``[R, n]`` of any type if the distribution is of one-hot actions,
    or else integer indices ``[R]`` or ``[R, 1]``; a ValueError names others.
    """
    rows, number = values.shape[-2:]
    one_hot = isinstance(distribution, ONE_HOT)
    expected: Any = [(rows, number)] if one_hot else [(rows,), (rows, 1)]
    if action.shape not in expected or (not one_hot and action.is_floating_point()):
        raise ValueError(
            f"{key!r} has shape {tuple(action.shape)} and type {action.dtype}; the "
            f"actions of a {type(distribution).__name__} have one of {expected}, and "
            "indices are integers."
        )
    # In floating point: torch has no argmax of booleans.
    index = action.float().argmax(-1) if one_hot else action.long().reshape(rows)
    return values.gather(-1, index.expand(values.shape[:-1]).unsqueeze(-1)).squeeze(-1)
