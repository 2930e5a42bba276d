"""Scores by brute force, thresholds by counting, and monitors in every kind of file."""

from __future__ import annotations

import numpy as np
import onnxruntime
import pytest
import torch

from torchrl_osr import load_policy
from torchrl_osr.policy import fit_monitor
from torchrl_osr.policy.monitor import conformal_threshold

ROWS = 2000


@pytest.fixture(scope="module")
def log() -> tuple[np.ndarray, np.ndarray]:
    """200 episodes of 10 rows, in units of their own; the last column is constant."""
    rows = np.random.default_rng(0).normal([5, -300, 2], [0.1, 40, 0], (ROWS, 3))
    return rows.astype(np.float32), np.arange(ROWS) // 10


def monitor_of(log, **options):
    return fit_monitor(*map(torch.from_numpy, log), **options)


def test_score_is_the_distance_to_the_nearest_kept_row(log):
    rows, episode = log
    drift = rows + np.float32([0.01, 0, 0]) * episode[:, None]
    assert monitor_of((drift, episode), num_states=300).threshold < 1
    monitor = monitor_of(log, num_states=300)
    kept = monitor.states.numpy() * monitor.scale.numpy() + monitor.loc.numpy()
    apart = np.abs(kept[:, None] - rows).max(-1)
    assert apart.min(1).max() < 1e-4, "the kept states are rows of the data"
    asked = rows[:50] + np.float32([0.1, 60, 0.002])
    unit = monitor.scale.numpy()
    assert unit == pytest.approx([0.1, 40, 1e-3], rel=0.1)
    distance = np.linalg.norm((asked[:, None] - kept) / unit, axis=-1).min(1)
    score, alarm = monitor(torch.from_numpy(asked))
    assert score.numpy() == pytest.approx(distance, rel=1e-4)
    assert np.array_equal(alarm, score > monitor.threshold)


def test_held_out_episodes_keep_the_promise(log):
    """Of 100 held-out episodes, the 96th largest score is the threshold."""
    rows, episode = log
    monitor = monitor_of(log, false_alarms=0.05)
    score = monitor(torch.from_numpy(rows))[0].numpy()
    largest = np.array([score[episode == each].max() for each in range(200)])
    # The reference knows its own rows: these have no distance.
    held_out = np.sort(largest[largest > np.median(largest)])
    assert monitor.threshold.item() in held_out
    assert monitor.record["episodes"] == 100
    assert (largest > monitor.threshold.item()).sum() in (4, 5)


@pytest.mark.parametrize(("number", "rate"), [(19, 0.05), (50, 0.1), (9, 0.1)])
def test_exact_coverage_of_exchangeable_episodes(number, rate):
    """The rank of a new score is uniform: the place of the threshold is exact."""
    draws = np.random.default_rng(0).random((20_000, number + 1))
    draws = draws[:2000] if number == 50 else draws[:5000]
    thresholds = [conformal_threshold(torch.from_numpy(d[1:]), rate) for d in draws]
    place = int(np.ceil((number + 1) * (1 - rate) - 1e-9))
    expected = 1 - place / (number + 1)
    assert expected <= rate + 1e-12
    found = (draws[:, 0] > thresholds).mean()
    assert found == pytest.approx(expected, abs=4 * (expected / len(draws)) ** 0.5)


def test_too_few_episodes_say_how_many_are_needed(log):
    for rate, needed in [(0.05, 19), (0.1, 9), (0.01, 99), (1 / 3, 2)]:
        with pytest.raises(ValueError, match=f"need {needed} episodes .* are 1.*0.5"):
            conformal_threshold(torch.ones(1), rate)
        conformal_threshold(torch.ones(needed), rate)
    with pytest.raises(ValueError, match="within 0 and 1"):
        conformal_threshold(torch.ones(5), 0.0)
    one = log[0], np.zeros(ROWS, int)
    with pytest.raises(ValueError, match="need 19 episodes .* are 1"):
        monitor_of(one)


def test_rows_before_a_fall_are_no_data(log):
    rows, episode = (torch.from_numpy(each) for each in log)
    falling = torch.arange(ROWS) % 10 >= 7
    rows = rows.clone()
    rows[falling, 0] += 3
    fallen = rows[falling][:5]
    assert not fit_monitor(rows, episode)(fallen)[1].any()
    assert fit_monitor(rows, episode, ~falling)(fallen)[1].all()
    with pytest.raises(ValueError, match="no row"):
        fit_monitor(rows, episode, torch.zeros_like(falling))
    with pytest.raises(ValueError, match="need 19 episodes"):
        fit_monitor(rows, episode, episode < 20)  # in the others no row counts
    for value in (torch.inf, torch.nan):
        rows[7] = value
        with pytest.raises(ValueError, match="have NaN"):
            fit_monitor(rows, episode)


def test_calibration_on_other_episodes(log):
    rows, episode = (torch.from_numpy(each) for each in log)
    monitor, other = fit_monitor(rows, episode), rows + torch.tensor([1.0, 0.0, 0.0])
    assert monitor(other)[1].float().mean() > 0.9
    monitor.calibrate(other, episode, false_alarms=0.2)
    alarms = monitor(other)[1].reshape(200, 10).any(1)
    assert alarms.sum() == 200 - np.ceil(201 * 0.8)


@pytest.mark.parametrize("kind", ["osr", "discrete"])
def test_each_file_has_the_monitor(tmp_path, make_policy, log, kind):
    policy, rows = make_policy(kind), log[0][:64].copy()
    with pytest.raises(ValueError, match="no monitor"):
        policy.monitor(rows)
    wanted = policy.act(rows)
    policy.attach(monitor_of(log))
    policy.save(tmp_path / "p.safetensors")
    again = load_policy(tmp_path / "p.safetensors")
    assert np.array_equal(again.act(rows), wanted)
    assert again.record["monitor"] is again.data_monitor.record, "it may be calibrated"
    rows[1, 0], rows[2, 1], rows[3, 2], rows[4] = np.nan, np.inf, -1e30, 1e30
    score, alarm = again.monitor(rows)
    assert score.dtype == np.float32
    assert alarm.dtype == bool
    assert score[1] == np.inf
    assert alarm[1:5].all()
    assert not alarm[5:].all()
    one = again.monitor(rows[5])
    assert one[0].shape == one[1].shape == ()
    assert one[0] == pytest.approx(score[5], rel=1e-4)
    again.export(tmp_path / "p.pt2")
    graph = torch.export.load(tmp_path / "p.pt2").module()
    found = [graph(observation=torch.from_numpy(rows))]
    if kind == "osr":  # seconds
        again.export(tmp_path / "p.onnx")
        session = onnxruntime.InferenceSession(tmp_path / "p.onnx")
        names = ["action", "score", "alarm"]
        found.append(session.run(names, {"observation": rows}))
    good = [0, *range(5, 64)]
    for action, other_score, other_alarm in found:
        assert np.asarray(action)[good] == pytest.approx(wanted[good], abs=1e-5)
        assert np.isfinite(np.asarray(action)).all()
        assert np.asarray(other_score) == pytest.approx(score, rel=1e-4, abs=1e-3)
        assert np.array_equal(other_alarm, alarm)
    if not policy.discrete:
        middle = (policy.low + policy.high) / 2
        assert np.array_equal(np.asarray(action)[1], middle)
        again.export(tmp_path / "v.pt2", "value")
