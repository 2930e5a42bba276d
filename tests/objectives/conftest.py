"""The family of losses: how each is built, and what its contract says.

A test marked ``losses`` runs once for every loss, with its name as the argument
``name``; ``losses("osr", "cql")`` runs for these, and ``losses(having="critics")``
for those with a property in ``PROPERTIES``. ``family`` and ``family_batch`` build what
the name says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from tensordict import NestedKey, TensorDict, unravel_key
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.modules import (
    MLP,
    Actor,
    OneHotCategorical,
    ProbabilisticActor,
    TanhDelta,
)
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_osr import (
    DiscreteOSRLoss,
    InverseDynamicsLoss,
    OSRLoss,
    OSRVLoss,
    StateRecoveryLoss,
)
from torchrl_osr.lab.dynamics import ConditionalVAE, DynamicsEnsemble
from torchrl_osr.lab.losses import (
    EDACLoss,
    ReBRACLoss,
    RORLLoss,
    SCASLoss,
    SDCLoss,
    TD3BCLoss,
)
from torchrl_osr.modules import cvae_inverse_dynamics

NUM_ACTIONS = 4


@pytest.fixture
def make_discrete_networks():
    """Return a factory of a categorical actor, critics and model, float64.

    Built from TorchRL alone, with any keys; equal seeds give equal weights.
    """

    def make(
        *,
        observation="observation",
        action="action",
        num_critics: int = 2,
        seed: int = 0,
        distribution_class: type = OneHotCategorical,
        num_actions: int = NUM_ACTIONS,
        num_model_actions: int = NUM_ACTIONS,
        num_critic_actions: int = NUM_ACTIONS,
    ) -> SimpleNamespace:
        torch.manual_seed(seed)

        def probabilistic(number: int, *inputs) -> ProbabilisticActor:
            network = MLP(len(inputs) * 3, number, num_cells=[8])
            return ProbabilisticActor(
                TensorDictModule(network, list(inputs), ["logits"]),
                in_keys=["logits"],
                out_keys=[action],
                distribution_class=distribution_class,
            ).double()

        following = unravel_key(("next", observation))
        return SimpleNamespace(
            actor=probabilistic(num_actions, observation),
            critics=[
                TensorDictModule(
                    MLP(3, num_critic_actions, num_cells=[8]),
                    [observation],
                    ["action_value"],
                ).double()
                for _ in range(num_critics)
            ],
            inverse_dynamics=probabilistic(num_model_actions, observation, following),
        )

    return make


@pytest.fixture
def make_discrete_batch(make_batch):
    """Return a factory of ``make_batch``'s transitions with one-hot actions."""

    def make(*size: int, twin: bool = True) -> TensorDict:
        batch = make_batch(*size, twin=twin)
        generator = torch.Generator().manual_seed(8)
        index = torch.randint(NUM_ACTIONS, size, generator=generator)
        batch["action"] = torch.nn.functional.one_hot(index, NUM_ACTIONS)
        return batch

    return make


class Squash(nn.Module):
    """The last layer of a plain actor: a tanh and the action's bounds."""

    def __init__(self, low=-1.0, high=1.0) -> None:
        super().__init__()
        self.center, self.half = (high + low) / 2, (high - low) / 2

    def forward(self, value: Tensor) -> Tensor:
        return self.center + self.half * torch.tanh(value)


def deterministic_actor(
    kind: str, *, observation="observation", action="action", seed: int = 0, **bounds
):
    """A deterministic actor, float64.

    Args:
        kind: ``"delta"`` ends in a TanhDelta, ``"actor"`` is TorchRL's Actor,
            ``"module"`` a bare module.
        observation, action: its keys.
        seed: of the weights.
        bounds: ``low``, ``high`` and further options of the TanhDelta.
    """
    torch.manual_seed(seed)
    mlp = MLP(3, 2, num_cells=[8])
    if kind == "delta":
        return ProbabilisticActor(
            TensorDictModule(mlp, [observation], ["param"]),
            in_keys=["param"],
            out_keys=[action],
            distribution_class=TanhDelta,
            distribution_kwargs=bounds,
        ).double()
    network = nn.Sequential(mlp, Squash(**bounds))
    actor_class = Actor if kind == "actor" else TensorDictModule
    return actor_class(network, in_keys=[observation], out_keys=[action]).double()


