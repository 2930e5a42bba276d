"""Look-ahead in worlds in which the right plan is known."""

from __future__ import annotations

import pytest
import torch
from cart_world import cart
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_osr.imagination import LookAheadPolicy
from torchrl_osr.modules import EliteNetworks

STEP = 0.1
EDGE = 1.0


def networks(*bias: float, elites: int = 1) -> EliteNetworks:
    return EliteNetworks(cart(*bias, elites=elites, step=STEP))


def over_the_edge(state: Tensor) -> Tensor:
    return state[..., 0].abs() > EDGE


def coast(state: Tensor) -> Tensor:
    return torch.zeros(len(state), 1)


def everywhere(state: Tensor) -> Tensor:
    return torch.ones(len(state), dtype=torch.bool)


def survivors(policy, state: Tensor, steps: int) -> Tensor:
    """Who has not gone over the edge, in the world itself and in double precision."""
    state = state.double()
    alive = torch.ones(len(state), dtype=torch.bool)
    for _ in range(steps):
        action = policy(state.float()).double().clamp(-1, 1)
        position, velocity = state.split(1, -1)
        state = torch.cat([position + STEP * velocity, velocity + STEP * action], -1)
        alive &= ~over_the_edge(state)
    return alive


# Who brakes with all its might comes to rest after v^2 / 2, and half a step.
FAST = torch.tensor([[0.0, 1.2], [0.0, -1.2], [0.5, 0.85], [-0.9, 1.7]])


class Permuted(LookAheadPolicy):
    """Predictions of other candidates: what a plan owes to the model."""

    generator = torch.Generator().manual_seed(0)

    def scores(self, observation: Tensor, offsets: Tensor) -> Tensor:
        scores = super().scores(observation, offsets)
        order = torch.rand(scores.shape, generator=self.generator).argsort(1)
        return scores.gather(1, order)


def test_a_plan_survives_where_the_policy_does_not_and_the_model_is_why() -> None:
    options = {"terminated": over_the_edge, "std": 1.0, "planning_horizon": 20}
    look_ahead = LookAheadPolicy(coast, networks(), everywhere, **options)
    assert not survivors(coast, FAST, 30).any()
    assert survivors(look_ahead, FAST, 30).all()
    permuted = Permuted(coast, networks(), everywhere, **options)
    assert not survivors(permuted, FAST, 30).all()


def test_on_the_data_it_is_the_policy_bit_for_bit() -> None:
    def policy(state: Tensor) -> Tensor:
        return (3 * state[:, :1]).tanh() * 1.001  # out of its bounds by a little

    states = torch.randn(64, 2, generator=torch.Generator().manual_seed(0))
    options = {"terminated": over_the_edge, "planning_horizon": 20, "num_candidates": 8}
    options["top_k"] = 2
    never = LookAheadPolicy(policy, networks(), lambda s: s[:, 0] > 99, **options)
    assert torch.equal(never(states), policy(states))
    some = LookAheadPolicy(policy, networks(), lambda s: s[:, 0] > 0.5, **options)
    far = states[:, 0] > 0.5
    assert torch.equal(some(states)[~far], policy(states)[~far])
    assert not torch.equal(some(states)[far], policy(states)[far])


def test_without_a_better_way_it_is_the_policy() -> None:
    still = torch.zeros(3, 2)
    look_ahead = LookAheadPolicy(
        coast, networks(), everywhere, terminated=over_the_edge
    )
    assert torch.equal(look_ahead(still), coast(still))
    fallen = torch.tensor([[5.0, 0.0], [torch.nan, 0.0]])
    assert torch.equal(look_ahead(fallen), coast(fallen))
    look_ahead.value = lambda state: state[:, 1]
    assert torch.equal(look_ahead(fallen), coast(fallen))


