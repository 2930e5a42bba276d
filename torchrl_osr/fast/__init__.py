"""Faster updates of small networks, with the same numbers up to rounding.

:class:`FastUpdate` is the door, for your own training loop and for the trainer. It
calls :func:`fuse_critics`, which lets a loss score its sampled actions with fewer,
larger products.
"""

from torchrl_osr.fast.critics import fuse_critics
from torchrl_osr.fast.update import FastUpdate, NonfiniteError

__all__ = ["FastUpdate", "NonfiniteError", "fuse_critics"]
