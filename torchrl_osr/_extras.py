"""What an optional package is for, said where its import fails."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needed_by(what: str, extra: str) -> Iterator[None]:
    """Add to a failed import who needs the package and how to install it.

    Args:
        what: with its verb, as in ``"CSV files need"``.
        extra: of this package, which brings it.

    Raises:
        ImportError: naming the missing package and the extra.
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"{what} {error.name!r}: pip install torchrl-osr[{extra}]"
        ) from error
