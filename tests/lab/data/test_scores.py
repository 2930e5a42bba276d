from __future__ import annotations

import numpy as np
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


@pytest.mark.parametrize("env_name", REFERENCE_RETURNS)
def test_arrays_keep_their_shape(env_name: str) -> None:
    returns = np.array([list(REFERENCE_RETURNS[env_name])], dtype=np.float32)
    scores = normalized_score(env_name, returns)
    assert scores.dtype == np.float64
    np.testing.assert_allclose(scores, [[0.0, 100.0]], atol=1e-4)


def test_references_of_ones_own() -> None:
    assert reference_returns("pendulum") is None, "raw returns"
    assert reference_returns("hopper") == REFERENCE_RETURNS["hopper"]
    own = reference_returns("pendulum", -1200.0, -200.0)
    assert own is not None
    assert [own.score(each) for each in (-1200.0, -200.0, -450.0)] == [0, 100, 75]


@pytest.mark.parametrize(
    ("name", "low", "high", "message"),
    [
        ("pendulum", -1200.0, None, "env.expert_return=None: expected two"),
        ("pendulum", None, 0.0, "env.random_return=None"),
        ("pendulum", 5.0, 5.0, "the expert's above the random policy's"),
        ("pendulum", 0.0, -1200.0, "the expert's above the random policy's"),
        ("pendulum", 0.0, float("nan"), "two finite numbers"),
        ("hopper", 0.0, 1.0, "hopper is scored by D4RL's references"),
    ],
)
def test_references_that_make_no_scale_are_refused(name, low, high, message) -> None:
    with pytest.raises(ValueError, match=message):
        reference_returns(name, low, high)
