"""Learning rates over a run, against numbers by hand."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_osr.trainers import learning_rates


def make(schedules, total_steps):
    groups = [{"params": [torch.zeros(1)], "lr": 0.4} for _ in schedules]
    optimizer = torch.optim.SGD(groups)
    return optimizer, learning_rates(optimizer, schedules, total_steps)


def rates(schedules, total_steps, steps):
    (optimizer, scheduler), seen = make(schedules, total_steps), []
    for _ in range(steps):
        seen.append([group["lr"] for group in optimizer.param_groups])
        optimizer.step()
        scheduler.step()
    return seen


def test_half_a_cosine_beside_a_constant():
    half = 0.2 * math.sqrt(2)
    by_hand = [0.4, 0.2 + half / 2, 0.2, 0.2 - half / 2, 0.0, 0.0]
    seen = rates(["cosine", "constant"], 4, 6)
    assert [first for first, _ in seen] == pytest.approx(by_hand, abs=1e-12)
    assert [second for _, second in seen] == [0.4] * 6


def test_it_goes_on_where_it_was():
    optimizer, scheduler = make(["cosine"], 8)
    for _ in range(3):
        optimizer.step()
        scheduler.step()
    again, continued = make(["cosine"], 8)
    again.load_state_dict(optimizer.state_dict())
    continued.load_state_dict(scheduler.state_dict())
    again.step()
    continued.step()
    assert again.param_groups[0]["lr"] == pytest.approx(0.2)


def test_another_schedule_is_refused():
    with pytest.raises(ValueError, match="schedule must be one of .*got 'linear'"):
        rates(["linear"], 4, 1)