@pytest.fixture
def make_deterministic_actor():
    """Return a factory, see :func:`deterministic_actor`."""
    return deterministic_actor


def latent_model(*, observation, action, seed: int):
    """The conditional VAE, float64; ``action`` is not among its inputs."""
    torch.manual_seed(seed)
    model = cvae_inverse_dynamics(3, 2, latent_dim=2, num_cells=[8]).double()
    model.in_keys = [observation, unravel_key(("next", observation))]
    model[0].in_keys = model.in_keys
    return model


def dynamics_ensemble(*, observation, action, seed: int) -> DynamicsEnsemble:
    """A model of the dynamics, float64, whose networks are far apart."""
    torch.manual_seed(seed)
    keys = {"observation_key": observation, "action_key": action}
    model = DynamicsEnsemble(3, 2, num_networks=2, num_elites=2, num_cells=[6], **keys)
    for each in model.parameters():
        nn.init.normal_(each, std=0.5)
    return model.double()


def transition_vae(*, observation, action, seed: int) -> ConditionalVAE:
    """A model of the states that follow, float64; ``action`` is none of its entries."""
    torch.manual_seed(seed)
    following = unravel_key(("next", observation))
    keys = {"condition_key": observation, "target_key": following}
    return ConditionalVAE(3, 3, change=True, num_cells=[6], **keys).double()


ACTOR, CRITICS, MODEL = (
    f"{network}_network_params" for network in ("actor", "qvalue", "inverse_dynamics")
)
NEXT, PERTURBED = ("next", "observation"), ("perturbed", "observation")
TRANSITION = ["observation", "action", NEXT]
TRANSITION += [("next", key) for key in ("reward", "done", "terminated")]
NEXT_ACTION = ("next", "action")
MODEL_KEYS = {key: key for key in ("action", "done", "perturbed")}
RECOVERY_KEYS = MODEL_KEYS | {"priority_weight": "priority_weight"}
CRITIC_KEYS = RECOVERY_KEYS | {
    "value": "state_value",
    "reward": "reward",
    "terminated": "terminated",
    "priority": "td_error",
    "state_action_value": "state_action_value",
}


