"""Progress lines: what a log says where there is no terminal."""

from __future__ import annotations

import logging
import re

import pytest

from torchrl_osr.trainers import progress

LINE = re.compile(r"train: (\d+)/20 \[[\d:]+<[\d:?]+, +[\d.?]+(?:step/s|s/step)(.*)\]")


@pytest.mark.parametrize(("seconds", "more"), [(30, 0), (0, 9)])
def test_evaluations_and_at_times_steps_are_logged(
    tmp_path, make, caplog, monkeypatch, seconds, more
):
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", seconds)
    caplog.set_level(logging.INFO, logger="torchrl_osr")
    make(tmp_path, progress=True).train()
    lines = [each.message for each in caplog.records if each.name == progress.__name__]
    said = [LINE.fullmatch(each).groups() for each in lines]
    results = [pair for pair in said if pair[1]]
    assert len(results) == 5 + more
    assert len(said) == len(results) + 1
    assert {int(step) for step, _ in results} >= {0, 5, 10, 15, 20}
    assert results[-1] == ("20", ", score 4")
