"""What a run asks of the machine, checked before any long work."""

from __future__ import annotations

import torch

from torchrl_osr._checks import check_choice


def check_cudagraph(device: torch.device, policy_delay: int = 1) -> None:
    """Raise a ValueError unless updates on ``device`` can be CUDA graphs."""
    if policy_delay > 1:
        raise ValueError(
            "cudagraph=True repeats one update, and with "
            f"policy_delay={policy_delay} there are two kinds: use policy_delay=1 "
            "(optim.policy_delay=1), or cudagraph=False (trainer.cudagraph=false)."
        )
    if device.type != "cuda":
        raise ValueError(
            f"cudagraph=True needs a CUDA device, got device='{device}': use "
            "device=cuda (trainer.device=cuda), or cudagraph=False "
            "(trainer.cudagraph=false)."
        )


def check_hardware(
    device: str, precision: str, *, cudagraph: bool = False, policy_delay: int = 1
) -> tuple[torch.device, torch.dtype | None]:
    """Device and autocast type of a run, if this machine has them.

    Args:
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:1"``.
        precision: ``"float32"``, or ``"bfloat16"`` for autocast: matrix products in
            half precision; parameters, targets, densities, log-sum-exps and the
            optimizer stay in float32.

    Keyword Args:
        cudagraph: whether updates shall be CUDA graphs. Default ``False``.
        policy_delay: of the :class:`~torchrl_osr.trainers.OfflineTrainer`. Default 1.

    Raises:
        ValueError: if there is no such device or precision, or the device does not
            compute in it or has no CUDA graphs.
    """
    check_choice("precision", precision, ("float32", "bfloat16"))
    where = torch.device(device)
    if cudagraph:
        check_cudagraph(where, policy_delay)
    if where.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            f"device={device!r}, but torch {torch.__version__} sees no CUDA device "
            "here. Use device=cpu (trainer.device=cpu), or install a CUDA build of "
            "torch."
        )
    if precision == "float32":
        return where, None
    if where.type == "cuda" and not torch.cuda.is_bf16_supported():
        raise ValueError(
            f"{torch.cuda.get_device_name(where)} does not compute in bfloat16: use "
            "precision=float32 (trainer.precision=float32)."
        )
    if where.type == "cpu" and not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        raise ValueError(
            "This CPU has no bfloat16 products (it would need AVX-512): use "
            "precision=float32 (trainer.precision=float32)."
        )
    return where, torch.bfloat16
