"""Roll-outs in worlds that can be computed by hand."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_osr.lab.dynamics import DynamicsEnsemble, disturbed, imagine

ALMOST_NOTHING = -40.0
"""A log-variance."""


def linear_world(
    *, spread: float = 0.0, log_variance: float = ALMOST_NOTHING, elites: int = 2
) -> DynamicsEnsemble:
    """The state grows by the action, plus or minus ``spread``; the reward is the state.

    Network 0 adds the spread, 1 takes it off, 2 is far away and no elite.
    """
    model = DynamicsEnsemble(1, 1, num_networks=3, num_elites=elites, num_cells=[])
    (layer,) = model.layers
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.zero_()
        layer.weight[:, 1, 0] = 1  # action to change
        layer.weight[:, 0, 1] = 1  # state to reward
        layer.bias[:, 0, 0] = torch.tensor([spread, -spread, 1e6])
        # Bounds far apart do not bend what lies between them.
        model.lowest_log_variance.fill_(-60)
        model.highest_log_variance.fill_(60)
        layer.bias[:, 0, 2:] = log_variance
    return model


def one(state: torch.Tensor) -> torch.Tensor:
    return torch.ones_like(state)


def test_rows_are_those_of_a_known_world() -> None:
    rows, refused = imagine(linear_world(), one, torch.tensor([[0.0], [10.0]]), steps=3)
    assert refused == 0
    assert rows["observation"].flatten().tolist() == [0, 10, 1, 11, 2, 12]
    after = rows["next", "observation"].flatten()
    torch.testing.assert_close(after, rows["observation"].flatten() + 1)
    torch.testing.assert_close(rows["next", "reward"], rows["observation"])
    assert rows["step"].flatten().tolist() == [0, 0, 1, 1, 2, 2]
    assert not rows["next", "done"].any()


def test_rollouts_stop_at_terminations() -> None:
    starts = torch.tensor([[0.0], [2.5], [9.0]])
    rows, _ = imagine(
        linear_world(), one, starts, steps=4, terminated=lambda s: s[:, 0] > 3.2
    )
    # The second start ends at once, the third too, the first with its fourth step.
    assert rows["observation"].flatten().tolist() == [0, 2.5, 9, 1, 2, 3]
    ended = rows["next", "terminated"].flatten().tolist()
    assert ended == [False, True, True, False, False, True]
    assert torch.equal(rows["next", "done"], rows["next", "terminated"])
    assert not rows["next", "truncated"].any()


def test_rows_on_which_the_elites_disagree_are_refused_and_counted() -> None:
    starts, world = torch.zeros(5, 1), linear_world(spread=0.5)
    rows, refused = imagine(world, one, starts, steps=3, max_disagreement=0.4)
    assert (len(rows), refused) == (0, 5)
    rows, refused = imagine(world, one, starts, steps=3, max_disagreement=0.6)
    assert (len(rows), refused) == (15, 0)
    torch.testing.assert_close(rows["disagreement"], torch.full([15, 1], 0.5))


def test_the_task_may_end_where_the_elites_disagree() -> None:
    starts, world = torch.tensor([[2.0], [math.inf]]), linear_world(spread=0.5)
    options = {"steps": 3, "max_disagreement": 0.4, "halt_reward": -7.0}
    rows, refused = imagine(world, one, starts, **options)
    assert (len(rows), refused) == (1, 1)
    assert rows["next", "observation"].item() == 2
    assert rows["next", "reward"].item() == -7
    assert torch.equal(rows["next", "terminated"], torch.tensor([[True]]))
    assert torch.equal(rows["next", "done"], torch.tensor([[True]]))
    assert rows["disagreement"].item() == pytest.approx(0.5)
    options["max_disagreement"] = 0.6
    rows, _ = imagine(world, one, starts, **options)
    assert not rows["next", "terminated"].any()
    with pytest.raises(ValueError, match="no state is left"):
        disturbed(world, starts, **(options | {"max_disagreement": 0.4}))


def test_rows_that_are_not_finite_are_refused() -> None:
    starts = torch.tensor([[0.0], [math.inf]])
    rows, refused = imagine(linear_world(), one, starts, steps=2)
    assert (len(rows), refused) == (2, 1)


def test_each_row_is_of_an_elite_and_drawn_from_its_gaussian() -> None:
    world = linear_world(spread=3.0, log_variance=math.log(0.25))
    rows, _ = imagine(world, one, torch.zeros(20_000, 1), steps=1)
    change = rows["next", "observation"].flatten() - 1
    upper = change > 0
    # Gaussians of deviation .5 around 3 and -3: the third network is never taken.
    assert upper.float().mean().item() == pytest.approx(0.5, abs=0.02)
    for side, mean in ((upper, 3.0), (~upper, -3.0)):
        assert change[side].mean().item() == pytest.approx(mean, abs=0.02)
        assert change[side].std().item() == pytest.approx(0.5, abs=0.02)


def test_uncertainty_is_of_all_networks_and_in_the_given_units() -> None:
    world = linear_world(log_variance=math.log(4.0))
    units = torch.tensor([10.0, 0.5])
    rows, _ = imagine(world, one, torch.zeros(3, 1), steps=1, units=units)
    wanted = math.hypot(2 * 10.0, 2 * 0.5)  # deviations of 2 in both entries
    torch.testing.assert_close(rows["uncertainty"], torch.full([3, 1], wanted))


def test_the_seed_decides() -> None:
    world = linear_world(log_variance=0.0)
    found = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        found.append(imagine(world, one, torch.zeros(4, 1), steps=3).rows)
    assert (found[0] == found[1]).all()
    assert not (found[0] == found[2]).all()


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="steps must be at least 1"):
        imagine(linear_world(), one, torch.zeros(4, 1), steps=0)
    with pytest.raises(ValueError, match="no state to start from"):
        imagine(linear_world(), one, torch.zeros(0, 1), steps=1)


def test_disturbed_states_are_where_random_actions_lead() -> None:
    torch.manual_seed(0)
    states = disturbed(linear_world(), torch.zeros(60_000, 1), steps=3)
    assert states.shape == (60_000, 1)
    assert states.abs().max() <= 3
    # One, two or three draws from [-1, 1], whose variance is 1 / 3.
    assert states.mean().item() == pytest.approx(0, abs=0.02)
    assert states.var().item() == pytest.approx(2 / 3, rel=0.03)


def test_no_disturbed_state_is_one_in_which_the_task_has_ended() -> None:
    world, starts = linear_world(), torch.zeros(100, 1)
    states = disturbed(world, starts, steps=5, terminated=lambda s: s[:, 0] < 0)
    assert (states >= 0).all()
    with pytest.raises(ValueError, match="no state is left"):
        disturbed(world, starts, steps=5, terminated=lambda s: s[:, 0] < 2)
