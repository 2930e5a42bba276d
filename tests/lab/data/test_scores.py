from __future__ import annotations

import pytest

from torchrl_osr.lab.data import reference_returns
from torchrl_osr.lab.data.scores import REFERENCE_RETURNS


def normalized_score(env_name, returns):
    return REFERENCE_RETURNS[env_name].score(returns)


def test_hand_computed_scores() -> None:
    assert normalized_score("halfcheetah", 12135.0) == 100.0
    assert normalized_score("halfcheetah", -280.178953) == 0.0
    assert normalized_score("hopper", 3234.3) == 100.0
    # 1.629008 + (4592.3 - 1.629008) / 2
    assert normalized_score("walker2d", 2296.964504) == pytest.approx(50.0)
    # The mean of returns of 0 and 1 is the success rate.
    assert normalized_score("antmaze-umaze", 0.75) == 75.0


def test_references_of_ones_own() -> None:
    assert reference_returns("pendulum") is None, "raw returns"
    assert reference_returns("hopper") == REFERENCE_RETURNS["hopper"]
    own = reference_returns("pendulum", -1200.0, -200.0)
    assert own is not None
    assert [own.score(each) for each in (-1200.0, -200.0, -450.0)] == [0, 100, 75]
    with pytest.raises(ValueError, match="two finite numbers"):
        reference_returns("pendulum", 5.0, 5.0)
    with pytest.raises(ValueError, match="none for a task with D4RL"):
        reference_returns("hopper", 0.0, 1.0)
