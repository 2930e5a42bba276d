"""Clear ImportErrors for optional dependencies."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needed_by(what: str, extra: str) -> Iterator[None]:
    """Add to an ImportError who needs the package, with a verb, and which extra has it.

    ``with needed_by("CSV files need", "train"): import pandas``
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"{what} {error.name!r}: pip install torchrl-osr[{extra}]"
        ) from error
