"""The paper's own scores under disturbances, beside which one's own are shown."""

from __future__ import annotations

import pandas as pd

SOURCE = (
    "Table 2 of Recovering from Out-of-sample States via Inverse Dynamics in Offline "
    "Reinforcement Learning (NeurIPS 2023)"
)
"""Where the numbers are printed: D4RL medium-expert, 4 seeds, no intervals."""

DISTURBANCES = ("OOS-s, 5 steps", "OOS-m, 10 steps", "OOS-l, 20 steps")
"""Of random actions, Gaussian with standard deviation 0.001."""

MISPRINT = (
    "Walker2d-OOS-s of CQL is printed with a decrease of 47.3 %, as for OOS-l; the "
    "clean score of 98.7 that its other two rows imply would make it 17.8 %."
)
"""What does not fit in the table as printed."""

_PRINTED = {
    ("halfcheetah", "CQL"): (56.2, 10.0, 52.9, 15.3, 42.1, 32.5),
    ("halfcheetah", "SDC"): (100.9, 0.4, 99.8, 1.5, 83.3, 17.8),
    ("halfcheetah", "OSR"): (94.1, 0.6, 92.7, 2.1, 91.7, 3.2),
    ("halfcheetah", "OSR-v"): (98.4, 0.7, 98.4, 0.7, 79.8, 19.5),
    ("walker2d", "CQL"): (81.1, 47.3, 77.4, 21.6, 52.0, 47.3),
    ("walker2d", "SDC"): (102.7, 2.5, 102.2, 2.9, 95.6, 9.2),
    ("walker2d", "OSR"): (113.3, 0.9, 113.2, 1.0, 110.1, 3.7),
    ("walker2d", "OSR-v"): (110.3, 2.3, 110.9, 1.8, 106.7, 5.5),
    ("hopper", "CQL"): (110.4, 0.6, 97.3, 12.3, 54.4, 51.0),
    ("hopper", "SDC"): (112.0, 0.6, 110.8, 1.9, 89.2, 20.9),
    ("hopper", "OSR"): (111.4, 1.5, 109.2, 3.4, 106.1, 6.2),
    ("hopper", "OSR-v"): (112.5, 0.6, 112.2, 0.9, 105.6, 6.7),
}

TABLE = pd.DataFrame.from_dict(
    _PRINTED,
    orient="index",
    columns=pd.MultiIndex.from_product([DISTURBANCES, ("score", "decrease")]),
)
"""Score and decrease in percent of the clean score, by environment and method."""
TABLE.index = pd.MultiIndex.from_tuples(TABLE.index, names=["env", "method"])
