"""One batch as an actor-critic loss sees it: states, and its networks' outputs there.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``D`` sets of
states: 2 for D_tot (clean and perturbed), 1 for either alone.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictParams,
    set_interaction_type,
)
from torch import Tensor
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import distance_loss
from torchrl.objectives.value import TD0Estimator

from torchrl_osr import functional
from torchrl_osr._entries import column, entry, nested, select, state_keys
from torchrl_osr.fast import critics
from torchrl_osr.objectives.base import BaseLoss
from torchrl_osr.objectives.distributions import check_action
from torchrl_osr.objectives.mixed_states import (
    States,
    first_step,
    next_state,
    of_data,
    perturbed_state,
    transitions,
)

ROWS = {
    "both": slice(0, None, 2),
    "clean": slice(0, 1),
    "perturbed": slice(2, 3),
    "next": slice(1, 2),
    "true": slice(0, 2),
}
"""Where sets of states lie in the stack ``[s, s', s^]``: the three of D_tot, the next
states, and ``"true"`` for states and next states."""


def full_precision(output: TensorDictBase) -> TensorDictBase:
    """What layers wrote in half precision, under autocast, as float32.

    Densities, divergences and log-sum-exps are differences of large numbers: they are
    computed from it in float32.
    """
    if not (torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled("cuda")):
        return output
    half = (torch.bfloat16, torch.float16)
    return output.apply(lambda value: value.float() if value.dtype in half else value)


def distribution_params(
    network: ProbabilisticTensorDictSequential,
    params: TensorDictParams,
    states: TensorDictBase,
) -> TensorDictBase:
    """The parameters of a network's distribution at ``states``."""
    with params.to_module(network, preserve_module_state=False):
        return full_precision(network.get_dist_params(states.copy()))


def distribution(
    network: ProbabilisticTensorDictSequential,
    params: TensorDictParams,
    states: TensorDictBase,
) -> Any:
    """A network's distribution at ``states``."""
    found = distribution_params(network, params, states)
    return network.build_dist_from_params(found)


def written_action(
    network: TensorDictModuleBase,
    params: TensorDictParams,
    states: TensorDictBase,
    key: NestedKey,
) -> Tensor:
    """The action that a deterministic network writes at ``states``, ``[..., A]``.

    Raises:
        KeyError: if it writes no such action.
    """
    with params.to_module(network, preserve_module_state=False):
        output = full_precision(network(states.copy()))
    action: Tensor | None = output.get(key, None)
    if action is None:
        raise KeyError(f"The actor writes no {key!r}: call set_keys(action=...).")
    return action


def frozen_distribution(
    loss: BaseLoss,
    tensordict: TensorDictBase,
    *,
    done: Tensor,
    states: States,
) -> Any:
    """The inverse dynamics model ``I(a | s~, s')``, ``[D, B]``, without gradient.

    A model with a latent variable
    (:func:`~torchrl_osr.modules.cvae_inverse_dynamics`) keeps it at its mean: what the
    policy is pulled to does not jitter from one call to the next.

    Args:
        loss: holds the model.
        tensordict: a batch ``[B]`` of single steps.
        done: rows whose next state is not to be learnt from, bool ``[B]``.
        states: ``"both"``, ``"clean"`` or ``"perturbed"``.
    """
    loss._check_model_is_trained()
    network = loss.inverse_dynamics_network
    batch = transitions(
        tensordict,
        network.in_keys,
        done=done,
        perturbed=loss.tensor_keys.perturbed,
        states=states,
    )
    with torch.no_grad(), set_interaction_type(InteractionType.DETERMINISTIC):
        return distribution(network, loss.inverse_dynamics_network_params, batch)


def qvalue(
    loss: BaseLoss, states: TensorDictBase, action: Tensor, params: TensorDictParams
) -> Tensor:
    """The values of all critics, ``[N, B]``, of actions ``[B, A]`` at states."""
    keys, network = loss.tensor_keys, loss.qvalue_network
    mlp = critics.plain_mlp(network, keys.action, keys.state_action_value)
    if mlp is not None:
        return critics.qvalue(params, mlp, critic_state(loss, states), action)
    batch = critic_inputs(loss, states).set(keys.action, action)
    return critic_output(loss, batch, params, keys.state_action_value).squeeze(-1)


def critic_inputs(loss: BaseLoss, states: TensorDictBase) -> TensorDictBase:
    """The state entries that the critics read."""
    return states.select(*state_keys(loss.qvalue_network.in_keys), strict=False)


def critic_state(loss: BaseLoss, states: TensorDictBase) -> Tensor:
    """The state entries that plain critics read, joined, ``[B, S]``."""
    return torch.cat([states.get(key) for key in loss.qvalue_network.in_keys[:-1]], -1)


def critic_output(
    loss: BaseLoss, batch: TensorDictBase, params: TensorDictParams, key: NestedKey
) -> Tensor:
    """The entry ``key`` that all critics write, ``[N, B, ...]``."""
    value: Tensor | None = full_precision(loss._vmap_qvalue(batch, params)).get(
        key, None
    )
    if value is None:
        raise KeyError(
            f"The critics write {loss.qvalue_network.out_keys}, not {key!r}: give "
            "them that out_key, or name theirs with set_keys()."
        )
    return value


def observation_keys(loss: BaseLoss) -> list[NestedKey]:
    """The state entries that actor and critics read."""
    network_keys = [*loss.actor_network.in_keys, *loss.qvalue_network.in_keys]
    return state_keys(network_keys, loss.tensor_keys.action)


def actor_critic_in_keys(loss: BaseLoss, *, perturbed: bool) -> list[NestedKey]:
    """The entries that actor, critics and inverse dynamics model read."""
    keys, states = loss.tensor_keys, observation_keys(loss)
    in_keys = [*states, keys.action, *(nested("next", key) for key in states)]
    in_keys += loss._next_keys("reward", "done", "terminated")
    model_keys: list[NestedKey] = []
    if "inverse_dynamics_network" in loss.__dict__:
        model_keys = list(loss.inverse_dynamics_network.in_keys)
    in_keys += model_keys
    if perturbed:
        found = [*states, *state_keys(model_keys)]
        in_keys += [nested(keys.perturbed, key) for key in found]
    return in_keys


class Step:
    """The networks of a loss, evaluated where its equations need them.

    The policy runs once, on all states together; distributions are built from slices.

    Args:
        loss: holds the networks.
        tensordict: a batch ``[B]``.

    Keyword Args:
        perturbed: whether the batch's perturbed states are needed.

    Attributes:
        tensordict: the batch.
        first: the batch of single steps, see
            :func:`~torchrl_osr.objectives.mixed_states.first_step`.
        done: ends of trajectories, whose next state may not be one, bool ``[B]``; of
            the single steps.
        of_data: rows with an action of the data, bool ``[B]``; ``None`` if all have.
        terminated: whether the TD target ends with the rewards, bool ``[B]``.
        states: ``[s, s']`` or ``[s, s', s^]``, ``[2 or 3, B]``. A next state after a
            termination is not one: there ``s`` stands in its place.
    """

    def __init__(
        self, loss: BaseLoss, tensordict: TensorDictBase, *, perturbed: bool
    ) -> None:
        self.loss, self.tensordict = loss, tensordict
        self.first = first_step(tensordict)
        done, terminated = loss._next_keys("done", "terminated")
        self.done = column(self.first, done).bool()
        self.of_data = of_data(tensordict)
        self.terminated = column(tensordict, terminated).bool()
        keys = observation_keys(loss)
        for key in keys:
            if key in loss.actor_network.out_keys:
                raise KeyError(
                    f"{key!r} is what the actor writes, and would be read as a state: "
                    f"call set_keys(action={key!r})."
                )
        clean = select(tensordict, keys)
        after = clean.copy()
        for key in keys:
            after.set(key, next_state(tensordict, key, self.terminated))
        stack = [clean, after]
        if perturbed:
            stack.append(perturbed_state(tensordict, keys, loss.tensor_keys.perturbed))
        self.states = torch.stack(stack)
        self._with_grad = torch.is_grad_enabled()
        self._policy_params: TensorDictBase | None = None
        self._policies: dict[str, Any] = {}

    @property
    def data_action(self) -> Tensor:
        """The data's action, ``[B, A]``."""
        return entry(self.tensordict, self.loss.tensor_keys.action)

    def at(self, states: str) -> TensorDictBase:
        """A set of states in :data:`ROWS`, ``[D, B]``."""
        return self.states[ROWS[states]]

    def policy(self, states: str) -> Any:
        """The policy's distribution at a set of states in :data:`ROWS`, ``[D, B]``."""
        # Kept for those who ask next, so with a gradient even where none is wanted now.
        with torch.set_grad_enabled(self._with_grad):
            if self._policy_params is None:
                loss = self.loss
                self._policy_params = distribution_params(
                    loss.actor_network, loss.actor_network_params, self.states
                )
            if states not in self._policies:
                params = self._policy_params[ROWS[states]]
                pi = self.loss.actor_network.build_dist_from_params(params)
                self._policies[states] = pi
        return self._policies[states]

    def target_policy(self) -> Any:
        """The policy at the next states that the TD target is of, ``[1, B]``."""
        loss = self.loss
        if not loss.delay_actor:
            return self.policy("next")
        params = loss.target_actor_network_params
        return distribution(loss.actor_network, params, self.at("next"))

    def action(self, states: TensorDictBase, params: TensorDictParams) -> Tensor:
        """The action that a deterministic policy writes, ``[..., A]``."""
        key = self.loss.tensor_keys.action
        return written_action(self.loss.actor_network, params, states, key)

    def inverse_dynamics(self, states: States) -> Any:
        """The frozen model ``I(a | s~, s')`` at these states, ``[D, B]``."""
        return frozen_distribution(self.loss, self.first, done=self.done, states=states)

    def qvalue(
        self, states: TensorDictBase, action: Tensor, params: TensorDictParams
    ) -> Tensor:
        """The values of all critics, see :func:`qvalue`."""
        return qvalue(self.loss, states, action, params)

    def soft_objective(self, states: States) -> tuple[Tensor, Tensor]:
        """SAC's objective of the policy, to be minimised, on a set of states.

        Returns:
            The objective, ``[B]``, and the log-density of the policy's own actions,
            ``[D, B]``.
        """
        loss = self.loss
        action, log_prob = rsample_and_log_prob(self.policy(states))
        check_action(self.data_action, action.shape[-1], loss.tensor_keys.action)
        # Detached: the policy's objective shall not train the critics.
        params = loss.qvalue_network_params.detach()
        qvalue = self.qvalue(self.at(states), action, params)
        objective = functional.soft_policy_value(log_prob, qvalue, loss._alpha)
        return objective.mean(0), log_prob

    def temperature_loss(self, log_prob: Tensor, auto: float | None = None) -> Tensor:
        """SAC's objective of the entropy temperature, reduced.

        Args:
            log_prob: log-density of the policy's own actions, ``[D, B]``.
            auto: target that ``target_entropy="auto"`` stands for, in nats. Default:
                minus the number of an action's dimensions.
        """
        wanted = self.loss.target_entropy
        if wanted == "auto":
            wanted = -self.data_action.shape[-1] if auto is None else auto
        objective = functional.temperature_objective(
            self.loss.log_alpha, log_prob, wanted
        )
        return self.reduce(objective.mean(0))

    def soft_target(self) -> Tensor:
        """The TD target with SAC's entropy, ``[B]``."""
        loss = self.loss
        with torch.no_grad():  # as a decorator here, torch.compile cannot trace it
            action, log_prob = rsample_and_log_prob(self.target_policy())
            params = loss.target_qvalue_network_params
            qvalue = self.qvalue(self.at("next"), action, params)
            next_value = functional.bootstrap_value(qvalue, log_prob, loss._alpha)
            return self.td_target(next_value.squeeze(0))

    def td_target(self, next_value: Tensor) -> Tensor:
        r"""The TD target :math:`r + \gamma (1 - \text{terminated}) V(s')`, ``[B]``.

        Computed by the value estimator that ``make_value_estimator`` chose; this is
        TD(0), the default. The others need trajectories, ``[B, T]``. ``terminated``,
        not ``done``: a time-out cuts the recording, not the task.

        Args:
            next_value: :math:`V(s')`, ``[B]``.
        """
        loss = self.loss
        if self.tensordict.ndim < 2 and not isinstance(
            loss.value_estimator, TD0Estimator
        ):
            raise ValueError(
                f"{type(loss.value_estimator).__name__} reads the rows of a batch as "
                "one trajectory: expected a batch [B, T] of trajectories, got "
                f"{[*self.tensordict.batch_size]}; use the default, TD(0)."
            )
        column(self.tensordict, nested("next", loss.tensor_keys.reward))
        batch = self.tensordict.copy()
        key = nested("next", loss.value_estimator.tensor_keys.value)
        batch.set(key, next_value.unsqueeze(-1))
        target: Tensor = loss.value_estimator.value_estimate(batch)
        return target.squeeze(-1)

    def td_distance(self, pred_value: Tensor, target_value: Tensor) -> Tensor:
        """Sum over critics of their distance from the TD target, ``[B]``.

        Squared with the default ``loss_function="l2"``.

        Args:
            pred_value: :math:`Q_i(s, a)`, ``[N, B]``.
            target_value: ``[B]``.
        """
        target_value = target_value.expand_as(pred_value)
        distance: Tensor = distance_loss(
            pred_value, target_value, self.loss.loss_function
        )
        return distance.sum(0)

    def write_priority(self, pred_value: Tensor, target_value: Tensor) -> None:
        """Write the critics' largest absolute TD error, ``[B]``, into the batch."""
        td_error = (pred_value.detach() - target_value).abs().amax(0)
        self.tensordict.set(self.loss.tensor_keys.priority, td_error)

    def reduce(self, value: Tensor, *, transitions: bool = False) -> Tensor:
        """``[B]`` reduced as asked; with ``transitions``, over those of the data."""
        valid = self.transitions if transitions else None
        return self.loss._reduce(value, self.tensordict, valid)

    @property
    def transitions(self) -> Tensor:
        """Rows of the data that are not done, bool ``[B]``."""
        return ~self.done if self.of_data is None else ~self.done & self.of_data

    def cloned(self, distance: Tensor) -> Tensor:
        """Distances to the data's action, ``[B]``; 0 where it is not the data's."""
        if self.of_data is None:
            return distance
        return torch.where(self.of_data, distance, torch.zeros_like(distance))

    def magnitude(self, value: Tensor) -> Tensor:
        """The mean magnitude of values ``[B]``, detached; 1 where it is 0.

        To divide by: of no row, or of critics that start at 0, it would be 0.
        """
        mean = self.mean(value.abs())
        return torch.where(mean == 0, torch.ones_like(mean), mean)

    def mean(self, value: Tensor, *, transitions: bool = False) -> Tensor:
        """The mean of a metric ``[..., B]``, detached."""
        valid = self.transitions if transitions else None
        return self.loss._mean(value, self.tensordict, valid)


def uniform_actions(
    number: int, like: Tensor, low: Tensor, high: Tensor
) -> tuple[Tensor, Tensor]:
    """``number`` uniform actions for each row.

    Args:
        number: of actions, ``K``.
        like: an action, ``[B, A]``.
        low, high: bounds, numbers or ``[A]``.

    Returns:
        Actions ``[K, B, A]`` and their log-densities ``[K, B]``.
    """
    width = (high - low).expand(like.shape[-1])
    action = torch.rand((number, *like.shape), dtype=like.dtype, device=like.device)
    log_density = -width.log().sum().expand(action.shape[:-1])
    return action * width + low, log_density
