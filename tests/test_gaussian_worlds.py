"""What labels at displaced states teach, in linear worlds with Gaussian noise.

Statements of docs/method.md about all methods of the kind; those about this package's
losses are in tests/objectives/test_linear_gaussian.py.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

DOUBLE = torch.float64


@pytest.mark.parametrize("push", [1e-3, 0.1, 3.0])
def test_noise_that_only_a_model_sees_teaches_the_policy_nothing(push) -> None:
    """Squared distance of a true model's next state from the data's."""
    rows = torch.linalg.qr(torch.randn(200, 6, dtype=DOUBLE))[0] * 200**0.5
    state, noise = (rows - rows.mean(0)).split(3, -1)
    noise = noise - state @ torch.linalg.lstsq(state, noise).solution
    noise = torch.linalg.qr(noise)[0] * 200**0.5  # of variance 1, exactly
    dynamics, control = torch.randn(3, 5, dtype=DOUBLE).split([3, 2], -1)
    gain = torch.randn(2, 3, dtype=DOUBLE, requires_grad=True)
    after = state @ torch.randn(3, 3, dtype=DOUBLE)
    pushed = state + push * noise

    def distance(seen: Tensor, start: Tensor) -> Tensor:
        reached = start @ dynamics.T + seen @ gain.T @ control.T
        return (reached - after).square().sum(-1).mean()

    clean, unseen, seen = (
        distance(state, state), distance(state, pushed), distance(pushed, pushed)
    )  # fmt: skip
    # As in SCAS's released code: the policy acts on the clean state.
    constant = push**2 * dynamics.square().sum()
    torch.testing.assert_close(unseen - clean, constant, rtol=1e-8, atol=1e-8)
    # Where it sees the noise it is asked for contraction in one step.
    one_step = push**2 * (dynamics + control @ gain).square().sum()
    torch.testing.assert_close(seen - clean, one_step, rtol=1e-8, atol=1e-8)
    slopes = [torch.autograd.grad(loss, gain)[0] for loss in (clean, unseen)]
    torch.testing.assert_close(*slopes, rtol=1e-8, atol=1e-8)


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
