"""The networks of the recovery losses: how they are held, and how they are run.

Shapes: ``B`` batch (any leading dimensions), ``N`` critics, ``D`` state sets of D_tot
(2: clean and perturbed; 1 where nothing is perturbed). They are always stacked
as ``[s, s', s^]``: rows ``[:2]`` are the true states, ``[::2]`` D_tot.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictParams,
)
from torch import Tensor
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import _vmap_func, dispatch_value_estimator

from torchrl_osr._checks import check_choice
from torchrl_osr.objectives.base import BaseLoss, Reduction, ScalarOutputMode
from torchrl_osr.objectives.distributions import check_apart
from torchrl_osr.objectives.frozen_model import (
    freeze,
    frozen_distribution,
    full_precision,
)
from torchrl_osr.objectives.mixed_states import (
    States,
    column,
    nested,
    perturbed_twin,
    replace_next,
    select,
    state_keys,
)


class ActorCriticNetworks(BaseLoss):
    """Abstract base that holds an actor, critics and an inverse dynamics model.

    Continuous (:class:`~torchrl_osr.objectives.actor_critic.RecoveryActorCriticLoss`)
    and discrete actions (:class:`~torchrl_osr.DiscreteOSRLoss`) stand on it.
    """

    @dataclass
    class _AcceptedKeys:
        """The tensordict entries that :meth:`set_keys` can rename.

        Attributes:
            action: the data's action. Defaults to ``"action"``.
            value: what the value estimator reads. Defaults to ``"state_value"``.
            reward, done, terminated: below ``"next"``. Default to their own names.
            priority: written to the batch, ``[B]``. Defaults to ``"td_error"``.
            priority_weight: importance weight of a row. Defaults to
                ``"priority_weight"``.
            perturbed: where the perturbed twins are. Defaults to ``"perturbed"``.
        """

        action: NestedKey = "action"
        value: NestedKey = "state_value"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"
        perturbed: NestedKey = "perturbed"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0

    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    qvalue_network: TensorDictModule
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams
    inverse_dynamics_network: ProbabilisticTensorDictSequential
    inverse_dynamics_network_params: TensorDictParams
    target_inverse_dynamics_network_params: TensorDictParams

    # Rows of [s, s', s^] on which the policy is improved: D_tot.
    _actor_rows = slice(0, None, 2)

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None,
        *,
        recovers: bool = True,
        recovery_states: States = "both",
        actor_states: Literal["both", "clean"] = "both",
        num_qvalue_nets: int,
        loss_function: str,
        alpha_init: float,
        fixed_alpha: bool,
        target_entropy: float | Literal["auto"],
        delay_qvalue: bool,
        reduction: Reduction,
        deactivate_vmap: bool,
        use_prioritized_weights: bool | Literal["auto"],
        scalar_output_mode: ScalarOutputMode,
    ) -> None:
        choices = ("both", "perturbed", "clean")
        check_choice("recovery_states", recovery_states, choices)
        check_choice("actor_states", actor_states, ("both", "clean"))
        check_choice("loss_function", loss_function, ("l2", "l1", "smooth_l1"))
        super().__init__(
            reduction,
            use_prioritized_weights=use_prioritized_weights,
            scalar_output_mode=scalar_output_mode,
        )
        self.deactivate_vmap = deactivate_vmap
        self.recovers = recovers
        self.recovery_states = recovery_states
        # Whether s^ is there: else D_tot, whose rows are [::2], is s alone.
        self.perturbs = recovers and recovery_states != "clean"
        if actor_states == "clean":
            self._actor_rows = slice(0, 1)
        self._check_distributions(actor_network, inverse_dynamics_network)
        check_apart(
            actor_network=actor_network,
            qvalue_network=qvalue_network,
            inverse_dynamics_network=inverse_dynamics_network,
        )
        self.convert_to_functional(actor_network, "actor_network")
        if isinstance(qvalue_network, Sequence):
            num_qvalue_nets = len(qvalue_network)
        if num_qvalue_nets < 1:
            raise ValueError("There must be at least one critic.")
        self.num_qvalue_nets = num_qvalue_nets
        self.convert_to_functional(
            qvalue_network,
            "qvalue_network",
            num_qvalue_nets,
            create_target_params=delay_qvalue,
        )
        if inverse_dynamics_network is not None:
            self.convert_to_functional(
                inverse_dynamics_network, "inverse_dynamics_network"
            )
            self.inverse_dynamics_network_params = freeze(
                self.inverse_dynamics_network_params
            )
        log_alpha = torch.tensor(math.log(alpha_init))
        if fixed_alpha:
            self.register_buffer("log_alpha", log_alpha)
        else:
            self.log_alpha = torch.nn.Parameter(log_alpha)
        self.target_entropy = target_entropy
        self.loss_function = loss_function
        self._make_vmap()
        # Now, not at the first call as TorchRL does: a state dict has the same entries
        # before and after it.
        self.make_value_estimator()

    @abstractmethod
    def _check_distributions(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None,
    ) -> None:
        """Raise unless the networks' distributions are what the loss computes with."""

    def _make_vmap(self) -> None:
        self._vmap_qvalue = _vmap_func(
            self.qvalue_network,
            (None, 0),
            randomness=self.vmap_randomness,
            pseudo_vmap=self.deactivate_vmap,
        )

    def reset_parameters_recursive(self) -> None:
        """Reset actor and critics; the inverse dynamics model keeps what it learnt."""
        for name in ("actor_network", "qvalue_network"):
            self._reset_module_parameters(name, getattr(self, name))

    def make_value_estimator(
        self, value_type: ValueEstimators | str | None = None, **hyperparams: Any
    ) -> ActorCriticNetworks:
        """Choose the TD target: TD(0) with ``gamma=0.99`` unless told otherwise."""
        value_type, kwargs = self._prepare_value_estimator_kwargs(
            value_type, **hyperparams
        )
        if value_type is not None:
            names = ("value", "reward", "done", "terminated")
            dispatch_value_estimator(
                self,
                value_type,
                supported=(
                    ValueEstimators.TD0,
                    ValueEstimators.TD1,
                    ValueEstimators.TDLambda,
                ),
                tensor_keys={name: getattr(self.tensor_keys, name) for name in names},
                value_network=None,
                deactivate_vmap=self.deactivate_vmap,
                **kwargs,
            )
        return self

    def _observation_keys(self) -> list[NestedKey]:
        """The state entries that actor and critics read."""
        network_keys = [*self.actor_network.in_keys, *self.qvalue_network.in_keys]
        return state_keys(network_keys, self.tensor_keys.action)

    def _input_keys(self) -> list[NestedKey]:
        keys = self.tensor_keys
        states = self._observation_keys()
        in_keys = [*states, keys.action]
        in_keys += [nested("next", key) for key in states]
        in_keys += [
            nested("next", key) for key in (keys.reward, keys.done, keys.terminated)
        ]
        in_keys += self._model_keys()
        if self.perturbs:
            in_keys += [nested(keys.perturbed, key) for key in self._perturbed_keys()]
        return in_keys

    def _perturbed_keys(self) -> list[NestedKey]:
        """The state entries whose perturbed twins are read from the batch."""
        return [*self._observation_keys(), *state_keys(self._model_keys())]

    def _model_keys(self) -> list[NestedKey]:
        """What the inverse dynamics model reads, if there is one."""
        model = getattr(self, "inverse_dynamics_network", None)
        return [] if model is None else list(model.in_keys)

    def _flag(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        """Return a boolean entry below ``"next"``, ``[B]``."""
        return column(tensordict, nested("next", key))

    def _states(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``[s, s']`` or ``[s, s', s^]``, stacked in front: ``[2 or 3, B]``."""
        keys = self._observation_keys()
        clean = select(tensordict, keys)
        following = clean.copy()
        terminated = self._flag(tensordict, self.tensor_keys.terminated)
        for key in keys:
            following.set(key, replace_next(tensordict, key, terminated))
        stack = [clean, following]
        if self.perturbs:
            stack.append(perturbed_twin(tensordict, keys, self.tensor_keys.perturbed))
        return torch.stack(stack)

    def _policy(self, states: TensorDictBase) -> TensorDictBase:
        """Run the actor once on all states; distributions are built from slices."""
        with self.actor_network_params.to_module(
            self.actor_network, preserve_module_state=False
        ):
            return full_precision(self.actor_network.get_dist_params(states.copy()))

    def _distribution(self, policy: TensorDictBase) -> Any:
        return self.actor_network.build_dist_from_params(policy)

    def _critics(
        self, batch: TensorDictBase, params: TensorDictParams, key: NestedKey
    ) -> Tensor:
        """Return what all critics write under ``key``, ``[N, B, ...]``."""
        value = full_precision(self._vmap_qvalue(batch, params)).get(key, None)
        if value is None:
            raise KeyError(
                f"The critics write {self.qvalue_network.out_keys}, not {key!r}: give "
                "them that out_key, or name theirs with set_keys()."
            )
        return cast(Tensor, value)

    def _critic_inputs(self, states: TensorDictBase) -> TensorDictBase:
        return states.select(*state_keys(self.qvalue_network.in_keys), strict=False)

    def _inverse_dynamics(self, tensordict: TensorDictBase, done: Tensor) -> Any:
        """Return the model's distribution on D_tot, or its half, ``[2 or 1, B]``."""
        return frozen_distribution(
            self.inverse_dynamics_network,
            self.inverse_dynamics_network_params,
            tensordict,
            done=done,
            perturbed=self.tensor_keys.perturbed,
            states=self.recovery_states,
        )