@dataclass(frozen=True)
class Member:
    """A loss: the class and its options, and what the contract expects.

    Attributes:
        loss_class: is given those of the networks that it takes, and ``options``.
        groups: the parameters that each ``loss_*`` trains, in the order of the losses.
        metrics: what else it writes, after the losses.
        in_keys: what it reads, in this order.
        keys: what can be renamed, with the defaults.
        options: keywords of the loss.
        networks: keywords of the networks' factory.
        replace: factories of networks that stand in the place of the usual ones.
        discrete: whether actions are.
    """

    loss_class: type[LossModule]
    groups: dict[str, str]
    metrics: list[str]
    in_keys: list[NestedKey]
    keys: dict[str, str]
    options: dict[str, object] = field(default_factory=dict)
    networks: dict[str, object] = field(default_factory=dict)
    replace: dict[str, Callable] = field(default_factory=dict)
    discrete: bool = False

    @property
    def out_keys(self) -> list[str]:
        return [*self.groups, *self.metrics]

    @property
    def parts(self) -> list[str]:
        """The networks that the loss is given, in this order."""
        if self.loss_class is InverseDynamicsLoss:
            return ["inverse_dynamics"]
        if self.loss_class is StateRecoveryLoss:
            return ["actor", "inverse_dynamics"]
        if self.loss_class in (SCASLoss, SDCLoss):
            models = [each for each in self.replace if each != "actor"]
            return ["actor", "critics", *models]
        without = (EDACLoss, RORLLoss, ReBRACLoss, TD3BCLoss)
        with_model = self.loss_class not in without
        return ["actor", "critics", *["inverse_dynamics"] * with_model]

    @property
    def frozen(self) -> list[str]:
        """The parameters that it holds and does not train, but for targets."""
        models = {*self.parts} - {"actor", "critics"}
        if not PROPERTIES["model"](self):
            models -= {"inverse_dynamics"}
        return [f"{model}_network_params" for model in sorted(models)]

    @property
    def index(self) -> bool:
        """Whether actions are indices and not one-hot."""
        return self.networks.get("distribution_class") is Categorical

    @property
    def recovery_metric(self) -> str | None:
        """The metric that is the unweighted recovery term, if there is one."""
        return next((key for key in self.metrics if key.startswith("recovery_")), None)

    @property
    def weights(self) -> dict[str, list[str]]:
        """The coefficients that may be assigned, and the losses that hold their terms.

        ``loss_cql`` and ``loss_alpha_prime`` are such terms and nothing else.
        """
        found = {}
        if self.recovery_metric:
            holder = {OSRVLoss: "loss_qvalue", StateRecoveryLoss: "loss_recovery"}
            found["recovery_weight"] = [holder.get(self.loss_class, "loss_actor")]
        if "loss_cql" in self.groups:
            keys = ("loss_cql", "loss_alpha_prime")
            found["min_q_weight"] = [key for key in keys if key in self.groups]
        if self.loss_class is EDACLoss:
            found["diversity_weight"] = ["loss_qvalue"]
        return found


PROPERTIES: dict[str, Callable[[Member], bool]] = {
    "critics": lambda member: "loss_qvalue" in member.groups,
    "temperature": lambda member: "loss_alpha" in member.groups,
    "recovery": lambda member: "recovery_weight" in member.weights,
    # An inverse dynamics model that was trained before and is frozen.
    "model": lambda member: (
        "recovery_weight" in member.weights
        and member.options.get("recovery_target") != "data"
    ),
    # Reads the next state as the one that the action leads to.
    "inverse dynamics": lambda member: (
        PROPERTIES["model"](member) or member.loss_class is InverseDynamicsLoss
    ),
    "cql": lambda member: "loss_cql" in member.groups,
    "perturbed": lambda member: PERTURBED in member.in_keys,
    "priority weight": lambda member: "priority_weight" in member.keys,
    "weights": lambda member: member.weights != {},
    # SCAS has in one loss a term of all rows and one of those with a next state.
    "rows that count alike": lambda member: member.loss_class is not SCASLoss,
    "weights of rows": lambda member: (
        PROPERTIES["priority weight"](member)
        and PROPERTIES["rows that count alike"](member)
    ),
}


def actor_critic(
    loss_class: type[LossModule],
    groups: dict[str, str],
    *metrics: str,
    perturbed: bool = True,
    networks: dict[str, object] | None = None,
    **options: object,
) -> Member:
    """A soft actor-critic loss: its own terms, metrics and options."""
    discrete, draws = loss_class is DiscreteOSRLoss, loss_class in (OSRLoss, OSRVLoss)
    return Member(
        loss_class,
        SAC | groups,
        ["alpha", "entropy", "pred_value", "target_value", *metrics],
        [*TRANSITION, *[PERTURBED] * perturbed],
        CRITIC_KEYS | ({"action_value": "action_value"} if discrete else {}),
        {"alpha_init": 0.5} | ({"num_random": 3} if draws else {}) | options,
        networks or {},
        discrete=discrete,
    )


