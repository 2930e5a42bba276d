"""Each file has a cache of its own."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module", autouse=True)
def _cache(own_cache) -> None: ...
