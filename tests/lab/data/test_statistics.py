"""Means and deviations, however the rows are cut; normalised scores."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.lab.data import observation_statistics, reference_returns, statistics
from torchrl_osr.lab.data.statistics import REFERENCE_RETURNS


def test_statistics_by_hand(monkeypatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(statistics.torchrl_logger, "warning", said.append)
    rows = torch.tensor([[1.0, 7.0, 0.0], [3.0, 7.0, 1e-5]])
    loc, scale = observation_statistics(TensorDict({"observation": rows}, [2]))
    torch.testing.assert_close(loc, torch.tensor([2.0, 7.0, 5e-6]))
    torch.testing.assert_close(scale, torch.tensor([1.0, 1e-3, 1e-3]))
    (message,) = said
    assert message.endswith("are divided: [1, 2].")


@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_statistics_are_those_of_float64(offset):
    rows = torch.randn(60, 3) + offset
    scale, loc = torch.std_mean(rows.double(), dim=0, correction=0)
    found = observation_statistics(TensorDict({"observation": rows}, [60]))
    torch.testing.assert_close(found, (loc.float(), scale.float()), rtol=1e-7, atol=0)


def test_scores_by_hand_and_references_of_ones_own() -> None:
    for env_name, mean, score in [
        ("halfcheetah", 12135.0, 100.0),
        ("halfcheetah", -280.178953, 0.0),
        ("hopper", 3234.3, 100.0),
        ("walker2d", 2296.964504, 50.0),  # 1.629008 + (4592.3 - 1.629008) / 2
        ("antmaze-umaze", 0.75, 75.0),  # the success rate
    ]:
        assert REFERENCE_RETURNS[env_name].score(mean) == pytest.approx(score)
    assert reference_returns("pendulum") is None, "raw returns"
    assert reference_returns("hopper") == REFERENCE_RETURNS["hopper"]
    own = reference_returns("pendulum", -1200.0, -200.0)
    assert own is not None
    assert [own.score(each) for each in (-1200.0, -200.0, -450.0)] == [0, 100, 75]
    with pytest.raises(ValueError, match="two finite numbers"):
        reference_returns("pendulum", 5.0, 5.0)
    with pytest.raises(ValueError, match="none for a task with D4RL"):
        reference_returns("hopper", 0.0, 1.0)