SAC = {"loss_actor": ACTOR, "loss_alpha": "log_alpha", "loss_qvalue": CRITICS}
CQL = {"loss_cql": CRITICS}
# Critics that are plain MLPs with ReLUs have a path of their own, others are vmapped.
RELU = {"critic_activation": nn.ReLU}
NO_RECOVERY = {"recovery_weight": 0.0, "actor_states": "clean", "perturbed": False}
recovery_loss = partial(
    Member,
    StateRecoveryLoss,
    {"loss_recovery": ACTOR},
    ["recovery_kl"],
    ["observation", NEXT, ("next", "done"), PERTURBED],
    RECOVERY_KEYS,
)
model_loss = partial(
    Member,
    InverseDynamicsLoss,
    {"loss_inverse_dynamics": MODEL},
    [],
    ["observation", NEXT, "action", ("next", "done"), PERTURBED],
    MODEL_KEYS,
)

FAMILY = {
    "osr": actor_critic(OSRLoss, CQL, "recovery_kl", networks=RELU),
    "official": actor_critic(
        OSRLoss,
        CQL,
        "recovery_kl",
        networks=RELU,
        recovery_direction="reverse",
        action_reduction="mean",
        recovery_states="perturbed",
        actor_states="clean",
    ),
    "osr-10": actor_critic(
        OSRLoss,
        {},
        "recovery_kl",
        networks={"num_critics": 3} | RELU,
        min_q_weight=0.0,
        deterministic_backup=False,
    ),
    "cql": actor_critic(OSRLoss, CQL, **NO_RECOVERY),
    # CQL on D_tot, to tell the recovery term from the perturbed states.
    "cql-perturbed": actor_critic(OSRLoss, CQL, recovery_weight=0.0),
    "cql-options": actor_critic(
        OSRLoss,
        CQL | {"loss_alpha_prime": "log_alpha_prime"},
        "alpha_prime",
        networks=RELU,
        with_lagrange=True,
        lagrange_thresh=1.0,
        max_q_backup=True,
        temperature=1.5,
        **NO_RECOVERY,
    ),
    "cloning": actor_critic(
        OSRLoss,
        CQL,
        "recovery_nll",
        perturbed=False,
        recovery_target="data",
        recovery_states="clean",
        actor_states="clean",
    ),
    "noisy-cloning": actor_critic(OSRLoss, CQL, "recovery_nll", recovery_target="data"),
    "osrv": actor_critic(OSRVLoss, {}, "recovery_gap", recovery_weight=0.5),
    "osrv-logsumexp": actor_critic(
        OSRVLoss,
        {},
        "recovery_gap",
        networks=RELU,
        policy_values="logsumexp",
        recovery_weight=0.5,
    ),
    "edac": actor_critic(
        EDACLoss,
        {},
        "diversity",
        perturbed=False,
        networks={"num_critics": 3},
        diversity_weight=0.75,
    ),
    "td3bc": Member(
        TD3BCLoss,
        {"loss_actor": ACTOR, "loss_qvalue": CRITICS},
        ["cloning_error", "pred_value", "target_value"],
        TRANSITION,
        CRITIC_KEYS,
        replace={"actor": partial(deterministic_actor, "module")},
    ),
    "rebrac": Member(
        ReBRACLoss,
        {"loss_actor": ACTOR, "loss_qvalue": CRITICS},
        ["cloning_error", "pred_value", "target_value"],
        [*TRANSITION, NEXT_ACTION],
        CRITIC_KEYS,
        networks=RELU,
        replace={"actor": partial(deterministic_actor, "module")},
    ),
    "rorl": actor_critic(
        RORLLoss,
        {},
        "policy_smoothness",
        "value_smoothness",
        "uncertainty_penalty",
        perturbed=False,
        networks={"num_critics": 3} | RELU,
        num_samples=2,
    ),
    "scas": Member(
        SCASLoss,
        {"loss_actor": ACTOR, "loss_qvalue": CRITICS},
        ["correction_error", "pred_value", "target_value"],
        [*TRANSITION, PERTURBED],
        CRITIC_KEYS,
        networks=RELU,
        replace={
            "actor": partial(deterministic_actor, "module"),
            "dynamics": dynamics_ensemble,
        },
    ),
    "sdc": replace(
        actor_critic(
            SDCLoss,
            CQL | {"loss_deviation": ACTOR, "loss_multiplier": "log_multiplier"},
            "deviation",
            "multiplier",
            networks=RELU,
            num_random=3,
            num_samples=2,
        ),
        replace={"dynamics": dynamics_ensemble, "transition": transition_vae},
    ),
    "discrete": actor_critic(DiscreteOSRLoss, CQL, "recovery_kl"),
    "discrete-cql": actor_critic(
        DiscreteOSRLoss,
        CQL,
        networks={"distribution_class": Categorical},
        **NO_RECOVERY,
    ),
    "recovery": recovery_loss(),
    # With safe=True TorchRL 0.14.1 refuses to compile a TanhDelta, on any torch.
    "recovery-delta": recovery_loss(
        options={"recovery_direction": "reverse"},
        replace={"actor": partial(deterministic_actor, "delta", safe=False)},
    ),
    "recovery-plain": recovery_loss(
        options={"recovery_direction": "reverse"},
        replace={"actor": partial(deterministic_actor, "actor")},
    ),
    "idm": model_loss(),
    "idm-mse": model_loss(options={"loss_function": "mse"}),
    "cvae": model_loss(replace={"inverse_dynamics": latent_model}),
    "discrete-idm": model_loss(discrete=True),
}


