"""What the machine lacks is named before any work; half precision stays inside."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.data import check_memory
from torchrl_osr.trainers import hardware
from torchrl_osr.trainers.finite_guard import FiniteGuard
from torchrl_osr.trainers.gradient_steps import SumOfLosses


def test_the_default_is_float32_everywhere() -> None:
    assert hardware.check_hardware("cpu", "float32") == (torch.device("cpu"), None)


def test_bfloat16_is_what_it_says_where_the_cpu_has_it(monkeypatch) -> None:
    monkeypatch.setattr(
        torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: True, raising=False
    )
    assert hardware.check_hardware("cpu", "bfloat16")[1] is torch.bfloat16
    monkeypatch.setattr(
        torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: False, raising=False
    )
    with pytest.raises(ValueError, match="CPU has no bfloat16 products"):
        hardware.check_hardware("cpu", "bfloat16")


@pytest.mark.parametrize(
    ("device", "precision", "message"),
    [
        ("cpu", "float16", "'float32' or 'bfloat16', got 'float16'"),
        ("cuda", "float32", "sees no CUDA device"),
        ("cuda:1", "bfloat16", "sees no CUDA device"),
    ],
)
def test_what_is_not_there_is_named(monkeypatch, device, precision, message) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match=message):
        hardware.check_hardware(device, precision)


def test_a_gpu_without_bfloat16_is_named(monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda: False)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "an old GPU")
    with pytest.raises(ValueError, match="an old GPU does not compute in bfloat16"):
        hardware.check_hardware("cuda", "bfloat16")


def test_a_cuda_graph_needs_cuda() -> None:
    match = "cudagraph=True needs a CUDA device, got device='cpu': use device=cuda"
    with pytest.raises(ValueError, match=match):
        hardware.check_hardware("cpu", "float32", cudagraph=True)


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


@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
def test_only_the_losses_are_computed_in_half_precision(dtype) -> None:
    layer, seen = torch.nn.Linear(4, 3), []

    def compute_loss(batch):
        out = layer(batch)
        seen.append(out.dtype)
        return TensorDictLike({"loss_a": out.float().square().mean()})

    class TensorDictLike(dict):
        def detach(self):
            return self

    optimizer = torch.optim.SGD(layer.parameters(), lr=0.1)
    before = layer.weight.detach().clone()
    trainer = SimpleNamespace(
        loss_module=layer,
        optimizer=optimizer,
        compute_loss=compute_loss,
        cudagraph=False,
    )
    trainer.guard = FiniteGuard(trainer, "stop")
    SumOfLosses(dtype).step(trainer, torch.ones(5, 4))
    assert seen == [dtype or torch.float32]
    assert layer.weight.dtype == torch.float32
    assert not torch.equal(layer.weight, before)
