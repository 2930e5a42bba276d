"""The check of every data set: what is wrong is named."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.lab.data import check_dataset


def sound_data(rows: int = 6) -> TensorDict:
    flags = {
        name: torch.zeros(rows, 1, dtype=torch.bool)
        for name in ("done", "terminated", "truncated")
    }
    following = {"observation": torch.ones(rows, 3), "reward": torch.zeros(rows, 1)}
    return TensorDict(
        {
            "observation": torch.ones(rows, 3),
            "action": torch.ones(rows, 2),
            "next": TensorDict(following | flags, [rows]),
        },
        [rows],
    )


def test_sound_data_pass_the_guard():
    check_dataset(sound_data())


OBSERVATION, NEXT = "observation", ("next", "observation")


@pytest.mark.parametrize("key", [OBSERVATION, NEXT, "action"])
def test_all_zero_fields_are_named_with_the_usual_culprit(key):
    data = sound_data()
    data.get(key).zero_()
    with pytest.raises(ValueError, match=r"zero in all 6 rows.*Minari") as raised:
        check_dataset(data)
    assert repr(key) in str(raised.value)


@pytest.mark.parametrize("key", [OBSERVATION, NEXT, "action", ("next", "reward")])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_counted(key, value):
    data = sound_data()
    data.get(key)[1:3] = value
    with pytest.raises(ValueError, match=r"NaN or infinity in 2 of 6 rows") as raised:
        check_dataset(data)
    assert repr(key) in str(raised.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (NEXT, torch.ones(6, 4), r"\[6, 4\]; expected \[6, 3\]"),
        ("action", torch.ones(6), r"'action' has shape \[6\]; expected \[6, D\]"),
        (("next", "reward"), torch.ones(6), r"'reward'\) has shape \[6\]; .*\[6, 1\]"),
        (("next", "done"), torch.zeros(6, 1), r"'done'\) has type torch.float32"),
        (("next", "done"), torch.ones(6, 1) > 0, r"terminated \| truncated in 6 rows"),
    ],
)
def test_wrong_shapes_and_types_say_what_was_expected(key, value, message):
    data = sound_data()
    data.set(key, value)
    with pytest.raises(ValueError, match=message):
        check_dataset(data)


def test_missing_keys_are_named():
    data = sound_data()
    del data["next", "reward"]
    with pytest.raises(ValueError, match=r"lacks \('next', 'reward'\); it has"):
        check_dataset(data)


def test_unflat_data_are_refused():
    with pytest.raises(ValueError, match=r"batch size \[2, 3\]; expected a flat"):
        check_dataset(sound_data().reshape(2, 3))
