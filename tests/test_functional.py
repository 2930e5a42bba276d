"""The equations against numbers from elsewhere, and the properties they promise."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.distributions import Categorical, Normal, kl_divergence

from torchrl_osr import functional

locations = st.floats(-3, 3)
scales = st.floats(0.05, 3)


def tensors(*numbers: float) -> list[torch.Tensor]:
    return [torch.tensor([number], dtype=torch.float64) for number in numbers]


# By hand, policy first. PAIR: log(.5/.3) + (.09 + .36)/.5 - .5, and log(.3/.5) +
# (.25 + .36)/.18 - .5. Then log(1e3) + 1.25/2e6 - .5, where printed (12) is -6.9, and
# .6^2 / (2 * .5^2).
PAIR = (-0.2, 0.5, 0.4, 0.3)
HAND = [(PAIR, "forward", 0.910826), (PAIR, "reverse", 2.378063)]
HAND += [((0.5, 1e3, 0, 1), "forward", 6.407756), ((1, 0.5, 0.4, 0.5), "forward", 0.72)]


@pytest.mark.parametrize(("numbers", "direction", "expected"), HAND)
def test_state_recovery_matches_hand_computed_numbers(numbers, direction, expected):
    value = functional.state_recovery(*tensors(*numbers), direction=direction)
    assert value.item() == pytest.approx(expected, abs=1e-6)


@given(locations, scales, locations, scales)
def test_gaussian_kl_agrees_with_torch_and_is_not_negative(m_p, s_p, m_q, s_q) -> None:
    m_p, s_p, m_q, s_q = tensors(m_p, s_p, m_q, s_q)
    value = functional.gaussian_kl(m_p, s_p, m_q, s_q)
    witness = kl_divergence(Normal(m_p, s_p), Normal(m_q, s_q))
    torch.testing.assert_close(value, witness, rtol=1e-9, atol=1e-9)
    assert value.item() >= -1e-15
    assert functional.gaussian_kl(m_p, s_p, m_p, s_p).item() == 0.0


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


# Actions (log 2, log 6) over densities (1/2, 2): log(4 + 3), and at temperature 2 the
# values by square roots and the densities as they are, 2 log(2 sqrt 2 + sqrt(6) / 2).
def test_soft_maximum_divides_by_densities_at_every_temperature() -> None:
    qvalue, log_prob = torch.tensor([[2.0, 6.0], [0.5, 2.0]]).double().log()
    for temperature, expected in ((1.0, 1.945910), (2.0, 2.799000)):
        value = functional.soft_maximum(qvalue, log_prob, temperature=temperature)
        assert value.item() == pytest.approx(expected, abs=1e-6)


def test_the_constraint_has_a_floor_with_cqls_soft_maximum_alone() -> None:
    """Gibbs: log of the integral of exp(Q), less E_I Q, is no less than its entropy.

    Actions are nine cells of width 2 / 9, so that all integrals are sums.
    """
    density = torch.tensor(4.5, dtype=torch.float64).log()
    model = Categorical(logits=3 * torch.randn(500, 9, dtype=torch.float64))
    floor = model.entropy() - density

    def gap(qvalue: torch.Tensor) -> torch.Tensor:
        soft = functional.soft_maximum(qvalue, density.expand(500, 9))
        return functional.conservative_gap(soft, (model.probs * qvalue).sum(-1))

    qvalue = 30 * torch.randn(500, 9, dtype=torch.float64)
    assert (gap(qvalue) >= floor - 1e-9).all()
    # The log-density itself is at the floor.
    torch.testing.assert_close(gap(model.logits + density), floor)