def losses(*names: str, having: str | None = None) -> list[str]:
    """The losses of these names, or all, that have a property."""
    found = names or tuple(FAMILY)
    if having:
        return [name for name in found if PROPERTIES[having](FAMILY[name])]
    return list(found)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test for every loss that its mark asks for."""
    for mark in metafunc.definition.iter_markers("losses"):
        metafunc.parametrize("name", losses(*mark.args, **mark.kwargs))


class Family:
    """``family[name]`` tells what to expect, ``family(name)`` builds the loss."""

    def __init__(self, continuous: Callable, discrete: Callable) -> None:
        self._continuous, self._discrete = continuous, discrete

    def __getitem__(self, name: str) -> Member:
        return FAMILY[name]

    def has(self, name: str, what: str) -> bool:
        """Whether a loss has the property ``what``, see ``PROPERTIES``."""
        return PROPERTIES[what](FAMILY[name])

    def networks(
        self, name: str, *, observation="observation", action="action", seed=0, **rest
    ) -> SimpleNamespace:
        """The loss's own kind of networks, with any keys and number of critics."""
        keys = {"observation": observation, "action": action, "seed": seed}
        member = FAMILY[name]
        make = self._discrete if member.discrete else self._continuous
        networks = make(**keys, **(member.networks | rest))
        for part, replacement in member.replace.items():
            setattr(networks, part, replacement(**keys))
        return networks

    def __call__(
        self, name: str, networks=None, *, updated: bool = True, **options
    ) -> LossModule:
        """The loss in float64.

        Args:
            name: of the loss.
            networks: by default those of :meth:`networks`.
            updated: whether somebody moves the target networks.
            options: in the place of the table's.
        """
        member = FAMILY[name]
        networks = networks or self.networks(name)
        with_critics = self.has(name, "critics")
        if with_critics and options.get("reduction") == "none":
            options = {"scalar_output_mode": "exclude"} | options
        parts = [getattr(networks, part) for part in member.parts]
        loss = member.loss_class(*parts, **(member.options | options)).double()
        if with_critics and updated:
            SoftUpdate(loss, tau=0.1)
        return loss


@pytest.fixture
def family(make_networks, make_discrete_networks) -> Family:
    """Return the factory of every loss, by its name."""
    return Family(make_networks, make_discrete_networks)


