"""What labels at displaced states teach, in linear worlds with Gaussian noise.

Statements of docs/method.md about all methods of the kind; those about this package's
losses are in tests/objectives/test_linear_gaussian.py. Least squares on rows whose
second moments are exact, against closed forms.

Shapes: ``N`` rows, ``S`` state, ``A`` action; a matrix acts on rows as
``s @ dynamics.T``.
"""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

ROWS = 200
DOUBLE = torch.float64


def exact_draws(*widths: int) -> list[Tensor]:
    """Noise with mean 0, variance 1 and no correlation, exactly, ``[N, width]``."""
    draws = torch.randn(ROWS, sum(widths), dtype=DOUBLE)
    draws = draws - draws.mean(0)
    return list((torch.linalg.qr(draws)[0] * ROWS**0.5).split(widths, -1))


def regression(target: Tensor, *inputs: Tensor) -> Tensor:
    """Least-squares coefficients, ``[target, inputs]``."""
    return torch.linalg.lstsq(torch.cat(inputs, -1), target).solution.T


def world(push: float, behavior: float = 0.4) -> SimpleNamespace:
    """Random dynamics and behaviour with 3 states and 2 actions; pushed states."""
    dynamics = torch.randn(3, 3, dtype=DOUBLE) / 2
    control = torch.randn(3, 2, dtype=DOUBLE)
    gain = torch.randn(2, 3, dtype=DOUBLE) / 3
    factor = torch.randn(3, 3, dtype=DOUBLE) / 2
    start, explore, disturbance, displaced = exact_draws(3, 2, 3, 3)
    state = start @ factor.T
    action = state @ gain.T + behavior * explore
    covariance = factor @ factor.T
    pushed = covariance + push**2 * torch.eye(3, dtype=DOUBLE)
    return SimpleNamespace(
        push=push,
        dynamics=dynamics,
        control=control,
        gain=gain,
        closed_loop=dynamics + control @ gain,
        behavior=behavior,
        score=-torch.linalg.inv(pushed),  # of the pushed states' density, times s
        kept=covariance @ torch.linalg.inv(pushed),  # E[s | pushed s] = kept pushed s
        displaced=displaced,
        state=state,
        action=action,
        after=state @ dynamics.T + action @ control.T + 0.1 * disturbance,
        pushed=state + push * displaced,
    )


def averaged(model: Tensor, it: SimpleNamespace) -> Tensor:
    """The model's action at pushed states, mean over the next states, as a gain."""
    return regression(torch.cat([it.pushed, it.after], -1) @ model.T, it.pushed)


