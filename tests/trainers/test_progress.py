"""Progress lines: what a log says where there is no terminal."""

from __future__ import annotations

import logging
import re

import pytest

from torchrl_osr.trainers import progress

LINE = re.compile(r"train: step (\d+) of 12(, [\d.e+]+ steps/s, [\d:]+ left)?(, .+)?")


@pytest.fixture
def lines(tmp_path, runs, caplog):
    """Function that trains off a terminal and returns the groups of its lines."""

    def lines(**options):
        caplog.set_level(logging.INFO, logger="torchrl_osr")
        runs.make(tmp_path, progress=True, **options).train()
        said = [each.message for each in caplog.records if "step" in each.message]
        return [LINE.fullmatch(each).groups() for each in said]

    return lines


def test_evaluations_are_logged_with_rate_and_time_left(lines):
    first, *rest = lines(evaluate=lambda: {"score": 31.25})
    assert first == ("0", None, ", score 31.25")
    assert [step for step, *_ in rest] == ["6", "12"]
    assert all(pace and result == ", score 31.25" for _, pace, result in rest)


@pytest.mark.parametrize(("seconds", "steps"), [(30, []), (0, ["4", "6", "8", "12"])])
def test_a_line_at_each_log_interval_but_not_too_often(
    lines, monkeypatch, seconds, steps
):
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", seconds)
    assert [step for step, *_ in lines()] == steps
