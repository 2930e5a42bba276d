"""The equations against numbers from elsewhere, and the properties they promise."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import Categorical, Normal, kl_divergence

from torchrl_osr import functional

# The pair of the golden numbers: inverse dynamics N(.4, .3), policy N(-.2, .5).
INVERSE_DYNAMICS = (0.4, 0.3)
POLICY = (-0.2, 0.5)
# By hand: log(.5/.3) + (.09 + .36)/.5 - .5, and log(.3/.5) + (.25 + .36)/.18 - .5.
FORWARD, REVERSE = 0.910826, 2.378063

locations = st.floats(-3, 3)
scales = st.floats(0.05, 3)


def tensors(*numbers: float) -> list[torch.Tensor]:
    return [torch.tensor([number], dtype=torch.float64) for number in numbers]


@pytest.mark.parametrize(
    ("direction", "expected"), [("forward", FORWARD), ("reverse", REVERSE)]
)
def test_state_recovery_matches_hand_computed_numbers(direction, expected) -> None:
    value = functional.state_recovery(
        *tensors(*POLICY, *INVERSE_DYNAMICS), direction=direction
    )
    assert value.item() == pytest.approx(expected, abs=1e-6)


@given(locations, scales, locations, scales)
@settings(deadline=None)
def test_gaussian_kl_agrees_with_torch_and_is_not_negative(m_p, s_p, m_q, s_q) -> None:
    m_p, s_p, m_q, s_q = tensors(m_p, s_p, m_q, s_q)
    value = functional.gaussian_kl(m_p, s_p, m_q, s_q)
    witness = kl_divergence(Normal(m_p, s_p), Normal(m_q, s_q))
    torch.testing.assert_close(value, witness, rtol=1e-9, atol=1e-9)
    assert value.item() >= -1e-15


@given(locations, scales)
@settings(deadline=None)
def test_gaussian_kl_of_equals_is_exactly_zero(loc, scale) -> None:
    loc, scale = tensors(loc, scale)
    assert functional.gaussian_kl(loc, scale, loc, scale).item() == 0.0


@given(locations, scales, locations, scales)
@settings(deadline=None)
def test_jeffreys_divergence_is_both_divergences_of_torch(m_p, s_p, m_q, s_q) -> None:
    shift = torch.tensor([0.0, 0.7], dtype=torch.float64)
    m_p, s_p, m_q, s_q = tensors(m_p, s_p, m_q, s_q)
    m_p, s_q = m_p + shift, s_q + shift
    value = functional.jeffreys_divergence(m_p, s_p, m_q, s_q)
    p, q = Normal(m_p, s_p), Normal(m_q, s_q)
    witness = (kl_divergence(p, q) + kl_divergence(q, p)).sum(-1)
    torch.testing.assert_close(value, witness, rtol=1e-9, atol=1e-9)
    assert value.item() >= 0


def test_jeffreys_divergence_keeps_its_digits_where_gaussians_are_close() -> None:
    # To second order in t it is 2 t^2 for scales 1 and 1 + t; 1.2e-7 is float32's unit.
    step = torch.tensor([1.0, 3.0, 10.0])[:, None] * 2.0**-16
    zero, one = torch.zeros(3, 1), torch.ones(3, 1)
    value = functional.jeffreys_divergence(zero, one, zero, one + step)
    torch.testing.assert_close(value, 2 * step[:, 0].square(), rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_state_recovery_adds_or_averages_action_dimensions(direction) -> None:
    loc, other_loc = torch.randn(2, 5, 4, dtype=torch.float64)
    scale, other_scale = torch.rand(2, 5, 4, dtype=torch.float64) + 0.1
    arguments = (loc, scale, other_loc, other_scale)
    columns = [
        functional.state_recovery(
            *(tensor[:, i : i + 1] for tensor in arguments), direction=direction
        )
        for i in range(4)
    ]
    total = functional.state_recovery(*arguments, direction=direction)
    mean = functional.state_recovery(
        *arguments, direction=direction, action_reduction="mean"
    )
    torch.testing.assert_close(total, torch.stack(columns).sum(0))
    torch.testing.assert_close(mean, torch.stack(columns).mean(0))


def test_state_recovery_gradients_match_the_closed_form() -> None:
    loc, scale, other_loc, other_scale = tensors(*POLICY, *INVERSE_DYNAMICS)
    loc.requires_grad_()
    scale.requires_grad_()
    functional.state_recovery(loc, scale, other_loc, other_scale).backward()
    # d/dmu_pi = (mu_pi - mu_I)/s_pi^2 ; d/ds_pi = 1/s_pi - (s_I^2 + gap^2)/s_pi^3.
    assert loc.grad.item() == pytest.approx(-0.6 / 0.25, abs=1e-10)
    assert scale.grad.item() == pytest.approx(1 / 0.5 - 0.45 / 0.125, abs=1e-10)


@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_state_recovery_passes_gradcheck(direction) -> None:
    inputs = torch.rand(4, 3, 2, dtype=torch.float64) + 0.2
    inputs = [tensor.clone().requires_grad_() for tensor in inputs]
    assert torch.autograd.gradcheck(
        lambda *args: functional.state_recovery(*args, direction=direction), inputs
    )


# Inverse dynamics N(0, 1), policy N(.5, s): ours by hand is log s + 1.25/(2 s^2) - .5;
# printed (12) has log(1/s), hence .625, -2.3, -6.91, -13.8, and wins by s -> infinity.
@pytest.mark.parametrize(
    ("scale", "expected"), [(1, 0.125), (10, 1.8088), (1e3, 6.40776), (1e6, 13.31551)]
)
def test_recovery_grows_with_policy_scale_unlike_printed_12(scale, expected) -> None:
    value = functional.state_recovery(*tensors(0.5, scale, 0.0, 1.0)).item()
    printed = math.log(1 / scale) + 1.25 / (2 * scale**2)
    assert value == pytest.approx(expected, abs=1e-4)
    assert value - printed == pytest.approx(2 * math.log(scale) - 0.5, abs=1e-9)


# Three next states: mu_I = (-.5, .2, .9), s_I = (.2, .4, .1). Forward: the moments of
# the mixture, mean .2 and variance .07 + .98/3. Reverse: precision weighting,
# (25*-.5 + 6.25*.2 + 100*.9)/131.25 and (131.25/3)^-1/2.
@pytest.mark.parametrize(
    ("direction", "loc", "scale"),
    [("forward", 0.2, 0.629815), ("reverse", 0.6, 0.151186)],
)
def test_recovery_alone_has_the_known_fixed_point(direction, loc, scale) -> None:
    target = torch.tensor([[-0.5, 0.2, 0.9], [0.2, 0.4, 0.1]], dtype=torch.float64)
    policy = [tensor.requires_grad_() for tensor in tensors(0.0, 0.0)]
    optimizer = torch.optim.LBFGS(
        policy,
        max_iter=200,
        tolerance_grad=1e-12,
        tolerance_change=1e-14,
        line_search_fn="strong_wolfe",
    )

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        pi = (policy[0].expand(3, 1), policy[1].exp().expand(3, 1))
        value = functional.state_recovery(*pi, *target[..., None], direction=direction)
        value.sum().backward()
        return value.sum()

    optimizer.step(closure)
    assert policy[0].item() == pytest.approx(loc, abs=1e-5)
    assert policy[1].exp().item() == pytest.approx(scale, abs=1e-5)


# a ~ N(-.3, .4^2), s' = .5 a + N(0, .1^2): I(a | s') has gain .08/.05 = 1.6 and
# variance .16 * .01/.05 = .032; its mean over s' varies by 1.6^2 * .05 = .128. The
# recovery term is quadratic in that mean: two points, one deviation off, are exact.
NEXT_STATES = torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
MODEL = (-0.3 + 0.128**0.5 * NEXT_STATES, torch.full_like(NEXT_STATES, 0.032**0.5))


def test_equations_7_and_11_differ_by_the_mutual_information() -> None:
    for loc, scale in [(-0.3, 0.4), (0.0, 1.0), (1.3, 0.2), (-2.0, 0.7)]:
        policy = [tensor.expand(2, 1) for tensor in tensors(loc, scale)]
        each = functional.state_recovery(*policy, *MODEL).mean()
        marginal = functional.gaussian_kl(*tensors(-0.3, 0.4, loc, scale))
        # I(a; s') = log(.16/.032)/2.
        assert (each - marginal).item() == pytest.approx(math.log(5) / 2, abs=1e-12)


def test_recovery_at_clean_states_asks_for_the_behaviour_policy() -> None:
    # Proposition 2: at s^ = s the model's mean over s' is the behaviour policy.
    behaviour = [tensor.requires_grad_() for tensor in tensors(-0.3, 0.4)]
    policy = [tensor.expand(2, 1) for tensor in behaviour]
    value = functional.state_recovery(*policy, *MODEL).mean()
    for gradient in torch.autograd.grad(value, behaviour):
        assert gradient.item() == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("option", "value"), [("direction", "backward"), ("action_reduction", "max")]
)
def test_state_recovery_rejects_unknown_options(option, value) -> None:
    with pytest.raises(ValueError, match=f"{option} must be .* got '{value}'"):
        functional.state_recovery(*tensors(0, 1, 0, 1), **{option: value})


# (.4 + .2)^2 / (2 * .5^2) and (1 - 0)^2 / (2 * 2^2), by hand.
@pytest.mark.parametrize(("reduction", "expected"), [("sum", 0.845), ("mean", 0.4225)])
def test_deterministic_recovery_matches_hand_computed_numbers(
    reduction, expected
) -> None:
    action, loc, scale = torch.tensor([[0.4, 1.0], [-0.2, 0.0], [0.5, 2.0]]).double()
    action.requires_grad_()
    value = functional.deterministic_recovery(
        action, loc, scale, action_reduction=reduction
    )
    assert value.item() == pytest.approx(expected, abs=1e-6)
    value.backward()
    share = 1 if reduction == "sum" else 2
    torch.testing.assert_close(action.grad, (action - loc) / scale**2 / share)
    assert functional.deterministic_recovery(loc, loc, scale).item() == 0.0


@given(locations, scales, locations, scales)
@settings(deadline=None)
def test_deterministic_recovery_is_what_a_policy_of_constant_width_sees(
    loc, scale, other_loc, other_scale
) -> None:
    loc, scale, *other = tensors(loc, scale, other_loc, other_scale)
    away, there = (
        functional.state_recovery(mean, scale, *other, direction="reverse")
        for mean in (loc, other[0])
    )
    value = functional.deterministic_recovery(loc, *other)
    torch.testing.assert_close(value, away - there, rtol=1e-9, atol=1e-9)


def test_policy_value_takes_the_smallest_critic_and_seeks_high_values() -> None:
    qvalue = torch.tensor([[1.0, 5.0], [2.0, 3.0]])
    value = functional.soft_policy_value(torch.tensor([0.5, -1.0]), qvalue, 0.2)
    # By hand: .2 * .5 - 1 and .2 * -1 - 3.
    torch.testing.assert_close(value, torch.tensor([-0.9, -3.2]))


def test_categorical_kl_equals_torchs() -> None:
    p, q = torch.randn(2, 7, 5, dtype=torch.float64)
    p, q = (Categorical(logits=logits) for logits in (p, q))
    value = functional.categorical_kl(p.logits, q.logits)
    torch.testing.assert_close(value, kl_divergence(p, q), rtol=1e-12, atol=1e-12)
    assert (functional.categorical_kl(p.logits, p.logits) == 0).all()


# By hand: 0 + log 2 / 2 with p = (1/2, 1/2, 0), q = (1/2, 1/4, 1/4), and 0 log 0 = 0.
@pytest.mark.parametrize(
    ("p", "q", "expected"),
    [
        ([0.5, 0.5, 0.0], [0.5, 0.25, 0.25], 0.3465736),
        ([0.5, 0.5, 0.0], [0.5, 0.5, 0.0], 0.0),
        ([0.0, 0.0, 1.0], [0.5, 0.25, 0.25], 1.3862944),
        ([0.5, 0.25, 0.25], [0.5, 0.5, 0.0], math.inf),
    ],
)
def test_categorical_kl_of_actions_that_are_never_taken(p, q, expected) -> None:
    p, q = (torch.tensor(probs).log().requires_grad_() for probs in (p, q))
    value = functional.categorical_kl(p, q)
    assert value.item() == pytest.approx(expected, abs=1e-6)
    value.backward()
    assert q.grad.isfinite().all()
    assert p.grad.isfinite().all() or math.isinf(expected)


def test_discrete_policy_value_is_the_expectation_of_the_sampled_one() -> None:
    policy = Categorical(logits=torch.randn(6, 4, dtype=torch.float64))
    qvalue = torch.randn(3, 6, 4, dtype=torch.float64)
    value = functional.discrete_policy_value(policy.logits, qvalue, 0.3)
    expected = sum(
        policy.probs[:, a]
        * functional.soft_policy_value(policy.logits[:, a], qvalue[..., a], 0.3)
        for a in range(4)
    )
    torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-12)
    # -V, in nats times alpha: the entropy bonus alone is left without values.
    bonus = functional.discrete_policy_value(policy.logits, 0 * qvalue, 0.3)
    torch.testing.assert_close(bonus, -0.3 * policy.entropy(), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("alpha", [0.0, 0.3])
def test_discrete_policy_value_of_an_action_that_is_never_taken(alpha) -> None:
    logits = torch.tensor([0.5, -math.inf, 1.0], requires_grad=True)
    log_prob = torch.log_softmax(logits, -1)
    value = functional.discrete_policy_value(log_prob, torch.randn(2, 3), alpha)
    value.backward()
    assert value.isfinite()
    assert logits.grad.isfinite().all()
    assert logits.grad[1] == 0


# Actions (log 2, log 6) over densities (1/2, 2): log(4 + 3), and at temperature 2 the
# values by square roots and the densities as they are, 2 log(2 sqrt 2 + sqrt(6) / 2).
SOFT_MAXIMUM = [(1.0, 1.945910), (2.0, 2.799000)]


@pytest.mark.parametrize(("temperature", "expected"), SOFT_MAXIMUM)
def test_soft_maximum_divides_by_densities_at_every_temperature(
    temperature, expected
) -> None:
    qvalue, log_prob = torch.tensor([[2.0, 6.0], [0.5, 2.0]]).double().log()
    value = functional.soft_maximum(qvalue, log_prob, temperature=temperature)
    assert value.item() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("temperature", [0.5, 1.0, 3.0])
def test_soft_maximum_of_draws_estimates_an_integral(temperature) -> None:
    # Q(a) = 2 a on [-1, 1], drawn with density (2 + a) / 4, whose quantiles are
    # sqrt(1 + 8 u) - 2. The integral of e^{Q / tau} is tau sinh(2 / tau).
    number = 100_000
    share = (torch.arange(number, dtype=torch.float64) + 0.5) / number
    action = (1 + 8 * share).sqrt() - 2
    density = ((2 + action) / 4).log()
    value = functional.soft_maximum(2 * action, density, temperature=temperature)
    estimate = value.item() - temperature * math.log(number)
    integral = temperature * math.sinh(2 / temperature)
    assert estimate == pytest.approx(temperature * math.log(integral), abs=1e-8)


def test_soft_maximum_of_certain_actions_is_the_plain_log_sum_exp() -> None:
    # As discrete CQL has it: every action once, and for certain.
    qvalue = torch.tensor([[1.0, 2.0, -3.0]], dtype=torch.float64)
    value = functional.soft_maximum(qvalue, torch.zeros(3), temperature=2.0)
    total = sum(math.exp(each / 2) for each in (1, 2, -3))
    assert value.item() == pytest.approx(2 * math.log(total), abs=1e-12)


@pytest.mark.parametrize("temperature", [0.5, 1.0, 3.0])
def test_soft_maximum_of_zero_values_is_a_constant(temperature) -> None:
    # K = 10, A = 3: all 30 densities those of the cube of side 2, tau log(30 * 8).
    log_prob = torch.full((4, 30), -3 * math.log(2), dtype=torch.float64)
    zero = torch.zeros_like(log_prob)
    value = functional.soft_maximum(zero, log_prob, temperature=temperature)
    expected = temperature * math.log(240)
    torch.testing.assert_close(value, torch.full_like(value, expected))


def test_conservative_gap_is_what_samples_are_valued_above_the_data() -> None:
    soft_maximum, data = torch.tensor([[3.0, -1.0], [0.5, 2.0]])
    gap = functional.conservative_gap(soft_maximum, data)
    torch.testing.assert_close(gap, torch.tensor([2.5, -3.0]))


def test_temperature_rises_when_the_policy_has_too_little_entropy() -> None:
    log_alpha = torch.tensor(0.3, requires_grad=True)
    log_prob = torch.tensor([1.0, 4.0], requires_grad=True)
    value = functional.temperature_objective(log_alpha, log_prob, -2.0)
    torch.testing.assert_close(value, torch.tensor([0.3, -0.6]))  # -.3 * (-1, 2)
    value.mean().backward()
    assert log_alpha.grad.item() == pytest.approx(-0.5)
    assert log_prob.grad is None


def test_value_constraint_is_a_difference_of_means() -> None:
    policy = torch.tensor([[1.0, 4.0], [-1.0, 3.0]])
    model = torch.tensor([[2.0, 0.0, 1.0], [3.0, 3.0, 3.0]])
    # By hand: 2.5 - 1 and 1 - 3. It may be negative.
    value = functional.value_constraint(policy, model)
    torch.testing.assert_close(value, torch.tensor([1.5, -2.0]))


# The actions of SOFT_MAXIMUM, and a mean of 1 of the model's.
@pytest.mark.parametrize(("temperature", "expected"), SOFT_MAXIMUM)
def test_value_constraint_weighs_actions_by_density(temperature, expected) -> None:
    policy, log_prob = torch.tensor([[2.0, 6.0], [0.5, 2.0]]).double().log()
    model = torch.tensor([2.0, 0.0, 1.0]).double()
    value = functional.value_constraint(
        policy, model, log_prob=log_prob, temperature=temperature
    )
    assert value.item() == pytest.approx(expected - 1, abs=1e-6)


@given(
    st.lists(st.tuples(st.floats(-30, 30), st.floats(-3, 3)), min_size=2, max_size=9)
)
def test_value_constraint_has_a_floor_with_the_logsumexp_alone(cells) -> None:
    """Gibbs: log of the integral of exp(Q), less E_I Q, is no less than its entropy.

    Actions are cells of width 2 / M, so that all integrals are sums.
    """
    qvalue, logits = torch.tensor(cells, dtype=torch.float64).T
    model = Categorical(logits=logits)
    density = math.log(len(cells) / 2)
    floor = model.entropy().item() - density
    # The mean over the model's actions, each as often as it is likely.
    mean = (model.probs * qvalue).sum().expand(1)

    def gap(qvalue, mean):
        log_prob = torch.full_like(qvalue, density)
        return functional.value_constraint(qvalue, mean, log_prob=log_prob).item()

    assert gap(qvalue, mean) >= floor - 1e-9
    best = model.logits + density  # the log-density itself
    at_best = gap(best, (model.probs * best).sum().expand(1))
    assert at_best == pytest.approx(floor, abs=1e-9)
    # The printed one is linear: ten times the values, ten times the gap.
    printed = functional.value_constraint(qvalue, mean)
    tenfold = functional.value_constraint(10 * qvalue, 10 * mean)
    torch.testing.assert_close(tenfold, 10 * printed)


def test_bootstrap_value_is_the_lowest_critics_with_or_without_entropy() -> None:
    qvalue = torch.tensor([[1.0, 5.0], [2.0, -3.0]])
    torch.testing.assert_close(
        functional.bootstrap_value(qvalue), torch.tensor([1.0, -3.0])
    )
    # By hand: 1 - .2 * .5 and -3 - .2 * -1.
    value = functional.bootstrap_value(qvalue, torch.tensor([0.5, -1.0]), 0.2)
    torch.testing.assert_close(value, torch.tensor([0.9, -2.8]))


def test_cloning_error_is_a_mean_over_the_actions_dimensions() -> None:
    action = torch.tensor([[0.5, -1.0], [0.2, 0.2]], requires_grad=True)
    value = functional.cloning_error(action, torch.tensor([[0.0, 1.0], [0.2, 0.2]]))
    # By hand: (.25 + 4) / 2 and 0; its gradient 2 (pi - a) / A.
    torch.testing.assert_close(value, torch.tensor([2.125, 0.0]))
    value.sum().backward()
    torch.testing.assert_close(action.grad, torch.tensor([[0.5, -2.0], [0.0, 0.0]]))


def test_td3_bc_objective_weighs_values_by_their_magnitude() -> None:
    qvalue = torch.tensor([3.0, -1.0], requires_grad=True)
    error = torch.tensor([0.25, 2.0], requires_grad=True)
    # By hand: E|Q| = 2 and alpha / 2 = 1.25; .25 - 3.75 and 2 + 1.25.
    value = functional.td3_bc_objective(qvalue, error, torch.tensor(2.0), 2.5)
    torch.testing.assert_close(value, torch.tensor([-3.5, 3.25]))
    value.sum().backward()
    assert qvalue.grad.tolist() == [-1.25, -1.25]
    assert error.grad.tolist() == [1.0, 1.0]


def test_lagrange_terms_by_hand() -> None:
    gap = torch.tensor([1.0, 4.0], requires_grad=True)
    log_multiplier = torch.tensor(math.log(3.0), requires_grad=True)
    critic, dual = functional.lagrange_terms(gap, log_multiplier, 2.0)
    torch.testing.assert_close(critic, torch.tensor([-3.0, 6.0]))
    torch.testing.assert_close(dual, torch.tensor([3.0, -6.0]))
    (critic.sum() + dual.sum()).backward()
    torch.testing.assert_close(gap.grad, torch.tensor([3.0, 3.0]))
    torch.testing.assert_close(log_multiplier.grad, torch.tensor(-3.0))


# Three critics: (0, 90, 180) degrees have the pairs 0, 0, -1 twice each.
@pytest.mark.parametrize(
    ("gradients", "expected"),
    [
        ([[2.0, 0.0], [0.5, 0.0]], 2.0),
        ([[2.0, 0.0], [-1.0, 0.0]], -2.0),
        ([[1.0, 0.0], [0.0, 3.0], [-2.0, 0.0]], -1.0),
        ([[1.0, 1.0], [1.0, 1.0], [1.0, 1.0]], 3.0),
    ],
)
def test_diversity_by_hand(gradients, expected) -> None:
    value = functional.gradient_diversity(torch.tensor(gradients).unsqueeze(1))
    torch.testing.assert_close(value, torch.tensor([expected]))


def test_diversity_of_a_dead_critic_is_finite() -> None:
    gradients = torch.zeros(2, 1, 3, requires_grad=True)
    functional.gradient_diversity(gradients).sum().backward()
    assert gradients.grad.isfinite().all()
