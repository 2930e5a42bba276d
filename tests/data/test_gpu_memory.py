"""Data that do not fit in a GPU's memory are refused before they are copied."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.data import check_memory


@pytest.mark.parametrize("where", ["cpu", "cuda"])
def test_data_that_do_not_fit_on_a_gpu_are_refused_with_both_sizes(
    monkeypatch, where
) -> None:
    rows = torch.zeros(100, 10)  # 4000 bytes
    data = SimpleNamespace(
        bytes=TensorDict({"observation": rows}, [100]).bytes,
        device=torch.device(where),
        shape=torch.Size([100]),
    )
    copies = 1 if where == "cuda" else 2
    cached = 300 - 100
    for name, number in (("memory_reserved", 300), ("memory_allocated", 100)):
        monkeypatch.setattr(torch.cuda, name, lambda _, number=number: number)
    device, free = torch.device("cuda"), 4000 * copies - cached
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (free, 10**9))
    check_memory(data, device)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (free - 1, 10**9))
    match = f"needs {4000 * copies:,} bytes on cuda, which has {4000 * copies - 1:,}"
    with pytest.raises(MemoryError, match=match):
        check_memory(data, device)
    check_memory(data, torch.device("cpu"))
