"""A table of the losses with small networks, and batches that they all can read.

``make_loss("osr")`` builds a loss in float64, ``LOSSES["osr"].trains`` lists which
parameters each of its entries trains.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from tensordict import NestedKey, TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical, Normal
from torchrl.modules import MLP
from torchrl.objectives import LossModule, SoftUpdate

import torchrl_osr as osr
from torchrl_osr import modules
from torchrl_osr.lab import losses as lab
from torchrl_osr.lab.dynamics import DynamicsEnsemble, TransitionVAE
from torchrl_osr.objectives import WithRecovery

S, A, ACTIONS = 3, 2, 4
NEXT, PERTURBED = ("next", "observation"), ("perturbed", "observation")


class Squash(nn.Module):
    """The last layer of a plain actor: a tanh and the action's bounds."""

    def __init__(self, low: Any, high: Any) -> None:
        super().__init__()
        self.center, self.half = (high + low) / 2, (high - low) / 2

    def forward(self, value: Tensor) -> Tensor:
        return self.center + self.half * torch.tanh(value)


def _module(size: int, number: int, *, low: Any, high: Any, **keys: Any):
    layers = nn.Sequential(MLP(size, number, num_cells=[8]), Squash(low, high))
    return TensorDictModule(layers, [keys["observation_key"]], [keys["action_key"]])


MLPS, LIMITS = {"num_cells": [8], "activation_class": nn.Tanh}, ("low", "high")
LATENT, CELLS = MLPS | {"latent_dim": 2}, {"num_cells": [6]}
ENSEMBLE = CELLS | {"num_networks": 2, "num_elites": 2}
STATE, COUNT = ("observation_key",), ("num_qvalue_nets",)
BOTH = (*STATE, "action_key")
# How each network is built, its sizes and fixed options, and what may be chosen.
BUILDERS: dict[str, tuple[Callable[..., Any], tuple[int, ...], dict, tuple]] = {
    "actor": (modules.tanh_gaussian_actor, (S, A), MLPS, BOTH + LIMITS),
    "delta": (modules.deterministic_actor, (S, A), MLPS, BOTH + LIMITS),
    "module": (_module, (S, A), {}, BOTH + LIMITS),
    "gaussian": (modules.gaussian_actor, (S, A), MLPS, BOTH),
    "critics": (modules.critic_ensemble, (S, A), {"num_cells": [16]}, BOTH + COUNT),
    "value": (modules.state_value, (S,), MLPS, STATE),
    "model": (modules.tanh_gaussian_inverse_dynamics, (S, A), MLPS, BOTH + LIMITS),
    "latent_model": (modules.cvae_inverse_dynamics, (S, A), LATENT, BOTH + LIMITS),
    "chooser": (modules.categorical_actor, (S, ACTIONS), MLPS, BOTH),
    "choice_critics": (
        modules.discrete_critic_ensemble, (S, ACTIONS), MLPS, STATE + COUNT
    ),
    "choice_model": (modules.categorical_inverse_dynamics, (S, ACTIONS), MLPS, BOTH),
    "dynamics": (DynamicsEnsemble, (S, A), ENSEMBLE, ()),
    "vae": (TransitionVAE, (S,), CELLS, ()),
}  # fmt: skip


class Networks:
    """Small networks in float64; equal seeds give equal weights.

    Each is built when it is first read, and may be assigned.
    """

    def __init__(
        self,
        *,
        observation: NestedKey = "observation",
        action: NestedKey = "action",
        number: int = 2,
        low: Any = -1.0,
        high: Any = 1.0,
        head: type | None = None,
        seed: int = 0,
    ) -> None:
        self.seed, self.head = seed, head
        self.options = {"observation_key": observation, "action_key": action}
        self.bounds = {"low": low, "high": high}
        self.options |= {"num_qvalue_nets": number} | self.bounds

    def __getattr__(self, name: str) -> Any:
        if name not in BUILDERS:
            raise AttributeError(name)
        torch.manual_seed(1000 * self.seed + sum(map(ord, name)))
        build, sizes, fixed, chosen = BUILDERS[name]
        built = build(*sizes, **fixed, **{each: self.options[each] for each in chosen})
        for network in built if isinstance(built, list) else [built]:
            network.double()
        if name in ("dynamics", "vae"):
            for parameter in built.parameters():
                nn.init.normal_(parameter, std=0.5)
        if self.head and name in ("chooser", "choice_model"):
            built[-1].distribution_class = self.head
        setattr(self, name, built)
        return built


