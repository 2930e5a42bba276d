"""How many examples property tests try: as many as the environment says, or a few."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings


def tried(examples: int) -> settings:
    """The same examples everywhere; ``TORCHRL_OSR_PROPERTY_EXAMPLES`` for more."""
    return settings(
        max_examples=int(os.environ.get("TORCHRL_OSR_PROPERTY_EXAMPLES", examples)),
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
