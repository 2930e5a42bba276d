r"""The base of the losses: keys, networks, the unpacked batch, targets, reduction.

Shapes: ``B`` batch (any leading dimensions), ``R`` rows (all of ``B`` in one), ``A``
action, ``N`` critics, ``K`` sampled actions of a kind. ``D`` sets of states are 2 for
D_tot (clean and perturbed), 1 for either alone.

Networks are called with one batch dimension, as by TorchRL's own losses: ``D`` sets of
``R`` rows are ``D * R`` rows.
"""

from __future__ import annotations

import copy
import math
import warnings
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, Literal, Self

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictParams,
    dispatch,
    set_interaction_type,
)
from torch import Tensor, nn
from torchrl.modules import GRUModule, LSTMModule
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import LossModule, ValueEstimators, distance_loss
from torchrl.objectives.utils import _vmap_func, dispatch_value_estimator

from torchrl_osr import functional as F
from torchrl_osr._checks import (
    check_at_least,
    check_choice,
    check_positive,
    check_weight,
)
from torchrl_osr._entries import column, is_next, nested, state_keys
from torchrl_osr.objectives.networks import (
    action_bounds,
    check_action,
    check_networks,
    check_same_bounds,
    distribution,
    distribution_params,
    full_precision,
    squashing_bounds,
    written_entry,
)
from torchrl_osr.objectives.transitions import (
    SETS,
    States,
    TransitionKeys,
    Transitions,
    check_single_steps,
    next_states,
)

Losses = tuple[dict[str, Tensor], dict[str, Tensor]]
"""The losses and the metrics of a batch, by name."""


class StatePolicy:
    """The policy at all states of a batch: ``policy["both"]`` is a distribution."""

    def __init__(
        self, network: ProbabilisticTensorDictSequential, params: TensorDictBase
    ) -> None:
        self._network, self._params = network, params
        self._built: dict[str, Any] = {}

    def __getitem__(self, states: str) -> Any:
        """Return the distribution at a set of states in :data:`SETS`, ``[D, R]``."""
        if states not in self._built:
            with torch.enable_grad():  # kept for those who ask with gradient, later
                params = self._params[SETS[states]]
                self._built[states] = self._network.build_dist_from_params(params)
        return self._built[states]


class Critics:
    """Evaluate the critics of a loss; :mod:`torchrl_osr.fast` has a faster one."""

    def __init__(self, loss: ActorCriticLoss) -> None:
        self.loss = loss

    def values(
        self, states: TensorDictBase, action: Tensor, params: TensorDictBase
    ) -> Tensor:
        """Return the values of all critics, ``[N, ..., R]``, of actions at states."""
        keys = self.loss.tensor_keys
        read = state_keys(self.loss.qvalue_network.in_keys)
        rows = states.select(*read, strict=False).reshape(-1)
        rows = rows.set(keys.action, action.flatten(0, -2))
        value = self.loss.critic_output(rows, params, keys.state_action_value)
        return value.reshape(-1, *action.shape[:-1])

    def values_and_soft_maximum(
        self, states: TensorDictBase, compared: Tensor, *sampled: Tensor, alike: bool
    ) -> tuple[Tensor, Tensor]:
        """Return both terms of CQL(H) at states ``[R]``, ``[N, R]`` each.

        They are the values of the actions ``compared``, ``[R, A]``, and the log-sum-exp
        over actions ``[M, R, A]`` with log-densities ``[M, R]``. ``alike``: every row
        has the same weight in the loss.
        """
        action, log_prob = sampled
        action = torch.cat([compared.unsqueeze(0), action])
        params = self.loss.qvalue_network_params
        qvalue = self.values(states.expand(action.shape[:-1]), action, params)
        return qvalue[:, 0], F.soft_maximum(
            qvalue[:, 1:].movedim(1, -1),
            log_prob.movedim(0, -1),
            temperature=self.loss.temperature,
        )


