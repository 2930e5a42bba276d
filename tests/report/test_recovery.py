"""The way back after a disturbance, against numbers made by hand."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_osr.report.recovery import recovery, transient_levels

fakes = SimpleNamespace(**runpy.run_path(str(Path(__file__).with_name("fakes.py"))))
write, level, suite, read = (
    fakes.write_hand,
    fakes.hand_level,
    fakes.hand_suite,
    fakes.read_all,
)


def transient(**entries):
    """Return a level of four episodes, of which the last ended before it."""
    base = {
        "disturbed_at": [7, 7, 7, None],
        "survived_knock": [True, True, False, None],
        "alive_after": [True, None, False, None],
        "recovery_steps": [0, 2, None, None],
        "distance": {
            "offset": [-1, 0, 1, 2], "mean": [0.5, 2.0, 1.5, None],
            "count": [3, 3, 1, 0],
        },
    }  # fmt: skip
    return level("knock", [30.0, 40.0, 5.0, 9.0], kind="knock", **(base | entries))


def test_recovery_counts_those_that_the_disturbance_came_to(tmp_path):
    content = suite((5, [1, 2, 3, 4], [50.0, 50.0, 50.0, 9.0],
                     [level("mass", [1.0] * 4), transient()]))  # fmt: skip
    write(tmp_path / "a", {5: [1.0]}, suite=content)
    runs = read(tmp_path)
    assert transient_levels(runs, "hand") == [1]
    found = recovery(runs, "hand", 1)
    assert (found.episodes, found.reached) == (4, 0.75)
    assert found.survived == pytest.approx(2 / 3)
    assert found.alive_after == 0.5  # the second ran out of time: not known
    assert found.undisturbed_alive is None
    assert found.median == 2
    assert found.decrease.mean == pytest.approx(50)
    # Of three, one is back at once, one after two steps, and one never.
    np.testing.assert_array_equal(found.recovered.x, [0, 1, 2])
    np.testing.assert_allclose(found.recovered.mean, [1 / 3, 1 / 3, 2 / 3])
    np.testing.assert_array_equal(found.distance.mean, [0.5, 2, 1.5, np.nan])
    assert found.distance.over == ""


def test_distances_are_weighted_by_episodes_then_by_seeds(tmp_path):
    def curve(mean, count, **clean):
        return {"distance": {"offset": [0, 1], "mean": mean, "count": count} | clean}

    clean = {"clean_mean": [0.5, 0.25], "clean_count": [4, 4]}
    for seed, parts in enumerate([
        (curve([1.0, 2.0], [3, 1], **clean), curve([5.0, 4.0], [1, 1], **clean)),
        (curve([4.0, None], [2, 0], **clean), curve([4.0, None], [2, 0], **clean)),
    ]):  # fmt: skip
        rows = [
            (step, [1, 2, 3, 4], [9.0] * 4, [transient(**part)])
            for step, part in zip((8, 9), parts, strict=True)
        ]
        write(tmp_path / str(seed), {9: [1.0]}, suite=suite(*rows), seed=seed)
    found = recovery(read(tmp_path), "hand", 0)
    # First seed: (3 * 1 + 1 * 5) / 4 = 2, then (2 + 4) / 2 = 3, the other has none.
    np.testing.assert_allclose(found.distance.mean, [(2 + 4) / 2, 3])
    np.testing.assert_allclose(found.distance.low, [2, 3])
    np.testing.assert_allclose(found.distance.high, [4, 3])
    np.testing.assert_allclose(found.undisturbed_distance.mean, [0.5, 0.25])


def test_nobody_disturbed_and_nobody_recovered_are_no_numbers(tmp_path):
    none = {"disturbed_at": [None] * 4}
    never = {
        "recovery_steps": [None] * 4,
        "clean_alive_after": [True, False, None, None],
    }
    content = suite((5, [1, 2, 3, 4], [9.0] * 4, [
        transient(**none) | {"name": "late"}, transient(**never)]))  # fmt: skip
    write(tmp_path / "a", {5: [1.0]}, suite=content)
    runs = read(tmp_path)
    assert recovery(runs, "hand", 0) is None
    found = recovery(runs, "hand", 1)
    assert found.median is None
    assert found.undisturbed_alive == 0.5
    assert not found.recovered.mean.any()