def density(network: nn.Module, *inputs: Tensor) -> Normal:
    """Return the Gaussian of a network, before the tanh if there is one."""
    *_, loc, scale = network[0](*inputs)
    return Normal(loc, scale)


class Case(NamedTuple):
    """A loss: how it is built from :class:`Networks`, and what each entry trains."""

    build: Callable[..., LossModule]
    trains: dict[str, str]
    action: str = "continuous"  # or "one_hot", or "index"


def of(loss_class: type[LossModule], names: str, **defaults: Any):
    """Return a function that builds a loss of the networks of these names."""

    def build(networks: Networks, **options: Any) -> LossModule:
        parts = [getattr(networks, name) for name in names.split()]
        return loss_class(*parts, **(defaults | options))

    return build


def combined(term: Callable[..., LossModule]):
    """Return a function that builds CQL(H) and a term of its actor."""

    def build(networks: Networks, **options: Any) -> WithRecovery:
        names = ("reduction", "use_prioritized_weights")
        shared = {name: options[name] for name in names if name in options}
        cql = osr.CQLLoss(networks.actor, networks.critics, **(SMALL | options))
        return WithRecovery(cql, term(networks, **shared))

    return build


ACTOR, CRITICS, MODEL, VALUE = (
    f"{name}_network_params"
    for name in ("actor", "qvalue", "inverse_dynamics", "value")
)
TD3 = {"loss_actor": ACTOR, "loss_qvalue": CRITICS}
SAC = {"loss_actor": ACTOR, "loss_alpha": "log_alpha", "loss_qvalue": CRITICS}
CQL = SAC | {"loss_cql": CRITICS}
GAP = CQL | {"loss_alpha_prime": "log_alpha_prime"}
SDC = CQL | {"loss_deviation": ACTOR, "loss_multiplier": "log_multiplier"}
RECOVERY, FIT = {"loss_recovery": ACTOR}, {"loss_inverse_dynamics": MODEL}
SMALL = {"alpha_init": 0.5, "num_random": 3}
SAC_N = {"alpha_init": 0.5, "min_q_weight": 0.0, "deterministic_backup": False}
EVERY_OPTION = SMALL | {"target_action_gap": 1.0, "max_q_backup": True}
EVERY_OPTION |= {"temperature": 1.5}
RELEASED = {"recovery_direction": "reverse", "action_reduction": "mean"}
RELEASED |= {"recovery_states": "perturbed"}
PAIR, TRIPLE, BOX = "actor critics", "actor critics model", {"low": -1.0, "high": 1.0}
DISCRETE, PLAIN = "chooser choice_critics choice_model", "module critics"

LOSSES: dict[str, Case] = {
    "cql": Case(of(osr.CQLLoss, PAIR, **SMALL), CQL),
    "cql-options": Case(of(osr.CQLLoss, PAIR, **EVERY_OPTION), GAP),
    "sac-n": Case(of(osr.CQLLoss, PAIR, **SAC_N), SAC),
    "osr": Case(of(osr.OSRLoss, TRIPLE, **SMALL), CQL),
    "osr-v": Case(of(osr.OSRVLoss, TRIPLE, **SMALL), SAC),
    "osr-v-cql": Case(of(osr.OSRVLoss, TRIPLE, **SMALL, policy_values="cql"), SAC),
    "discrete": Case(of(osr.DiscreteOSRLoss, DISCRETE), CQL, "one_hot"),
    "discrete-cql": Case(
        of(osr.DiscreteOSRLoss, DISCRETE, recovery_weight=0.0), CQL, "index"
    ),
    "recovery": Case(of(osr.StateRecoveryLoss, "actor model"), RECOVERY),
    "recovery-delta": Case(of(osr.StateRecoveryLoss, "delta model"), RECOVERY),
    "recovery-module": Case(of(osr.StateRecoveryLoss, "module model"), RECOVERY),
    "noisy-cloning": Case(
        of(osr.StateRecoveryLoss, "actor", recovery_target="data"), RECOVERY
    ),
    "official": Case(
        combined(of(osr.StateRecoveryLoss, "actor model", **RELEASED)), CQL | RECOVERY
    ),
    "model": Case(of(osr.InverseDynamicsLoss, "model"), FIT),
    "model-mse": Case(of(osr.InverseDynamicsLoss, "model", loss_function="mse"), FIT),
    "latent-model": Case(of(osr.InverseDynamicsLoss, "latent_model"), FIT),
    "choice-model": Case(of(osr.InverseDynamicsLoss, "choice_model"), FIT, "one_hot"),
    "bc": Case(of(lab.BCLoss, "actor"), {"loss_actor": ACTOR}),
    "iql": Case(of(lab.IQLLoss, "gaussian critics value"), TD3 | {"loss_value": VALUE}),
    "fqe": Case(of(lab.FQELoss, "critics"), {"loss_qvalue": CRITICS}),
    "edac": Case(of(lab.EDACLoss, PAIR, alpha_init=0.5), SAC),
    "rorl": Case(of(lab.RORLLoss, PAIR, num_samples=2, alpha_init=0.5), SAC),
    "td3-bc": Case(of(lab.TD3BCLoss, PLAIN, **BOX), TD3),
    "rebrac": Case(of(lab.ReBRACLoss, PLAIN, **BOX), TD3),
    "sdc": Case(
        combined(of(lab.StateDeviationLoss, "actor dynamics vae", num_samples=2)), SDC
    ),
}
WITH_CRITICS = [name for name, case in LOSSES.items() if "loss_qvalue" in case.trains]
WRAPPED = ["official", "sdc"]  # two losses of one actor, see WithRecovery
every_loss = pytest.mark.parametrize("name", LOSSES)
with_critics = pytest.mark.parametrize("name", WITH_CRITICS)
every_base = pytest.mark.parametrize("name", [x for x in LOSSES if x not in WRAPPED])


