"""What the machine lacks is named before any work."""

from __future__ import annotations

import pytest
import torch

from torchrl_osr.trainers import check_hardware


def test_the_default_is_float32_everywhere() -> None:
    assert check_hardware("cpu", "float32") == (torch.device("cpu"), None)


def test_bfloat16_is_what_it_says_where_the_cpu_has_it(monkeypatch) -> None:
    monkeypatch.setattr(
        torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: True, raising=False
    )
    assert check_hardware("cpu", "bfloat16")[1] is torch.bfloat16
    monkeypatch.setattr(
        torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: False, raising=False
    )
    with pytest.raises(ValueError, match="CPU has no bfloat16 products"):
        check_hardware("cpu", "bfloat16")


@pytest.mark.parametrize(
    ("device", "precision", "message"),
    [
        ("cpu", "float16", "precision must be one of .* got 'float16'"),
        ("cuda", "float32", "sees no CUDA device"),
        ("cuda:1", "bfloat16", "sees no CUDA device"),
    ],
)
def test_what_is_not_there_is_named(monkeypatch, device, precision, message) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match=message):
        check_hardware(device, precision)


def test_a_gpu_without_bfloat16_is_named(monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda: False)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "an old GPU")
    with pytest.raises(ValueError, match="an old GPU does not compute in bfloat16"):
        check_hardware("cuda", "bfloat16")


def test_a_cuda_graph_needs_cuda() -> None:
    match = "cudagraph=True needs a CUDA device, got device='cpu': use device=cuda"
    with pytest.raises(ValueError, match=match):
        check_hardware("cpu", "float32", cudagraph=True)
