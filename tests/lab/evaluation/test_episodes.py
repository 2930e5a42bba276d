"""Batched episodes are the episodes that one environment would have played."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ObservationNorm

from torchrl_osr.lab.data import reference_returns
from torchrl_osr.lab.evaluation import (
    EpisodeEvaluator,
    deterministic_policy,
    measure_of,
    summarize,
)
from torchrl_osr.lab.evaluation.episodes import EpisodeResults
from torchrl_osr.modules import tanh_gaussian_actor


def linear_policy(observation: torch.Tensor) -> torch.Tensor:
    """A policy under which episodes end at different times; rows do not mix."""
    return torch.tanh(observation[:, :3] * 3)


def play_alone(seed: int) -> tuple[float, int]:
    environment = gymnasium.make("Hopper-v5")
    observation, _ = environment.reset(seed=seed)
    total, steps, over = 0.0, 0, False
    while not over:
        row = torch.from_numpy(observation[None].astype(np.float32))
        action = linear_policy(row)[0].numpy()
        observation, reward, terminated, truncated, _ = environment.step(action)
        total, steps, over = total + reward, steps + 1, terminated or truncated
    return total, steps


def test_each_episode_is_what_it_would_be_alone():
    evaluator = EpisodeEvaluator("Hopper-v5", num_episodes=4, seed=5)
    results = evaluator(linear_policy)
    returns, lengths = zip(*map(play_alone, (5, 6, 7, 8)), strict=True)
    np.testing.assert_allclose(results.returns, returns, rtol=1e-6)
    assert results.lengths.tolist() == list(lengths)
    assert len(set(results.lengths)) > 1, "episodes shall end at different times here"
    again = evaluator(linear_policy)
    np.testing.assert_array_equal(results.returns, again.returns)


@pytest.mark.parametrize("standard_normal", [True, False])
def test_a_policy_sees_what_the_transform_makes(standard_normal):
    norm = ObservationNorm(1.0, 4.0, ["observation"], standard_normal=standard_normal)
    actor, state = tanh_gaussian_actor(3, 2), torch.randn(4, 3)
    seen = norm(TensorDict({"observation": state}, [4]))["observation"]
    wanted = deterministic_policy(actor)(seen)
    assert torch.equal(deterministic_policy(actor, norm)(state), wanted)


def test_summary_has_scores_only_with_references():
    returns = np.array([3234.3, -20.272305])
    results = EpisodeResults(returns, np.array([1000, 20]), np.array([0, 1]))
    summary = summarize(results, reference_returns("hopper"))
    ends = [summary[f"score{end}"] for end in ("", "_low", "_high")]
    assert ends == pytest.approx([50, 0, 100])
    assert (summary["returns"], summary["length"]) == (returns.tolist(), 510)
    summary = summarize(results, None)
    assert measure_of(summary) == "return"
    assert (summary["return_low"], summary["return_high"]) == (returns[1], returns[0])
    assert not [key for key in summary if "score" in key]
