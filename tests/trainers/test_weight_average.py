"""An exponential average of a network's weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_osr.trainers import WeightAverage


@given(share=st.floats(1e-3, 1), values=st.lists(st.floats(-9, 9), max_size=40))
def test_shares_of_all_weights_so_far(share, values) -> None:
    network = torch.nn.Linear(1, 1, bias=False).double()
    average = WeightAverage(network, share)
    for step, value in enumerate(values, 1):
        torch.nn.init.constant_(network.weight, value)
        average.update(step)
    shares = np.maximum(share, 10 / (np.arange(len(values)) + 10))
    kept = np.append(np.cumprod((1 - shares)[::-1])[::-1][1:], 1)
    expected = kept * shares @ values if values else network.weight.item()
    assert average.network.weight.item() == pytest.approx(expected, abs=1e-12)
