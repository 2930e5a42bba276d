"""What the paper itself reports under disturbances, to stand beside one's own."""

from __future__ import annotations

from typing import NamedTuple

SOURCE = (
    "Table 2 of Recovering from Out-of-sample States via Inverse Dynamics in Offline "
    "Reinforcement Learning (NeurIPS 2023)"
)
"""Where the numbers are printed: D4RL medium-expert, 4 seeds, no intervals."""

LEVELS = ("OOS-s, 5 steps", "OOS-m, 10 steps", "OOS-l, 20 steps")
"""Of random actions, Gaussian with standard deviation 0.001."""

MISPRINTS = (
    "Walker2d-OOS-s of CQL is printed with a decrease of 47.3 %, as for OOS-l; the "
    "clean score of 98.7 that its other two rows imply would make it 17.8 %."
)
"""What does not fit in the table as printed."""


class Printed(NamedTuple):
    """A cell of the table.

    Attributes:
        score: normalised.
        decrease: of the clean score, in percent.
    """

    score: float
    decrease: float


def _rows(*numbers: float) -> tuple[Printed, ...]:
    """Return scores and decreases in pairs."""
    pairs = zip(numbers[::2], numbers[1::2], strict=True)
    return tuple(Printed(*pair) for pair in pairs)


TABLE = {
    "halfcheetah": {
        "CQL": _rows(56.2, 10.0, 52.9, 15.3, 42.1, 32.5),
        "SDC": _rows(100.9, 0.4, 99.8, 1.5, 83.3, 17.8),
        "OSR": _rows(94.1, 0.6, 92.7, 2.1, 91.7, 3.2),
        "OSR-v": _rows(98.4, 0.7, 98.4, 0.7, 79.8, 19.5),
    },
    "walker2d": {
        "CQL": _rows(81.1, 47.3, 77.4, 21.6, 52.0, 47.3),
        "SDC": _rows(102.7, 2.5, 102.2, 2.9, 95.6, 9.2),
        "OSR": _rows(113.3, 0.9, 113.2, 1.0, 110.1, 3.7),
        "OSR-v": _rows(110.3, 2.3, 110.9, 1.8, 106.7, 5.5),
    },
    "hopper": {
        "CQL": _rows(110.4, 0.6, 97.3, 12.3, 54.4, 51.0),
        "SDC": _rows(112.0, 0.6, 110.8, 1.9, 89.2, 20.9),
        "OSR": _rows(111.4, 1.5, 109.2, 3.4, 106.1, 6.2),
        "OSR-v": _rows(112.5, 0.6, 112.2, 0.9, 105.6, 6.7),
    },
}
"""Cells by environment and method, in the order of :data:`LEVELS`."""