def test_scores_are_the_steps_survived_and_the_value_of_the_last_state() -> None:
    # One network is pushed by .1 a step, one by -.1; the third is no elite.
    model = networks(0.1, -0.1, 50.0, elites=2)
    look_ahead = LookAheadPolicy(
        coast, model, everywhere, terminated=lambda s: s[:, 1] > 0.45,
        value=lambda s: 100 * s[:, 1], planning_horizon=5, num_offsets=2, hold=2,
        top_k=1,
    )  # fmt: skip
    offsets = torch.tensor([[0.0, 0.0], [1.0, 1.0], [3.0, 0.0]]).view(1, 3, 2, 1)
    scores = look_ahead.scores(torch.zeros(1, 2), offsets)
    # v after each step: .1 .2 .3 .4 (.5 has ended) and -.1 ... -.5;
    # .2 .4 (.6) and 0 0 0 0 -.1; the offset 3 is clipped to 1: .2 .4 (.5), 0 0 -.1 ...
    wanted = [(4 + 5 - 50) / 2, (2 + 5 - 10) / 2, (2 + 5 - 30) / 2]
    torch.testing.assert_close(scores, torch.tensor([wanted]))


def test_a_value_leads_beyond_the_horizon() -> None:
    def value(state: Tensor) -> Tensor:
        return -(state[:, 0] - 0.5).abs()

    states = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
    look_ahead = LookAheadPolicy(coast, networks(), everywhere, value=value)
    none, best = torch.zeros(2, 5, 1), look_ahead.plan(states)
    scores = look_ahead.scores(states, torch.stack([none, best], 1))
    torch.testing.assert_close(scores[:, 0], torch.full([2], 40 - 0.5))
    torch.testing.assert_close(scores[:, 1], torch.full([2], 40.0), atol=0.05, rtol=0)


def test_it_is_a_function_of_the_state() -> None:
    options = {"terminated": over_the_edge, "planning_horizon": 20}

    def make(seed: int) -> LookAheadPolicy:
        generator = torch.Generator().manual_seed(seed)
        return LookAheadPolicy(
            coast, networks(), everywhere, generator=generator, **options
        )

    together = make(0)(FAST)
    once_more = make(0)
    for row in (2, 0, 3, 1):
        torch.testing.assert_close(once_more(FAST[row : row + 1])[0], together[row])
    assert not torch.allclose(make(1)(FAST), together)


def test_a_standardised_model_plans_as_the_one_in_the_tasks_units() -> None:
    loc, scale = torch.tensor([0.3, -1.0]), torch.tensor([2.0, 0.25])
    standardised = cart(step=STEP)
    with torch.no_grad():
        # The same world: inputs are brought back, targets divided.
        standardised.input_loc[:2] = -loc / scale
        standardised.input_scale[:2] = 1 / scale
        standardised.target_scale[:2] = 1 / scale
    options = {"terminated": over_the_edge, "planning_horizon": 20}
    models = networks(), EliteNetworks(standardised, loc, scale)
    pair = [LookAheadPolicy(coast, each, everywhere, **options) for each in models]
    plans = [each.plan(FAST) for each in pair]
    torch.testing.assert_close(*plans, rtol=1e-4, atol=1e-4)


def test_it_is_a_policy_for_torchrl() -> None:
    look_ahead = LookAheadPolicy(coast, networks(), everywhere, planning_horizon=20)
    module = TensorDictModule(look_ahead, ["observation"], ["action"])
    batch = module(TensorDict({"observation": FAST}, [4]))
    assert torch.equal(batch["action"], look_ahead(FAST))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"planning_horizon": 19}, "planning_horizon must be at least 20"),
        ({"top_k": 64}, "top_k must be between 1 and num_candidates - 1 = 63, got 64"),
        ({"hold": 0}, "hold must be at least 1"),
        ({"std": 0.0}, "std must be above 0"),
    ],
)
def test_bad_arguments_are_named(options, message) -> None:
    with pytest.raises(ValueError, match=message):
        LookAheadPolicy(coast, networks(), everywhere, **options)
