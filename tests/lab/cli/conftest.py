"""Each file has a cache of its own."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def _cache(own_cache) -> None: ...