def parts(loss: LossModule) -> list[LossModule]:
    """Return the losses that a loss consists of, or the loss itself."""
    return [loss.loss, loss.recovery] if isinstance(loss, WithRecovery) else [loss]


def make_networks(name: str, **options: Any) -> Networks:
    """Return the networks of a loss of the table, with any keys and seed."""
    head = Categorical if LOSSES[name].action == "index" else None
    return Networks(**({"head": head} | options))


def make_loss(name: str, networks: Networks | None = None, **options) -> LossModule:
    """Return a loss of the table in float64; its target networks have an updater."""
    loss = LOSSES[name].build(networks or make_networks(name), **options).double()
    return update_targets(loss)


def update_targets(loss: LossModule) -> LossModule:
    """Give the target networks of a loss an updater, if it has any; return the loss."""
    part = parts(loss)[0]
    if any(name.startswith("target_") for name, _ in part.named_children()):
        SoftUpdate(part, tau=0.1)
    return loss


def make_batch(name: str, *size: int, ends: bool = True) -> TensorDict:
    """Return random transitions that a loss can read, in float64.

    Of every five rows one is terminated and one is cut by a time limit.
    """
    generator = torch.Generator().manual_seed(7)

    def normal(dim: int) -> Tensor:
        return torch.randn(*size, dim, generator=generator, dtype=torch.float64)

    row = torch.arange(torch.Size(size).numel()).reshape(*size, 1) % 5
    state, kind = normal(S), LOSSES[name].action
    after = {"observation": state + 0.5 * normal(S), "reward": normal(1)}
    after |= {"done": ((row == 1) | (row == 2)) & ends, "terminated": (row == 1) & ends}
    after["action"] = 0.9 * torch.tanh(normal(A))
    rows = {"observation": state, "action": 0.9 * torch.tanh(normal(A)), "next": after}
    rows["perturbed"] = {"observation": state + 0.1 * normal(S)}
    if kind != "continuous":
        index = torch.randint(ACTIONS, size, generator=generator)
        one_hot = nn.functional.one_hot(index, ACTIONS)
        rows["action"] = index if kind == "index" else one_hot
    return TensorDict(rows, size)


def call(loss: LossModule, batch: TensorDict) -> TensorDict:
    """Return what a loss returns, with the same draws every time."""
    torch.manual_seed(2)
    return loss(batch)


def record(loss: LossModule, batch: TensorDict) -> list[Tensor]:
    """Return all entries, and the gradients of each loss by all parameters."""
    out, found = call(loss, batch), []
    parameters = [each for each in loss.parameters() if each.requires_grad]
    for key, value in out.items():
        found.append(value.detach())
        if key.startswith("loss_") and value.requires_grad:
            slopes = torch.autograd.grad(
                value.sum(), parameters, allow_unused=True, retain_graph=True
            )
            found += [each for each in slopes if each is not None]
    return found


def assert_same(found: Any, wanted: Any) -> None:
    """Assert that two sequences of tensors agree."""
    for ours, theirs in zip(found, wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


def assert_same_bits(found: list[Tensor], wanted: list[Tensor]) -> None:
    """Assert that two lists of tensors are equal."""
    assert len(found) == len(wanted)
    assert all(map(torch.equal, found, wanted))
