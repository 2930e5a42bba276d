"""The perturbations that an adversary finds, against plain loops and known optima."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch.distributions import Normal, kl_divergence
from torchrl.modules import TanhNormal

from torchrl_osr import OSRLoss
from torchrl_osr.lab.losses.adversary import Adversary

OBJECTIVES, METHODS = ["action_diff", "min_Q"], ["sample", "gradient"]
KEYS = ["observation"]
WEIGHT = torch.tensor([0.5, -2.0, 1.0], dtype=torch.float64)

both_objectives = pytest.mark.parametrize("objective", OBJECTIVES)
both_methods = pytest.mark.parametrize("method", METHODS)


def linear_policy(states) -> TanhNormal:
    loc = (states["observation"].to(WEIGHT) @ WEIGHT).unsqueeze(-1)
    return TanhNormal(loc, torch.ones_like(loc))


def quadratic_qvalue(states, action) -> torch.Tensor:
    # The mean falls with the action, the second critic rises.
    action = action.squeeze(-1)
    return torch.stack([-(6 + 2 * action).square(), 9 * action])


def draw(adversary: Adversary, *shape: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    shape = (adversary.num_samples, *shape)
    uniform = torch.rand(shape, generator=generator, dtype=torch.float64)
    return adversary.epsilon * (2 * uniform - 1)


def scores(real, objective, states, deltas) -> torch.Tensor:
    """The objective by the bare networks and torch.distributions, ``[M, B]``."""

    def policy(observation):
        inputs = TensorDict({"observation": observation}, observation.shape[:-1])
        params = real.networks.actor.get_dist_params(inputs)
        return params["loc"], params["scale"]

    observation, rows = states["observation"], []
    for delta in deltas:
        loc, scale = policy(observation + delta)
        if objective == "min_Q":
            inputs = torch.cat([observation, torch.tanh(loc)], -1)
            values = [critic.module(inputs) for critic in real.networks.critics]
            rows.append(-sum(values).squeeze(-1) / len(values))
        else:
            p, q = Normal(*policy(observation)), Normal(loc, scale)
            rows.append((kl_divergence(p, q) + kl_divergence(q, p)).sum(-1))
    return torch.stack(rows)


@pytest.fixture
def real(make_networks, make_batch) -> SimpleNamespace:
    """Networks, a loss that holds them, functions of both, and states."""
    networks = make_networks()
    loss = OSRLoss(networks.actor, networks.critics, networks.inverse_dynamics).double()

    def policy(states) -> TanhNormal:
        return networks.actor.get_dist(states.select("observation"))

    def qvalue(states, action) -> torch.Tensor:
        inputs = torch.cat([states["observation"], action], -1)
        values = [critic.module(inputs) for critic in networks.critics]
        return torch.stack(values).squeeze(-1)

    states = make_batch(6).select("observation")
    return SimpleNamespace(
        loss=loss, networks=networks, policy=policy, qvalue=qvalue, states=states
    )


def perturb(real, adversary: Adversary, generator=None) -> torch.Tensor:
    states = real.states
    return adversary.perturb(states, KEYS, real.policy, real.qvalue, generator)[KEYS[0]]


@given(
    st.sampled_from(OBJECTIVES),
    st.sampled_from(METHODS),
    st.floats(0, 10),
    st.integers(1, 4),
    st.lists(st.integers(1, 3), max_size=2),
    st.sampled_from([torch.float32, torch.float64]),
)
@settings(deadline=None, max_examples=60)
def test_every_perturbation_is_in_the_box(
    objective, method, epsilon, num_samples, size, dtype
) -> None:
    adversary = Adversary(objective, method, epsilon, num_samples, num_steps=2)
    clean = torch.randn(*size, 3, dtype=dtype)
    states = TensorDict({"observation": clean}, size)
    perturbed = adversary.perturb(states, KEYS, linear_policy, quadratic_qvalue)
    assert perturbed.batch_size == states.batch_size
    assert perturbed["observation"].shape == clean.shape
    assert perturbed["observation"].dtype == dtype
    # The sum of state and perturbation is rounded.
    unit = torch.finfo(dtype).eps * (clean.abs() + epsilon)
    assert ((perturbed["observation"] - clean).abs() <= epsilon + 2 * unit).all()


@both_objectives
def test_sampling_equals_a_plain_loop_over_the_same_draws(
    real, check, objective
) -> None:
    adversary = Adversary(objective, epsilon=0.5, num_samples=7)
    perturbed = perturb(real, adversary, torch.Generator().manual_seed(3))
    deltas = draw(adversary, 6, 3, seed=3)
    if objective == "min_Q":
        deltas = torch.cat([torch.zeros_like(deltas[:1]), deltas])
    found = scores(real, objective, real.states, deltas)
    expected = real.states["observation"].clone()
    for row in range(6):
        best = max(range(len(deltas)), key=lambda i: found[i, row].item())
        expected[row] += deltas[best, row]
    check("Adversary", [perturbed], [expected], tolerance=1e-13)
    assert perturbed.unique(dim=0).shape == perturbed.shape


def released_gradient_attack(real, adversary, deltas) -> torch.Tensor:
    """A new Adam for each step, on the mean over rows, then back into the box."""
    objective, epsilon = adversary.objective, adversary.epsilon
    for _ in range(adversary.num_steps):
        deltas = deltas.clone().requires_grad_()
        optimizer = torch.optim.Adam([deltas], lr=adversary.step_size * epsilon)
        score = scores(real, objective, real.states, deltas).mean()
        (deltas.grad,) = torch.autograd.grad(-score, [deltas])
        optimizer.step()
        deltas = deltas.detach().clamp(-epsilon, epsilon)
    return deltas


@both_objectives
@pytest.mark.parametrize("num_samples", [1, 4])
def test_gradient_steps_are_those_of_the_released_attack(
    real, check, objective, num_samples
) -> None:
    adversary = Adversary(objective, "gradient", 0.3, num_samples, step_size=0.25)
    perturbed = perturb(real, adversary, torch.Generator().manual_seed(3))
    deltas = released_gradient_attack(real, adversary, draw(adversary, 6, 3, seed=3))
    best = scores(real, objective, real.states, deltas).argmax(0)
    expected = real.states["observation"] + deltas[best, torch.arange(6)]
    # Adam adds 1e-8 to the size of a gradient before it divides by it.
    check("Adversary", [perturbed], [expected], tolerance=1e-6)


# Twenty steps of .1 half-widths cross the whole box.
@pytest.mark.parametrize("num_samples", [1, 5])
def test_gradient_steps_find_the_corner_of_the_lowest_value(num_samples) -> None:
    adversary = Adversary("min_Q", "gradient", 0.05, num_samples, num_steps=20)
    clean = 0.3 * torch.randn(8, 3, dtype=torch.float64)
    states = TensorDict({"observation": clean}, [8])
    perturbed = adversary.perturb(states, KEYS, linear_policy, quadratic_qvalue)
    # The mean value falls with the action, which rises with WEIGHT @ s.
    expected = clean + 0.05 * WEIGHT.sign()
    torch.testing.assert_close(perturbed["observation"], expected, rtol=0, atol=1e-12)


def test_gradient_steps_find_a_corner_of_the_largest_divergence() -> None:
    adversary = Adversary("action_diff", "gradient", 0.05, 1, num_steps=20)
    clean = torch.randn(8, 3, dtype=torch.float64)
    states = TensorDict({"observation": clean}, [8])
    perturbed = adversary.perturb(states, KEYS, linear_policy, quadratic_qvalue)
    # Unit scales: the divergence is the squared change of the mean, the largest of
    # which is .05 * (.5 + 2 + 1), up or down.
    change = (perturbed["observation"] - clean) @ WEIGHT
    torch.testing.assert_close(change.abs(), torch.full_like(change, 0.175))
    assert 0 < (change > 0).sum() < 8


@both_objectives
def test_an_adversary_gains_more_than_the_first_draw_and_than_nothing(
    real, objective
) -> None:
    adversary = Adversary(objective, epsilon=0.5, num_samples=5)
    perturbed = perturb(real, adversary, torch.Generator().manual_seed(3))
    found = (perturbed - real.states["observation"]).unsqueeze(0)
    nothing, first = torch.zeros_like(found), draw(adversary, 6, 3, seed=3)[:1]
    gain = scores(real, objective, real.states, torch.cat([found, nothing, first]))
    assert (gain[0] >= gain[1] - 1e-12).all()
    assert (gain[0] >= gain[2] - 1e-12).all()
    assert gain[0].mean() > gain[1:].max(0).values.mean()


def test_sampling_for_low_values_may_leave_a_state_alone() -> None:
    # The critics' mean is lowest at the action of the clean state.
    states = TensorDict({"observation": torch.randn(4, 3)}, [4])
    perturbed = Adversary("min_Q", epsilon=1.0).perturb(
        states,
        KEYS,
        linear_policy,
        lambda states, action: (
            (action - linear_policy(states).deterministic_sample)
            .square()
            .movedim(-1, 0)
        ),
    )
    assert torch.equal(perturbed["observation"], states["observation"])


@both_objectives
@both_methods
def test_several_nested_observations_of_any_batch_size(objective, method) -> None:
    keys = [("agent", "joints"), "camera"]
    states = TensorDict(
        {
            "agent": {"joints": torch.randn(4, 5, 2), "goal": torch.randn(4, 5, 1)},
            "camera": torch.randn(4, 5, 2, 3),
        },
        [4, 5],
    )

    def policy(states) -> TanhNormal:
        camera = states["camera"].flatten(-2).tanh().sum(-1, keepdim=True)
        loc = states[keys[0]] * camera + states["agent", "goal"]
        return TanhNormal(loc, torch.ones_like(loc))

    clean = states.clone()
    adversary = Adversary(objective, method, epsilon=0.1, num_samples=3)
    perturbed = adversary.perturb(
        states.lock_(), keys, policy, lambda states, action: action.movedim(-1, 0)
    )
    for key in keys:
        noise = perturbed[key] - states[key]
        assert noise.shape == states[key].shape
        assert 0 < noise.abs().max() <= 0.1 + 1e-6
        if (objective, method) == ("action_diff", "sample"):
            # Each number of each row has a noise of its own.
            assert noise.unique().numel() > 0.9 * noise.numel()
    assert torch.equal(perturbed["agent", "goal"], states["agent", "goal"])
    assert set(perturbed.keys(True, True)) == set(states.keys(True, True))
    assert (states == clean).all()


@both_objectives
@both_methods
def test_call_writes_what_perturb_finds_into_a_copy_of_the_batch(
    real, make_batch, objective, method
) -> None:
    adversary = Adversary(objective, method, epsilon=0.1, num_samples=3, num_steps=2)
    batch = make_batch(6)
    before = batch.clone()
    torch.manual_seed(3)
    found = adversary(real.loss, batch)
    expected = perturb(real, adversary, torch.Generator().manual_seed(3))
    written = found["perturbed", "observation"]
    torch.testing.assert_close(written, expected, rtol=1e-12, atol=1e-12)
    assert (found.exclude("perturbed") == batch.exclude("perturbed")).all()
    assert (batch == before).all()
    assert not written.requires_grad
    assert all(parameter.grad is None for parameter in real.loss.parameters())


@pytest.mark.losses("osr", "osrv", "cql-perturbed")
def test_a_loss_trains_on_the_worst_states_of_its_own_networks(
    family, family_batch, seeded, name
) -> None:
    loss, batch = family(name), family_batch(name, 10, perturbed=False)
    adversary = Adversary(epsilon=0.5, num_samples=20)
    out = seeded(loss, adversary(loss, batch))
    assert all(value.isfinite() for value in out.values())
    # Under other keys, which the loss was told of, it is the same.
    loss.set_keys(perturbed=("worst", "state"))
    renamed = adversary(loss, batch)
    assert ("worst", "state", "observation") in renamed.keys(True)
    assert seeded(loss, renamed)["loss_actor"].isfinite()


@both_objectives
@both_methods
@pytest.mark.parametrize("grad", [True, False])
def test_nothing_receives_a_gradient(real, objective, method, grad) -> None:
    real.states["observation"].requires_grad_()
    clean = real.states.clone()
    adversary = Adversary(objective, method, epsilon=0.1, num_samples=2, num_steps=2)
    with torch.set_grad_enabled(grad):
        perturbed = perturb(real, adversary, torch.Generator().manual_seed(3))
    assert not perturbed.requires_grad
    assert all(parameter.grad is None for parameter in real.loss.parameters())
    assert real.states["observation"].grad is None
    assert set(real.states.keys()) == {"observation"}
    assert torch.equal(real.states["observation"], clean["observation"])
    # Steps that no_grad had switched off would end where they start.
    start = real.states["observation"] + draw(adversary, 6, 3, seed=3)
    assert method == "sample" or (perturbed != start).all()


@both_objectives
def test_entries_that_are_not_perturbed_come_along_alone(real, objective) -> None:
    goal = torch.zeros(6, 1, dtype=torch.float64, requires_grad=True)
    real.states["goal"] = goal

    def writing_policy(states) -> TanhNormal:
        states["action"] = states["observation"]
        return real.policy(states)

    perturbed = Adversary(objective).perturb(
        real.states, KEYS, writing_policy, real.qvalue
    )
    assert set(real.states.keys()) == set(perturbed.keys()) == {"observation", "goal"}
    assert torch.equal(perturbed["goal"], goal)
    assert not perturbed["goal"].requires_grad


@both_objectives
@both_methods
def test_a_box_without_width_leaves_the_states(real, objective, method) -> None:
    perturbed = perturb(real, Adversary(objective, method, epsilon=0.0))
    assert torch.equal(perturbed, real.states["observation"])


@both_methods
def test_draws_come_from_torchs_generator_unless_given_another(real, method) -> None:
    adversary = Adversary(method=method, num_samples=3)
    torch.manual_seed(3)
    default = perturb(real, adversary)
    state = torch.get_rng_state()
    given = perturb(real, adversary, torch.Generator().manual_seed(3))
    assert torch.equal(default, given)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize(
    ("objective", "method", "calls"),
    [
        ("action_diff", "sample", [(6,), (5, 6)]),
        ("min_Q", "sample", [(6, 6)]),
        ("action_diff", "gradient", [(6,)] + 4 * [(5, 6)]),
        ("min_Q", "gradient", 4 * [(5, 6)]),
    ],
)
def test_candidates_go_through_the_policy_together(
    real, objective, method, calls
) -> None:
    seen = []

    def policy(states) -> TanhNormal:
        seen.append(tuple(states.batch_size))
        return real.policy(states)

    adversary = Adversary(objective, method, num_samples=5, num_steps=3)
    adversary.perturb(real.states, KEYS, policy, real.qvalue)
    assert seen == calls


# Raised inside tensordict 0.14.3 and TorchRL 0.14.1 while torch 2.13 traces them.
@pytest.mark.filterwarnings("ignore:.*autograd.function.Function:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning")
@pytest.mark.filterwarnings("ignore:Using lock_.. inside a compiled:UserWarning")
@pytest.mark.parametrize(
    ("objective", "method"), [("action_diff", "sample"), ("min_Q", "gradient")]
)
def test_compiled_equals_eager_without_graph_breaks(real, objective, method) -> None:
    adversary = Adversary(objective, method, epsilon=0.1, num_samples=3, num_steps=2)

    def call() -> torch.Tensor:
        torch.manual_seed(3)
        return compiled(real, adversary)

    compiled = perturb
    eager = call()
    torch.compiler.reset()
    compiled = torch.compile(perturb, backend="eager", fullgraph=True)
    torch.testing.assert_close(call(), eager, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("argument", "value", "expected"),
    [
        ("objective", "max_Q", "one of ('action_diff', 'min_Q')"),
        ("method", "adam", "one of ('sample', 'gradient')"),
        ("epsilon", -0.1, "at least 0"),
        ("epsilon", math.nan, "at least 0"),
        ("epsilon", math.inf, "at least 0"),
        ("num_samples", 0, "at least 1"),
        ("num_steps", 0, "at least 1"),
        ("step_size", 0.0, "above 0"),
        ("step_size", math.inf, "above 0"),
    ],
)
def test_arguments_out_of_range_are_named(argument, value, expected) -> None:
    message = re.escape(f"{argument} must be {expected}, got {value!r}.")
    with pytest.raises(ValueError, match=f"^{message}$"):
        Adversary(**{argument: value})


def test_observations_must_be_there_and_floating_point(real) -> None:
    states = TensorDict({"pixels": torch.zeros(4, 3, dtype=torch.uint8)}, [4])
    arguments = (real.policy, real.qvalue)
    with pytest.raises(TypeError, match="'pixels' must be floating .* got torch.uint8"):
        Adversary().perturb(states, ["pixels"], *arguments)
    with pytest.raises(KeyError, match="no entry 'observation'; it has .*pixels"):
        Adversary().perturb(states, KEYS, *arguments)