@pytest.fixture
def family_batch(make_batch, make_discrete_batch):
    """Return a factory of a loss's batch, by default with the states that it reads."""

    def make(name: str, *size: int, perturbed: bool | None = None) -> TensorDict:
        member = FAMILY[name]
        if perturbed is None:
            perturbed = PERTURBED in member.in_keys
        make = make_discrete_batch if member.discrete else make_batch
        batch = make(*size, twin=perturbed)
        if member.index:
            batch["action"] = batch["action"].argmax(-1)
        if NEXT_ACTION in member.in_keys:
            batch[NEXT_ACTION] = batch["action"].flip(0)
        return batch

    return make


@pytest.fixture
def check_restated(check):
    """Return a function that compares a loss, and its gradients, with a restatement.

    The sum of ours is correct training; the plain one needs each group by itself.
    """

    def check_restated(
        label,
        loss,
        losses,
        expected,
        actor,
        critics,
        log_alpha=None,
        *,
        tolerance=1e-12,
    ):
        assert set(losses) == set(expected)
        values = [losses[key] for key in expected]
        check(label, values, expected.values(), tolerance=tolerance)
        parameters = list(actor.parameters())
        wanted = list(torch.autograd.grad(expected["loss_actor"], parameters))
        critic_part = expected["loss_qvalue"] + expected.get("loss_cql", 0)
        for group in zip(*(each.parameters() for each in critics), strict=True):
            gradients = torch.autograd.grad(critic_part, group, retain_graph=True)
            wanted.append(torch.stack(gradients))
        ours = [*loss.actor_network_params.values(True, True)]
        ours += loss.qvalue_network_params.values(True, True)
        if log_alpha is not None:
            wanted += torch.autograd.grad(expected["loss_alpha"], log_alpha)
            ours.append(loss.log_alpha)
        sum(losses.values()).backward()
        check(label, [each.grad for each in ours], wanted, tolerance=tolerance)

    return check_restated


@pytest.fixture
def seeded():
    """Return a function that calls a loss with the same draws every time."""

    def call(loss, *args, **kwargs):
        torch.manual_seed(2)
        return loss(*args, **kwargs)

    return call


@pytest.fixture
def terms(family, seeded):
    """Return a function that lists the terms of the losses.

    ``"recovery"`` is what ``recovery_weight`` scales, the losses are what is left.
    """

    def call(name: str, loss, batch: TensorDict) -> dict[str, Tensor]:
        out = seeded(loss, batch)
        found = {key: out[key] for key in family[name].groups}
        for key in family[name].weights.get("recovery_weight", []):
            # Another buffer in its place, for the graph of the losses holds this one.
            weight = loss.recovery_weight
            loss._buffers["recovery_weight"] = torch.zeros_like(weight)
            rest = seeded(loss, batch)[key]
            loss._buffers["recovery_weight"] = weight
            found |= {key: rest, "recovery": found[key] - rest}
        return found

    return call


@pytest.fixture
def record(seeded):
    """Return a function that lists losses and their gradients, one loss at a time."""

    def call(loss, batch: TensorDict, keys=None) -> list[Tensor]:
        out = seeded(loss, batch)
        parameters = [each for each in loss.parameters() if each.requires_grad]
        keys = keys or [key for key in out.keys() if key.startswith("loss_")]  # noqa: SIM118
        found: list[Tensor] = []
        for key in keys:
            gradients = torch.autograd.grad(
                out[key].sum(), parameters, allow_unused=True, retain_graph=True
            )
            found += [out[key].detach(), *(g for g in gradients if g is not None)]
        return found

    return call


@pytest.fixture
def assert_same():
    """Return an assertion that two lists of tensors agree, to 1e-12 by default."""

    def compare(got, wanted, tolerance: float = 1e-12) -> None:
        for ours, theirs in zip(got, wanted, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance)

    return compare


@pytest.fixture
def assert_same_bits():
    """Return an assertion that two lists of tensors are equal."""

    def compare(got, wanted) -> None:
        assert len(got) == len(wanted)
        assert all(map(torch.equal, got, wanted))

    return compare
