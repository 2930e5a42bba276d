"""Faster updates of small networks on a CPU, with the same numbers.

:mod:`~torchrl_osr.fast.critics` scores many sampled actions with plain MLP critics; the
losses call it as ``critics.qvalue``, ``critics.soft_maximum``, ``critics.plain_mlp``
and ``critics.applicable``.
"""

from torchrl_osr.fast.soft_update import SoftUpdate

__all__ = ["SoftUpdate"]
