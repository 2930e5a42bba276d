"""Recovery where the answer is known: a linear-Gaussian world, end to end.

``s' = A s + B a + w`` with ``w ~ N(0, w^2)`` and behaviour ``a ~ N(k s, b^2)``. Given
``(s, s')`` the action is Gaussian with mean ``k s + G (s' - (A + B k) s)``, gain
``G = B b^2 / (w^2 + B^2 b^2)``. At a pushed state the recovering policy undoes a share
``B G`` of the push: what is left of the deviation is ``w^2 / (w^2 + B^2 b^2)``.
"""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal

from torchrl_osr import InverseDynamicsLoss, StateRecoveryLoss

A, B, GAIN, BEHAVIOR_STD, NOISE_STD = 0.9, 0.5, -0.3, 0.4, 0.1
# So wide that the tanh is a straight line where the actions are, to 1 %.
BOUND = 20.0
STATE, PUSHED = 1.0, 1.4


def linear_gaussian(*inputs) -> ProbabilisticActor:
    """A tanh-Gaussian with linear mean and one free standard deviation."""
    network = TensorDictSequential(
        TensorDictModule(MLP(len(inputs), 2, depth=0), list(inputs), ["param"]),
        TensorDictModule(NormalParamExtractor("exp"), ["param"], ["loc", "scale"]),
    )
    return ProbabilisticActor(
        network,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={
            "low": torch.tensor(-BOUND).double(),
            "high": torch.tensor(BOUND).double(),
        },
    ).double()


def exact_draws(*size: int) -> torch.Tensor:
    """Gaussian draws whose mean is 0 and whose covariance is the identity, exactly.

    All that is learnt below depends on these moments alone: few rows are enough.
    """
    draws = torch.randn(*size, dtype=torch.float64)
    draws = draws - draws.mean(0)
    factor = torch.linalg.cholesky(draws.T @ draws / len(draws))
    return torch.linalg.solve_triangular(factor, draws.T, upper=False).T


def transitions(
    state: torch.Tensor, draws: torch.Tensor, behavior_std: float
) -> TensorDict:
    """Behaviour and dynamics at the given states ``[B, 1]``, with draws ``[B, 2]``."""
    action = GAIN * state + behavior_std * draws[:, :1]
    next_state = A * state + B * action + NOISE_STD * draws[:, 1:]
    no = torch.zeros_like(state, dtype=torch.bool)
    return TensorDict(
        {
            "observation": state,
            "action": action,
            "next": {
                "observation": next_state,
                "done": no,
            },
        },
        [len(state)],
    )


def minimize(loss, key: str, batch: TensorDict) -> None:
    optimizer = torch.optim.LBFGS(
        list(loss.parameters()), max_iter=200, line_search_fn="strong_wolfe"
    )

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        value = loss(batch)[key]
        value.backward()
        return value

    optimizer.step(closure)


@pytest.mark.parametrize("behavior_std", [BEHAVIOR_STD, 0.04])
def test_what_is_left_of_a_push_is_the_closed_form(behavior_std) -> None:
    variance = NOISE_STD**2 + B**2 * behavior_std**2
    actor = linear_gaussian("observation")
    model = linear_gaussian("observation", ("next", "observation"))
    draws = exact_draws(2_000, 3)
    data = transitions(draws[:, :1], draws[:, 1:], behavior_std)
    model_loss = InverseDynamicsLoss(model, states="clean")
    minimize(model_loss, "loss_inverse_dynamics", data)
    by_state, by_next = BOUND * model[0][0].module[0].weight[0]
    gain = B * behavior_std**2 / variance
    assert by_next.item() == pytest.approx(gain, rel=0.02)
    assert by_state.item() == pytest.approx(GAIN - gain * (A + B * GAIN), abs=0.02)

    # One state and one push, so that the policy can know where it came from.
    state = torch.full((2_000, 1), STATE, dtype=torch.float64)
    batch = transitions(state, exact_draws(2_000, 2), behavior_std)
    batch["perturbed", "observation"] = torch.full_like(batch["observation"], PUSHED)
    loss = StateRecoveryLoss(
        actor, model, recovery_weight=1.0, recovery_states="perturbed"
    )
    minimize(loss.double(), "loss_recovery", batch)
    policy = actor.get_dist(batch["perturbed"].auto_batch_size_(1))
    action, std = BOUND * policy.loc[0].item(), BOUND * policy.scale[0].item()
    pushed = A * PUSHED + B * action
    undisturbed = (A + B * GAIN) * STATE
    left = (pushed - undisturbed) / ((A + B * GAIN) * (PUSHED - STATE))
    # 0.2 for the wide behaviour; hardly any recovery (0.96) where it is nearly
    # deterministic: there the data do not show how to come back.
    assert left == pytest.approx(NOISE_STD**2 / variance, abs=0.02)
    assert std == pytest.approx(behavior_std, abs=0.01)