def assert_equal(value: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(value, expected, rtol=1e-8, atol=1e-8)


PUSHES = pytest.mark.parametrize("push", [1e-3, 1e-2, 0.1, 0.5, 3.0])


@PUSHES
def test_a_model_of_pushed_states_gives_the_label_of_noisy_cloning(push) -> None:
    it = world(push)
    cloning = regression(it.action, it.pushed)
    model = regression(it.action, it.pushed, it.after)
    assert_equal(averaged(model, it), cloning)
    # The behaviour's gain, weakened as by any error in the inputs.
    assert_equal(cloning, it.gain @ it.kept)


@PUSHES
def test_a_clean_model_adds_its_gain_times_the_score_of_the_data(push) -> None:
    it = world(push)
    model = regression(it.action, it.state, it.after)
    explored = it.behavior**2 * it.control
    spread = explored @ it.control.T + 0.01 * torch.eye(3, dtype=DOUBLE)
    gain = explored.T @ torch.linalg.inv(spread)
    back = gain @ it.closed_loop @ it.score * push**2
    assert_equal(averaged(model, it), it.gain + back)


def test_a_clean_model_of_a_deterministic_behaviour_adds_nothing() -> None:
    it = world(0.5, behavior=0.0)
    model = regression(it.action, it.state, it.after)
    assert_equal(averaged(model, it), it.gain)


def squared_distance(
    it: SimpleNamespace, gain: Tensor, seen: Tensor, model_input: Tensor
) -> Tensor:
    """Of the next state that a true model predicts, from the data's; mean of rows."""
    reached = model_input @ it.dynamics.T + seen @ gain.T @ it.control.T
    return (reached - it.after).square().sum(-1).mean()


@PUSHES
def test_noise_that_only_the_model_sees_teaches_the_policy_nothing(push) -> None:
    """As in SCAS's released code: the policy acts on the clean state."""
    it = world(push)
    gain = torch.randn(2, 3, dtype=DOUBLE, requires_grad=True)
    clean = squared_distance(it, gain, it.state, it.state)
    noisy = squared_distance(it, gain, it.state, it.pushed)
    assert_equal(noisy - clean, push**2 * it.dynamics.square().sum())
    slopes = [torch.autograd.grad(loss, gain)[0] for loss in (clean, noisy)]
    assert_equal(*slopes)
    assert slopes[0].abs().max() > 1e-3


@PUSHES
def test_noise_that_the_policy_sees_asks_for_contraction_in_one_step(push) -> None:
    it = world(push)
    gain = torch.randn(2, 3, dtype=DOUBLE, requires_grad=True)
    clean = squared_distance(it, gain, it.state, it.state)
    noisy = squared_distance(it, gain, it.pushed, it.pushed)
    one_step = it.dynamics + it.control @ gain
    assert_equal(noisy - clean, push**2 * one_step.square().sum())
    wanted = it.closed_loop @ it.kept - it.dynamics
    best = (torch.linalg.pinv(it.control) @ wanted).requires_grad_()
    loss = squared_distance(it, best, it.pushed, it.pushed)
    (slope,) = torch.autograd.grad(loss, best)
    assert_equal(slope, torch.zeros_like(slope))


def test_noise_that_only_a_curved_model_sees_teaches_with_its_square() -> None:
    it = world(0.0)
    model = torch.nn.Sequential(
        torch.nn.Linear(5, 16), torch.nn.Tanh(), torch.nn.Linear(16, 3)
    ).double()
    gain = torch.randn(2, 3, dtype=DOUBLE, requires_grad=True)

    def slope(push: float) -> Tensor:
        action = it.state @ gain.T
        loss = sum(
            (model(torch.cat([it.state + sign * push * it.displaced, action], -1)))
            .sub(it.after)
            .square()
            .mean()
            for sign in (-1, 1)  # a density that is symmetric
        )
        return torch.autograd.grad(loss, gain)[0]

    wide, narrow = ((slope(push) - slope(0.0)).norm() for push in (0.1, 0.01))
    assert wide / narrow == pytest.approx(100, rel=0.05)


@pytest.mark.parametrize(
    ("push", "noisy", "clean_model", "forward", "values"),
    [
        (0.01, 0.9537, 0.9535, 0.9536, 0.9527),
        (0.03, 0.9557, 0.9544, 0.9554, 0.9463),
        (0.10, 0.9686, 0.9616, 0.9675, 0.9667),
        (0.30, 0.9935, 0.9781, 0.9925, 0.9752),
    ],
)
def test_one_step_labels_slow_an_underactuated_controller_down(
    push, noisy, clean_model, forward, values
) -> None:
    """A cart with a pole, in standard deviations; largest eigenvalue, 1 is unstable.

    The expert's is 0.9534. Cloning with noise comes back more slowly the more noise
    there is, and so does any target that is one step ahead in a metric of states. A
    metric of values can be faster than the expert, but not for every width.
    """
    step = 0.05
    dynamics = torch.eye(4, dtype=DOUBLE)
    dynamics[0, 1] = dynamics[1, 2] = dynamics[2, 3] = step
    dynamics[3, 2] = 6 * step
    control = torch.tensor([[0.0], [1.0], [0.0], [2.0]], dtype=DOUBLE) * step
    cost = torch.tensor([1.0, 0.1, 1.0, 0.1], dtype=DOUBLE).diag()
    value, gain = cost, torch.zeros(1, 4, dtype=DOUBLE)
    for _ in range(1000):  # Riccati's equation, with a cost of 0.1 of the action
        gain = -(control.T @ value @ dynamics) / (0.1 + control.T @ value @ control)
        value = cost + dynamics.T @ value @ (dynamics + control @ gain)
    closed_loop = dynamics + control @ gain
    # Lyapunov's: where the noise on the actions leaves the states.
    spread = 0.3**2 * control @ control.T + 1e-6 * torch.eye(4, dtype=DOUBLE)
    flat = torch.eye(16, dtype=DOUBLE) - torch.kron(closed_loop, closed_loop)
    covariance = torch.linalg.solve(flat, spread.flatten()).reshape(4, 4)
    variance = covariance.diag()
    kept = covariance @ torch.linalg.inv(covariance + (push**2 * variance).diag())
    explained = (0.3**2 * control).T @ torch.linalg.inv(spread)

    def slowest(policy: Tensor) -> float:
        eigenvalues = torch.linalg.eigvals(dynamics + control @ policy)
        return float(eigenvalues.abs().max())

    def best_in(metric: Tensor) -> Tensor:
        reached = metric @ (closed_loop @ kept - dynamics)
        return torch.linalg.pinv(metric @ control) @ reached

    assert slowest(gain) == pytest.approx(0.9534, abs=5e-5)
    assert slowest(gain @ kept) == pytest.approx(noisy, abs=5e-5)
    back = explained @ closed_loop @ (kept - torch.eye(4, dtype=DOUBLE))
    assert slowest(gain + back) == pytest.approx(clean_model, abs=5e-5)
    standardised = variance.rsqrt().diag()
    assert slowest(best_in(standardised)) == pytest.approx(forward, abs=5e-5)
    of_values = torch.linalg.cholesky(value).T
    assert slowest(best_in(of_values)) == pytest.approx(values, abs=5e-5)
