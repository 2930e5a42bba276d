"""What the recovery term teaches in a linear-Gaussian world, where it is known.

``s' = A s + B a + w`` with ``w ~ N(0, w^2)`` and behaviour ``a ~ N(k s, b^2)``. Given
``(s, s')`` the action is Gaussian with mean ``k s + G (s' - (A + B k) s)``, gain
``G = B b^2 / (w^2 + B^2 b^2)``.
"""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal

from torchrl_osr import InverseDynamicsLoss, StateRecoveryLoss

A, B, GAIN, BEHAVIOR_STD, NOISE_STD = 0.9, 0.5, -0.3, 0.4, 0.1
# So wide that the tanh is a straight line where the actions are, to 1 %.
BOUND = 20.0


def linear_gaussian(*inputs) -> ProbabilisticActor:
    """Return a tanh-Gaussian with linear mean and one free standard deviation."""
    network = TensorDictSequential(
        TensorDictModule(MLP(len(inputs), 2, depth=0), list(inputs), ["param"]),
        TensorDictModule(NormalParamExtractor("exp"), ["param"], ["loc", "scale"]),
    )
    bound = torch.tensor(BOUND).double()
    return ProbabilisticActor(
        network, in_keys=["loc", "scale"], distribution_class=TanhNormal,
        distribution_kwargs={"low": -bound, "high": bound},
    ).double()  # fmt: skip


def exact_draws(*size: int) -> Tensor:
    """Return Gaussian draws of mean 0 and covariance 1, exactly.

    All that is learnt below depends on these moments alone: few rows are enough.
    """
    draws = torch.randn(*size, dtype=torch.float64)
    draws = draws - draws.mean(0)
    factor = torch.linalg.cholesky(draws.T @ draws / len(draws))
    return torch.linalg.solve_triangular(factor, draws.T, upper=False).T


def pushed_rows(push: float, width: float = 1.0) -> TensorDict:
    """Return 64 rows of this world and pushed states, second moments exact.

    Here it is the action before the tanh that is linear in the state, so that linear
    networks are of the right class.
    """
    draws = exact_draws(64, 4)
    state = width * draws[:, :1]
    action = GAIN * state + BEHAVIOR_STD * draws[:, 1:2]
    after = A * state + B * action + NOISE_STD * draws[:, 2:3]
    done = torch.zeros_like(state, dtype=torch.bool)
    rows = {"observation": state, "action": BOUND * action.tanh()}
    rows["next"] = {"observation": after, "done": done}
    rows = TensorDict(rows, [64])
    rows["perturbed", "observation"] = rows["observation"] + push * draws[:, 3:]
    return rows


def most_likely_model(rows: TensorDict, states: list[Tensor]) -> torch.nn.Module:
    """Return the linear Gaussian model of ``(s, s')`` at states, by least squares."""
    after = rows["next", "observation"]
    inputs = torch.cat([torch.cat([state, after], -1) for state in states])
    action = (rows["action"] / BOUND).atanh().repeat(len(states), 1)
    solution = torch.linalg.lstsq(inputs, action).solution
    std = (action - inputs @ solution).square().mean().sqrt()
    model = linear_gaussian("observation", ("next", "observation"))
    layer = model[0][0].module[0]
    with torch.no_grad():
        layer.weight.zero_()
        layer.weight[0] = solution[:, 0]
        layer.bias.copy_(torch.stack([torch.zeros_like(std), std.log()]))
    return model


def policy_gradient(actor: torch.nn.Module, loss: Tensor) -> Tensor:
    """Return that by the mean's weight and bias and by the standard deviation.

    Not by the weight of the standard deviation, which depends on third moments.
    """
    layer = actor[0][0].module[0]
    weight, bias = torch.autograd.grad(loss, [layer.weight, layer.bias])
    return torch.cat([weight[0], bias])


def recovery(actor, model, rows: TensorDict, **options) -> Tensor:
    loss = StateRecoveryLoss(actor, model, recovery_weight=1.0, **options)
    return loss(rows)["loss_recovery"]


@pytest.mark.parametrize("push", [1e-3, 0.5, 2.0])
@pytest.mark.parametrize("shuffled", [False, True])
def test_a_model_of_pushed_states_teaches_noisy_cloning(push, shuffled) -> None:
    """For every push and every policy, and even with other rows' next states."""
    rows = pushed_rows(push)
    states = [rows["observation"], rows["perturbed", "observation"]]
    if shuffled:
        after = rows["next", "observation"]
        rows["next", "observation"] = after[torch.randperm(len(rows))]
    fitted, clean = most_likely_model(rows, states), most_likely_model(rows, states[:1])
    term = InverseDynamicsLoss(fitted)(rows)["loss_inverse_dynamics"]
    assert policy_gradient(fitted, term).abs().max() < 1e-9  # the package's own optimum
    for _ in range(3):
        actor = linear_gaussian("observation")
        with torch.no_grad():
            actor[0][0].module[0].weight[1] = 0  # one standard deviation
        given = [TensorDict({"observation": state}, [64]) for state in states]
        cloning = [-actor.get_dist(each).log_prob(rows["action"]) for each in given]
        expected = policy_gradient(actor, torch.cat(cloning).mean())
        found = policy_gradient(actor, recovery(actor, fitted, rows))
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
        # So could a gradient that is zero or that does not see the model.
        assert expected.abs().max() > 1e-2
        if push >= 0.1 and not shuffled:
            by_clean = policy_gradient(actor, recovery(actor, clean, rows))
            assert (by_clean - expected).abs().max() > 1e-4


# k - G (A + B k) push^2 / (width^2 + push^2), with G (A + B k) = 1.2 here.
@pytest.mark.parametrize(
    ("push", "width", "slope"),
    [(1e-3, 1.0, -0.3000012), (0.1, 0.1, -0.9), (0.5, 0.1, -1.4538462)],
)
def test_a_clean_model_adds_a_step_towards_the_data(push, width, slope) -> None:
    """Gain times the squared push times the score of the density of pushed states."""
    rows, actor = pushed_rows(push, width), linear_gaussian("observation")
    model = most_likely_model(rows, [rows["observation"]])
    layer, found = actor[0][0].module[0], []
    for mean in (slope, GAIN):
        with torch.no_grad():
            layer.weight.copy_(torch.tensor([[mean], [0.0]]))
            layer.bias.zero_()
        term = recovery(actor, model, rows, recovery_states="perturbed")
        found.append(policy_gradient(actor, term)[:2])
    # At its minimum, with a standard deviation of 1, but for the rounding of the slope.
    assert found[0].abs().max() < 1e-6
    expected = (GAIN - slope) * (width**2 + push**2)
    assert found[1][0].item() == pytest.approx(expected, abs=1e-6)