class ActorCriticLoss(LossModule):
    """Abstract base of the losses.

    A loss registers its networks in its constructor, calls :meth:`declare`, and
    computes :meth:`losses`. The order of ``in_keys`` is fixed, unlike TorchRL 0.14.1's.

    Coefficients (``min_q_weight``, ``recovery_weight``, ``gamma``) are options, not
    state: :meth:`load_state_dict` keeps those of the loss that it loads into.

    Keyword Args:
        num_qvalue_nets: number of critics ``N`` where a loss is given a single one,
            which TorchRL copies; a list has its own length. Default 2.
        loss_function: distance of the TD error: ``"l2"`` (default), ``"l1"`` or
            ``"smooth_l1"``.
        deactivate_vmap: run the critics one by one. Default ``False``.
        reduction: ``"mean"`` (default), ``"sum"``, or ``"none"``: no metrics.
        use_prioritized_weights: weigh rows by ``"priority_weight"``, if present.
            Default ``True``.
    """

    _AcceptedKeys = default_keys = TransitionKeys
    tensor_keys: TransitionKeys

    # convert_to_functional wants every network that a loss may hold annotated.
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    qvalue_network: TensorDictModule
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams
    inverse_dynamics_network: ProbabilisticTensorDictSequential
    inverse_dynamics_network_params: TensorDictParams
    target_inverse_dynamics_network_params: TensorDictParams

    _value_estimator_default_keys = (  # set_keys passes these on
        *("value", "reward", "done", "terminated", "steps_to_next_obs"),
    )
    # Losses without CQL's term; TorchRL's CQLTrainer asks for with_lagrange.
    has_cql = max_q_backup = deterministic_backup = with_lagrange = False
    reads_perturbed = False

    def __init__(
        self,
        *,
        num_qvalue_nets: int = 2,
        loss_function: Literal["l2", "l1", "smooth_l1"] = "l2",
        deactivate_vmap: bool = False,
        reduction: Literal["none", "mean", "sum"] = "mean",
        use_prioritized_weights: bool = True,
    ) -> None:
        super().__init__()
        check_choice("reduction", reduction, ("mean", "sum", "none", None))
        self.num_qvalue_nets = num_qvalue_nets
        self.loss_function: str = loss_function
        self.deactivate_vmap = deactivate_vmap
        self.use_prioritized_weights = use_prioritized_weights
        self.reduction = reduction or "mean"
        self.critics = Critics(self)
        self._bounds_are_checked = False

    @abstractmethod
    def losses(self, batch: Transitions) -> Losses:
        """Return the losses, which train their own parameters only, and the metrics."""

    # -- networks ---------------------------------------------------------------------

    def register_actor_critic(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        delay_actor: bool = False,
    ) -> None:
        """Register an actor, its bounds, and critics: one to be copied, or a list."""
        check_networks(actor_network=actor_network, qvalue_network=qvalue_network)
        self.register_bounds(squashing_bounds(actor_network))
        self.convert_to_functional(
            actor_network, "actor_network", create_target_params=delay_actor
        )
        self.register_critics(qvalue_network)

    def register_critics(
        self, qvalue_network: TensorDictModule | Sequence[TensorDictModule]
    ) -> None:
        """Register critics, with targets: one to be copied, or a list; set TD(0)."""
        check_networks(qvalue_network=qvalue_network)
        if isinstance(qvalue_network, Sequence):
            self.num_qvalue_nets = len(qvalue_network)
        check_at_least(1, "num_qvalue_nets", self.num_qvalue_nets)
        given = qvalue_network, "qvalue_network", self.num_qvalue_nets
        self.convert_to_functional(*given, create_target_params=True)
        if isinstance(qvalue_network, Sequence) and self.num_qvalue_nets == 1:
            # TorchRL 0.14.1 keeps a list of one as expanded views of its parameters,
            # which no optimizer finds in loss.parameters().
            def copied(tensor: Tensor) -> Tensor:
                own = tensor.detach().clone()
                return nn.Parameter(own) if tensor.requires_grad else own

            own = self.qvalue_network_params.apply(copied, filter_empty=False)
            self.qvalue_network_params = TensorDictParams(own, no_convert=True)
        self._make_vmap()
        self.make_value_estimator()

    def convert_to_functional(
        self, module: Any, module_name: str, *args: Any, **options: Any
    ) -> None:
        """Register a network, as TorchRL does; refuse a recurrent one."""
        each = nn.ModuleList(module if isinstance(module, Sequence) else [module])
        if any(isinstance(part, (GRUModule, LSTMModule)) for part in each.modules()):
            raise ValueError(
                f"{module_name} is recurrent, but all steps of a batch are rows here: "
                "give it stacked states instead (TorchRL's CatFrames)."
            )
        super().convert_to_functional(module, module_name, *args, **options)

    def register_frozen(self, name: str, network: nn.Module) -> None:
        """Register a trained network frozen: in the state dict, moved by ``.to()``.

        Its parameters become buffers, which an optimizer of ``loss.parameters()``
        cannot move. They share the network's memory.
        """
        actor = getattr(self, "actor_network", None)
        check_networks(actor_network=actor, **{name: network})
        self.convert_to_functional(network, name)
        # tensordict 0.14.3 leaves a network without parameters in an error, so this is
        # a copy. It has the same tensors, and neither drops units nor counts batches.
        own = {id(each): each for each in (*network.parameters(), *network.buffers())}
        self.__dict__[name] = copy.deepcopy(network, own).eval()
        frozen = getattr(self, f"{name}_params").data
        setattr(self, f"{name}_params", TensorDictParams(frozen, no_convert=True))

    def _reset_module_parameters(self, module_name: str, module: nn.Module) -> None:
        # TorchRL's reset_parameters_recursive would redraw a trained, frozen model.
        if any(True for _ in getattr(self, f"{module_name}_params").parameters()):
            super()._reset_module_parameters(module_name, module)

    def register_soft_actor_critic(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        alpha_init: float,
        target_entropy: float | Literal["auto"],
    ) -> None:
        """Register a tanh-Gaussian actor, critics, and SAC's entropy temperature."""
        action_bounds(actor_network, "actor_network")  # or a TypeError
        self.register_actor_critic(actor_network, qvalue_network)
        self.register_temperature(alpha_init, target_entropy)

    def register_model(self, network: TensorDictModuleBase) -> None:
        """Register a trained inverse dynamics model with the actor's bounds, frozen."""
        name = "inverse_dynamics_network"
        own = self.action_low, self.action_high
        check_same_bounds(own, action_bounds(network, name))
        self.register_frozen(name, network)

    def register_bounds(self, bounds: Iterable[Tensor]) -> None:
        """Register low and high of the action, each a number or ``[A]``, if any."""
        for name, bound in zip(("action_low", "action_high"), bounds, strict=False):
            self.register_buffer(name, bound, persistent=False)

    def scalar(self, value: float) -> Tensor:
        """Return a number as a tensor on the networks' device."""
        return torch.tensor(float(value), device=next(self.parameters()).device)

    def register_coefficient(self, name: str, value: float) -> None:
        """Register the weight of a term, which may be assigned later."""
        check_weight(name, value)
        self.register_buffer(name, self.scalar(value), persistent=False)

    def register_temperature(
        self, alpha_init: float, target_entropy: float | Literal["auto"]
    ) -> None:
        """Register the logarithm of SAC's entropy temperature, ``log_alpha``."""
        check_positive("alpha_init", alpha_init)
        self.target_entropy = target_entropy
        self.log_alpha = nn.Parameter(self.scalar(math.log(alpha_init)))

    def _make_vmap(self) -> None:
        if "qvalue_network" in self.__dict__:
            self._vmap_qvalue = _vmap_func(
                self.qvalue_network, (None, 0), randomness=self.vmap_randomness
            )

    def make_value_estimator(
        self,
        value_type: ValueEstimators | str | None = None,
        *,
        gamma: float = 0.99,
    ) -> Self:
        """Set the discount of the TD(0) target."""
        names = self._value_estimator_default_keys
        estimator = dispatch_value_estimator(
            self,
            value_type or ValueEstimators.TD0,
            supported=(ValueEstimators.TD0,),
            tensor_keys={name: getattr(self.tensor_keys, name) for name in names},
            value_network=None,
            gamma=gamma,
        )
        estimator.register_buffer("gamma", estimator.gamma, persistent=False)
        return self

    # -- keys -------------------------------------------------------------------------

    def declare(self, losses: Iterable[str], metrics: Iterable[str]) -> None:
        """Name what the loss writes, in this order."""
        self.out_keys = [*losses, *(metrics if self.reduction != "none" else ())]
        self._set_in_keys()

    def declare_soft_actor_critic(self, *metrics: str) -> None:
        """Name what the losses with SAC's actor write, and further metrics."""
        losses = ["loss_actor", "loss_alpha", "loss_qvalue"]
        shared = ["alpha", "entropy", "pred_value", "target_value"]
        if self.has_cql:
            losses.append("loss_cql")
        if self.with_lagrange:
            losses.append("loss_alpha_prime")
            shared.append("alpha_prime")
        self.declare(losses, [*shared, *metrics])

    @property
    def observation_keys(self) -> list[NestedKey]:
        """The state entries that actor, critics and a value network read."""
        names = ("actor_network", "qvalue_network", "value_network")
        networks = (getattr(self, name) for name in names if name in self.__dict__)
        keys = [key for network in networks for key in network.in_keys]
        return state_keys(keys, self.tensor_keys.action)

    def input_keys(self) -> list[NestedKey]:
        """Return the entries that actor, critics and model read, in order."""
        keys, states = self.tensor_keys, self.observation_keys
        following = [*states, keys.reward, keys.done, keys.terminated]
        network = self.__dict__.get("inverse_dynamics_network")
        model = getattr(network, "in_keys", [])
        following = [nested("next", key) for key in following]
        found = [*states, keys.action, *following, *model]
        if self.reads_perturbed:
            below = [*states, *state_keys(model)]
            found += [nested(keys.perturbed, key) for key in below]
        return found

    def _set_in_keys(self) -> None:
        """Name the entries that the loss reads; TorchRL calls this in ``set_keys``."""
        self.in_keys = list(dict.fromkeys(self.input_keys()))

    # -- the call ---------------------------------------------------------------------

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses and metrics of a batch, see ``out_keys``.

        A loss with critics writes the largest absolute TD error of them under the
        ``priority`` key, ``[B]``; nothing else is written into ``tensordict``.
        """
        if not tensordict.batch_size.numel():
            raise ValueError(
                f"The batch is empty (batch_size {tuple(tensordict.batch_size)}): its "
                "mean needs at least one transition."
            )
        losses, metrics = self.losses(self.unpack(tensordict))
        found = losses | metrics
        size = tensordict.batch_size if self.reduction == "none" else []
        out = TensorDict({name: found[name] for name in self.out_keys}, size)
        params = [name for name in self._modules if name.endswith("_params")]
        self._clear_weakrefs(tensordict, out, *params)
        return out

    def unpack(self, tensordict: TensorDictBase) -> Transitions:
        """Return the batch as named tensors, see :class:`Transitions`."""
        # To the end: torch.compile cannot leave an iterator of a dictionary halfway.
        name, *_ = (name for name in self._modules if name.endswith("_params"))
        tensors = getattr(self, name).values(True, True)
        dtype, *_ = (each.dtype for each in tensors if each.is_floating_point())
        keys, masks = self.tensor_keys, self._loss_mask_keys()
        batch = Transitions(tensordict, self.in_keys, keys, masks, dtype)
        action = batch.rows.get(keys.action, None)
        if action is not None and "action_low" in self._buffers:  # may be stored as int
            batch.rows.set(keys.action, action.to(dtype))
        if "qvalue_network" in self.__dict__:
            batch.stack_states(self.observation_keys, perturbed=self.reads_perturbed)
        return batch

    # -- networks at states -----------------------------------------------------------

    def policy(self, batch: Transitions) -> StatePolicy:
        """Return the policy at all states of a batch, in one call of the actor."""
        network, params = self.actor_network, self.actor_network_params
        return StatePolicy(network, distribution_params(network, params, batch.states))

    def act(self, states: TensorDictBase, params: TensorDictParams) -> Tensor:
        """Return the actions that a deterministic policy writes, ``[..., R, A]``."""
        key = self.tensor_keys.action
        return written_entry(self.actor_network, params, states, key)

    def inverse_dynamics(self, batch: Transitions, states: States) -> Any:
        """Return the frozen model ``I(a | s~, s')``, ``[D, R]``, without gradient.

        A latent variable stays at its mean: the label must not jitter.
        """
        network = self.inverse_dynamics_network
        inputs = self.model_inputs(batch, network.in_keys, states)
        with torch.no_grad(), set_interaction_type(InteractionType.DETERMINISTIC):
            return distribution(network, self.inverse_dynamics_network_params, inputs)

    def model_inputs(
        self, batch: Transitions, in_keys: Sequence[NestedKey], states: States
    ) -> TensorDictBase:
        """Return what an inverse dynamics model reads; ``s'`` is never perturbed."""
        inputs = batch.states_of(state_keys(in_keys), states)
        after = [unravel_key(key[1:]) for key in in_keys if is_next(key)]
        if after:
            check_single_steps(batch, "the inverse dynamics model")
            following = next_states(batch.one_step, after, batch.done)
            inputs.set("next", following.expand(*inputs.batch_size))
        return inputs

    def q(
        self,
        states: TensorDictBase,
        action: Tensor,
        params: TensorDictBase | None = None,
    ) -> Tensor:
        """Return the values of all critics, ``[N, ..., R]``, by default the trained."""
        if params is None:
            params = self.qvalue_network_params
        return self.critics.values(states, action, params)

    def critic_output(
        self, rows: TensorDictBase, params: TensorDictBase, key: NestedKey
    ) -> Tensor:
        """Return the entry ``key`` that all critics write at rows, ``[N, R, ...]``."""
        network = self.qvalue_network
        if key not in network.out_keys:
            raise KeyError(
                f"The critics write {network.out_keys}, not {key!r}: give them that "
                "out_key, or name theirs with set_keys()."
            )
        if not self.deactivate_vmap:
            return full_precision(self._vmap_qvalue(rows, params)).get(key)
        values = []
        # Not TorchRL 0.14.1's loop, which torch.compile traces at every call.
        for each in params.unbind(0):
            with each.to_module(network, preserve_module_state=False):
                values.append(full_precision(network(rows.copy())).get(key))
        return torch.stack(values)

    # -- terms ------------------------------------------------------------------------

    @property
    def frozen_critics(self) -> TensorDictBase:
        """The critics' parameters; the policy's objective must not train them."""
        # detach() keeps what it has returned for a list of critics while they move to
        # another device or type (tensordict 0.14.3).
        return self.qvalue_network_params.data

    @property
    def alpha(self) -> Tensor:
        """SAC's entropy temperature, detached."""
        return self.log_alpha.detach().exp()

    def soft_policy_objective(
        self, batch: Transitions, policy: StatePolicy, states: States
    ) -> tuple[Tensor, Tensor]:
        """Return SAC's objective on a set of states, to be minimised, ``[R]``.

        Also the log-density of the policy's own actions, ``[D, R]``.
        """
        action, log_prob = rsample_and_log_prob(policy[states])
        self.check_actions(batch, action.shape[1:])
        qvalue = self.q(batch.states[SETS[states]], action, self.frozen_critics)
        return F.soft_policy_value(log_prob, qvalue, self.alpha).mean(0), log_prob

    def soft_actor_losses(
        self,
        batch: Transitions,
        objective: Tensor,
        log_prob: Tensor,
        auto: float | None = None,
    ) -> Losses:
        """Return the losses of SAC's policy and temperature, and their metrics.

        Arguments: the results of :meth:`soft_policy_objective`; ``auto`` is the target
        entropy of ``"auto"``, by default minus the number of the action's dimensions.
        """
        wanted = self.target_entropy
        if wanted == "auto":
            wanted = -batch.a.shape[-1] if auto is None else auto
        temperature = F.temperature_objective(self.log_alpha, log_prob, wanted)
        losses = {
            "loss_actor": self.reduce(objective, batch),
            "loss_alpha": self.reduce(temperature.mean(0), batch),
        }
        entropy = -self.mean(log_prob, batch)
        return losses, {"alpha": self.alpha, "entropy": entropy}

    @torch.no_grad()
    def proposals(
        self, batch: Transitions, policy: StatePolicy, states: str = "recorded"
    ) -> tuple[Tensor, Tensor]:
        """Draw ``K`` actions each: uniform, and at two sets of states, ``[3K, R, A]``.

        The default sets are those of CQL(H). Also return log-densities, ``[3K, R]``.
        """
        number, width = (self.num_random,), self.action_high - self.action_low
        shape = *number, *batch.a.shape
        uniform = torch.rand(shape, dtype=batch.a.dtype, device=batch.a.device)
        uniform = uniform * width + self.action_low
        log_density = -width.expand(shape[-1]).log().sum().expand(shape[:-1])
        # rsample also without gradient: torch's sample reads the scale back to the host
        # to check its sign.
        action, log_prob = rsample_and_log_prob(policy[states], number)
        action = torch.cat([uniform, action.flatten(0, 1)])
        return action, torch.cat([log_density, log_prob.flatten(0, 1)])

    @torch.no_grad()
    def soft_target(self, batch: Transitions, policy: StatePolicy) -> Tensor:
        """Return the TD target of an action of the policy at ``s'``, ``[R]``."""
        states, pi = batch.states[SETS["next"]], policy["next"]
        number = (self.num_random,) if self.max_q_backup else ()
        action, log_prob = rsample_and_log_prob(pi, number)
        params = self.target_qvalue_network_params
        qvalue = self.q(states.expand(action.shape[:-1]), action, params)
        if self.max_q_backup:  # the entropy is that of the best action, as in CORL
            best = F.bootstrap_value(qvalue).argmax(0, keepdim=True)
            qvalue = qvalue.take_along_dim(best.unsqueeze(0), 1)
            log_prob = log_prob.take_along_dim(best, 0)
        entropy = () if self.deterministic_backup else (log_prob, self.alpha)
        next_value = F.bootstrap_value(qvalue, *entropy)
        return self.td_target(batch, next_value.flatten())

    def td_target(self, batch: Transitions, next_value: Tensor) -> Tensor:
        r"""Return :math:`r + \gamma (1 - \text{terminated}) V(s')`, ``[R]``.

        ``terminated``, not ``done``: a time-out cuts the recording, not the task. The
        value :math:`V(s')` is ``[R]``.
        """
        rows, after = batch.rows, next_value.unsqueeze(-1)
        column(rows, nested("next", self.tensor_keys.reward))
        return self.value_estimator.value_estimate(rows, next_value=after).reshape(-1)

    def td_error(
        self, batch: Transitions, pred_value: Tensor, target: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the distance of values ``[N, R]`` from a target ``[R]``, and metrics.

        It is summed over critics, which may have a target each, ``[N, R]``. The largest
        absolute error is written as priority, 0 for masked rows.
        """
        error = (pred_value.detach() - target).abs().amax(0)
        error = error if batch.unmasked is None else error * batch.unmasked
        given = batch.tensordict
        given.set(self.tensor_keys.priority, error.reshape(given.batch_size))
        wide = target.expand_as(pred_value)
        distance: Tensor = distance_loss(pred_value, wide, self.loss_function)
        found, wanted = (self.mean(each, batch) for each in (pred_value, target))
        return distance.sum(0), {"pred_value": found, "target_value": wanted}

    def check_actions(self, batch: Transitions, shape: torch.Size) -> None:
        """Raise unless actions fit; warn if the first batch's leave the bounds."""
        check_action(batch.a, shape, self.tensor_keys.action)
        bounded = "action_low" in self._buffers
        if self._bounds_are_checked or not bounded or torch.compiler.is_compiling():
            return
        self._bounds_are_checked = True
        low, high = self.action_low, self.action_high
        margin = 1e-4 * (high - low)
        outside = ((batch.a < low - margin) | (batch.a > high + margin)).any(-1)
        found = batch.counted(outside)  # masked rows are zeros
        if found is not None and bool(found.any()):
            warnings.warn(
                f"The data's actions leave the bounds of the networks, {low.tolist()} "
                f"and {high.tolist()}, where the policy has no density: build actor "
                "and inverse dynamics model with low= and high= of the environment.",
                stacklevel=2,
            )

    # -- reduction --------------------------------------------------------------------

    def reduce(
        self, value: Tensor, batch: Transitions, valid: Tensor | None = None
    ) -> Tensor:
        """Return a loss ``[R]`` reduced as asked, with the batch's masks and weights.

        Only ``valid`` rows count, bool ``[R]``; the others are 0 under ``"none"``. A
        mean over no row, or over weights of 0, is 0.
        """
        weights, counted = self._weights(batch), batch.counted(valid)
        if counted is not None:
            # Selected, not multiplied: 0 * nan is nan in the backward pass, too.
            value = torch.where(counted, value, torch.zeros_like(value))
            if weights is not None:
                weights = torch.where(counted, weights, torch.zeros_like(weights))
        if weights is not None:
            weights = weights.to(value.dtype)
            value = value * weights
        if self.reduction == "none":
            return value.reshape(batch.tensordict.batch_size)
        if self.reduction == "sum":
            return value.sum()
        if weights is not None:
            total = weights.sum()
            return value.sum() / torch.where(total == 0, torch.ones_like(total), total)
        return _mean(value, counted)

    def mean(
        self, value: Tensor, batch: Transitions, valid: Tensor | None = None
    ) -> Tensor:
        """Return the detached mean of a metric ``[..., R]`` over rows that count."""
        value = value.detach().reshape(-1, value.shape[-1]).mean(0)
        counted = batch.counted(valid)
        if counted is not None:
            value = torch.where(counted, value, torch.zeros_like(value))
        return _mean(value, counted)

    def _weights(self, batch: Transitions) -> Tensor | None:
        """Return the rows' importance weights ``[R]``, if there and to be used."""
        given, key = batch.tensordict, self.tensor_keys.priority_weight
        # Not TorchRL's _maybe_get_priority_weight, which fails with a nested key.
        weights: Tensor | None = given.get(key, None)
        if weights is None or not self.use_prioritized_weights:
            return None
        if weights.shape not in (given.batch_size, (*given.batch_size, 1)):
            raise ValueError(
                f"{key!r} has shape {tuple(weights.shape)}, expected one weight a row: "
                f"{tuple(given.batch_size)}."
            )
        return weights.reshape(-1)

    def rows_weigh_alike(self, batch: Transitions) -> bool:
        """Return whether every row's term has the same weight in a reduced loss."""
        alike = batch.counted(batch.is_data) is None and self._weights(batch) is None
        return self.reduction != "none" and alike


def _mean(value: Tensor, counted: Tensor | None) -> Tensor:
    """Return the mean of rows ``[R]``; rows that do not count are 0."""
    return value.mean() if counted is None else value.sum() / counted.sum().clamp(min=1)
