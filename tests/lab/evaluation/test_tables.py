"""The text table of a training run."""

from __future__ import annotations

import pytest

from torchrl_osr.lab.evaluation.tables import run_summary


@pytest.mark.parametrize(
    ("scores", "recent", "mean"),
    [([0, 90, 10, 20, 30, 40], 5, 38.0), ([100, 90, 40], 2, 65.0)],
)
def test_scores_are_last_recent_and_best(tmp_path, scores, recent, mean):
    """The mean is without the untrained policy."""
    history = [
        {"step": 10 * i, "score": s, "score_low": s - 1, "score_high": s + 1}
        for i, s in enumerate(scores)
    ]
    table = run_summary("hopper", history, history[1], 15.6, tmp_path)
    lines = [" ".join(line.split()) for line in table.splitlines()]
    assert lines[1:5] == [
        "data, mean episode 15.6",
        "policy, last 40.0 [39.0, 41.0]",
        f"policy, mean of last {recent} {mean}",
        "policy, best evaluation 90.0 [89.0, 91.0] at step 10",
    ]