def pushed_rows(push: float, width: float = 1.0) -> TensorDict:
    """64 rows of this world and their pushed states, second moments exact.

    Here it is the action before the tanh that is linear in the state, so that linear
    networks are of the right class.
    """
    state, behavior, noise, push_noise = exact_draws(64, 4).split(1, -1)
    state = width * state
    action = GAIN * state + BEHAVIOR_STD * behavior
    next_state = A * state + B * action + NOISE_STD * noise
    no = torch.zeros_like(state, dtype=torch.bool)
    rows = {
        "observation": state,
        "action": BOUND * action.tanh(),
        "next": {"observation": next_state, "done": no},
        "perturbed": {"observation": state + push * push_noise},
    }
    return TensorDict(rows, [64])


def most_likely_model(rows: TensorDict, states: list[torch.Tensor]) -> torch.nn.Module:
    """Linear Gaussian model of ``(s, s')`` at the given states, by least squares."""
    following = rows["next", "observation"]
    inputs = torch.cat([torch.cat([state, following], -1) for state in states])
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


def policy_gradient(actor: torch.nn.Module, loss: torch.Tensor) -> torch.Tensor:
    """By the mean's weight and bias and by the standard deviation.

    Not by the weight of the standard deviation, which depends on third moments.
    """
    layer = actor[0][0].module[0]
    weight, bias = torch.autograd.grad(loss, [layer.weight, layer.bias])
    return torch.cat([weight[0], bias])


@pytest.mark.parametrize("push", [1e-3, 0.1, 0.5, 2.0])
@pytest.mark.parametrize("shuffled", [False, True])
def test_a_model_of_pushed_states_teaches_noisy_cloning(push, shuffled) -> None:
    """For every push and every policy, and even with other rows' next states."""
    rows = pushed_rows(push)
    states = [rows["observation"], rows["perturbed", "observation"]]
    if shuffled:
        following = rows["next", "observation"]
        rows["next", "observation"] = following[torch.randperm(len(rows))]
    models = [most_likely_model(rows, states), most_likely_model(rows, states[:1])]
    fit = InverseDynamicsLoss(models[0])(rows)["loss_inverse_dynamics"]
    slopes = policy_gradient(models[0], fit)
    assert slopes.abs().max() < 1e-9  # the package's own optimum
    for _ in range(5):
        actor = linear_gaussian("observation")
        with torch.no_grad():
            actor[0][0].module[0].weight[1] = 0  # one standard deviation
        cloning = [
            -actor.get_dist(TensorDict({"observation": state}, [64])).log_prob(
                rows["action"]
            )
            for state in states
        ]
        expected = policy_gradient(actor, torch.cat(cloning).mean())
        by_fitted, by_clean = (
            policy_gradient(
                actor,
                StateRecoveryLoss(actor, model, recovery_weight=1.0)(rows)[
                    "loss_recovery"
                ],
            )
            for model in models
        )
        torch.testing.assert_close(by_fitted, expected, rtol=1e-9, atol=1e-9)
        # So could a gradient that is zero or that does not see the model.
        assert expected.abs().max() > 1e-2
        if push >= 0.1 and not shuffled:
            assert (by_clean - expected).abs().max() > 1e-4


@pytest.mark.parametrize(
    ("push", "width", "slope"),
    [  # k - G (A + B k) push^2 / (width^2 + push^2), with G (A + B k) = 1.2 here
        (1e-3, 1.0, -0.3000012),
        (0.1, 1.0, -0.3118812),
        (0.1, 0.1, -0.9),
        (0.5, 1.0, -0.54),
        (0.5, 0.1, -1.4538462),
    ],
)
def test_a_clean_model_adds_a_multiple_of_the_way_to_the_data(
    push, width, slope
) -> None:
    """Gain times the squared push times the score of the density of pushed states."""
    rows = pushed_rows(push, width)
    model = most_likely_model(rows, [rows["observation"]])
    actor = linear_gaussian("observation")
    loss = StateRecoveryLoss(
        actor, model, recovery_weight=1.0, recovery_states="perturbed"
    )
    layer = actor[0][0].module[0]
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[slope], [0.0]]))
        layer.bias.zero_()
    weight, bias = torch.autograd.grad(
        loss(rows)["loss_recovery"], [layer.weight, layer.bias]
    )
    # At its minimum, with a standard deviation of 1, but for the rounding of the slope.
    assert abs(weight[0].item()) < 1e-6
    assert abs(bias[0].item()) < 1e-6
    with torch.no_grad():
        layer.weight[0] = GAIN
    moved = torch.autograd.grad(loss(rows)["loss_recovery"], layer.weight)[0][0]
    expected = (GAIN - slope) * (width**2 + push**2)
    assert moved.item() == pytest.approx(expected, abs=1e-6)
