"""Roll-outs against the direction of time, in worlds that can be computed by hand."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_osr.lab.dynamics import DynamicsEnsemble, imagine_backwards, turned


def reverse_world() -> DynamicsEnsemble:
    """Where the state came from, if it grows by the action; the reward is that state.

    The model's inputs are the next state and the action.
    """
    model = DynamicsEnsemble(1, 1, num_networks=1, num_elites=1, num_cells=[])
    (layer,) = model.layers
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.zero_()
        layer.weight[:, 1, 0] = -1  # action to change
        layer.weight[:, 0, 1] = 1  # next state to reward
        model.lowest_log_variance.fill_(-60)
        model.highest_log_variance.fill_(60)
        layer.bias[:, 0, 2:] = -40  # log-variance
    return model


def one(state: torch.Tensor) -> torch.Tensor:
    return torch.ones_like(state)


def test_rows_lead_into_the_given_states() -> None:
    ends = torch.tensor([[0.0], [10.0]])
    rows, refused = imagine_backwards(reverse_world(), one, ends, steps=3)
    assert refused == 0
    after = rows["next", "observation"].flatten()
    torch.testing.assert_close(after, torch.tensor([0.0, 10, -1, 9, -2, 8]))
    # What the forward world says of these rows.
    action = rows["action"].flatten()
    torch.testing.assert_close(rows["observation"].flatten() + action, after)
    torch.testing.assert_close(rows["next", "reward"].flatten(), after)


def test_nobody_acts_where_the_task_has_ended() -> None:
    rows, refused = imagine_backwards(
        reverse_world(), one, torch.tensor([[0.0], [3.0]]), steps=4,
        terminated=lambda state: state[:, 0] < -1.5,
    )  # fmt: skip
    assert rows["observation"].flatten().tolist() == [-1, 2, 1, 0, -1]
    assert refused == 1
    for key in ("done", "terminated"):
        assert not rows["next", key].any()


def test_turned_rows_have_their_states_exchanged_and_nothing_else(transitions) -> None:
    rows = transitions(6)
    before = rows.clone()
    around = turned(rows)
    assert torch.equal(around["observation"], rows["next", "observation"])
    assert torch.equal(around["next", "observation"], rows["observation"])
    for key in ("action", ("next", "reward"), ("next", "terminated")):
        assert torch.equal(around[key], rows[key])
    back: TensorDict = turned(around)
    for each in (rows, back):
        assert (each == before).all()
