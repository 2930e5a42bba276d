"""The model as a controller reaches what it can reach, in numbers found by hand."""

from __future__ import annotations

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs import ObservationNorm
from torchrl.modules import ProbabilisticActor, TanhNormal

from torchrl_osr.film import InverseDynamicsController
from torchrl_osr.modules import cvae_inverse_dynamics

# x' = A x + B a, and by hand B^-1: a = B^-1 (x' - A x).
A = torch.tensor([[1.0, 0.5], [0.0, 1.0]])
B = torch.tensor([[2.0, 0.0], [0.0, 4.0]])
B_INVERSE = torch.tensor([[0.5, 0.0], [0.0, 0.25]])


class ExactInverse(nn.Module):
    """Mean before the tanh of the action that leads from a state to the next one."""

    def __init__(self, loc: torch.Tensor, scale: torch.Tensor) -> None:
        super().__init__()
        self.loc, self.scale = loc, scale

    def forward(self, observation, next_observation):
        observation = observation * self.scale + self.loc
        next_observation = next_observation * self.scale + self.loc
        action = (next_observation - observation @ A.T) @ B_INVERSE.T
        return torch.atanh(action), torch.full_like(action, 0.1)


def exact_model(loc=(0.0, 0.0), scale=(1.0, 1.0)) -> ProbabilisticActor:
    module = TensorDictModule(
        ExactInverse(torch.tensor(loc), torch.tensor(scale)),
        ["observation", ("next", "observation")],
        ["loc", "scale"],
    )
    return ProbabilisticActor(
        TensorDictSequential(module),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
    )


def step(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    return state @ A.T + action @ B.T


def test_exact_inverse_reaches_the_reference_in_one_step_and_stays_on_it():
    reference = torch.tensor([[0.0, 0.0], [0.2, 0.4], [0.6, 0.4], [1.0, 0.8]])
    controller = InverseDynamicsController(exact_model(), [reference])
    state = torch.tensor([[0.4, -0.8]])  # knocked off (0, 0)
    first = controller(state)
    # x' - A x = (0.2, 0.4) - (0.4 - 0.4, -0.8) = (0.2, 1.2); times B^-1: (0.1, 0.3).
    torch.testing.assert_close(first, torch.tensor([[0.1, 0.3]]))
    state = step(state, first)
    torch.testing.assert_close(state, reference[1:2])
    for target in reference[2:]:
        state = step(state, controller(state))
        torch.testing.assert_close(state[0], target)
    assert controller.step == 3


def test_standardised_states_are_what_the_model_reads():
    loc, scale = (1.0, -2.0), (2.0, 0.5)
    norm = ObservationNorm(
        torch.tensor(loc), torch.tensor(scale), in_keys=["observation"],
        standard_normal=True,
    )  # fmt: skip
    reference = torch.tensor([[0.0, 0.0], [0.2, 0.4]])
    state = torch.tensor([[0.4, -0.8]])
    for rule in ("time", "nearest"):
        controller = InverseDynamicsController(
            exact_model(loc, scale), [reference], rule=rule, observation_norm=norm
        )
        torch.testing.assert_close(controller(state), torch.tensor([[0.1, 0.3]]))


def test_nearest_is_measured_in_standard_deviations():
    # Raw, the first is nearest, by 3 in y; with scales of 0.1 and 10, the second.
    norm = ObservationNorm(
        torch.zeros(2), torch.tensor([0.1, 10.0]), in_keys=["observation"],
        standard_normal=True,
    )  # fmt: skip
    reference = torch.tensor([[0.0, 0.0], [1.0, 30.0], [5.0, 5.0]])
    state = torch.tensor([[0.9, 3.0]])
    raw = InverseDynamicsController(exact_model(), [reference], rule="nearest")
    assert raw.targets(state).tolist() == [[1.0, 30.0]]
    scaled = InverseDynamicsController(
        exact_model(), [reference], rule="nearest", observation_norm=norm
    )
    # 9 and 0.3 from the first, 1 and 2.7 from the second: whose successor it is.
    torch.testing.assert_close(
        scaled.targets(state / norm.scale), reference[2:] / norm.scale
    )


def test_time_target_is_the_next_state_and_holds_at_the_end():
    reference = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    controller = InverseDynamicsController(exact_model(), [reference])
    targets = []
    for controller.step in range(4):
        targets.append(controller.targets(torch.zeros(1, 2))[0, 0].item())
    assert targets == [1, 2, 2, 2]


def test_nearest_target_is_the_successor_whatever_the_time():
    reference = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    controller = InverseDynamicsController(exact_model(), [reference], rule="nearest")

    def target(*state: float) -> list[float]:
        controller.step += 1
        return controller.targets(torch.tensor([state]))[0].tolist()

    assert target(0.1, -0.2) == [1, 0]
    assert target(0.9, 0.2) == [1, 1]
    assert target(1.2, 0.9) == [0, 1]
    assert target(0.0, 1.0) == [1, 0], "the last has no successor; (0, 0) is first"


def test_every_row_has_its_own_reference_of_its_own_length():
    references = [torch.tensor([[0.0, 0.0], [0.2, 0.0]]), torch.zeros(5, 2)]
    controller = InverseDynamicsController(exact_model(), references)
    actions = controller(torch.zeros(2, 2))
    torch.testing.assert_close(actions, torch.tensor([[0.1, 0.0], [0.0, 0.0]]))


def test_latent_is_at_its_mean():
    model = cvae_inverse_dynamics(2, 2, latent_dim=3, num_cells=[8])
    references = [torch.randn(4, 2)] * 2
    state = torch.randn(2, 2)
    first, second = (
        InverseDynamicsController(model, references)(state) for _ in range(2)
    )
    assert torch.equal(first, second)


def test_a_row_that_is_missing_is_an_error():
    controller = InverseDynamicsController(exact_model(), [torch.zeros(3, 2)] * 2)
    with pytest.raises(ValueError, match="1 observations for 2 references"):
        controller(torch.zeros(1, 2))


@pytest.mark.parametrize(
    ("references", "rule", "named"),
    [
        ([torch.zeros(1, 2)], "time", r"reference 0 has shape \(1, 2\)"),
        ([torch.zeros(3, 2), torch.zeros(3)], "time", r"reference 1 has shape \(3,\)"),
        ([torch.zeros(3, 2)], "next", "rule"),
    ],
)
def test_bad_input_is_named(references, rule, named):
    with pytest.raises(ValueError, match=named):
        InverseDynamicsController(exact_model(), references, rule=rule)
