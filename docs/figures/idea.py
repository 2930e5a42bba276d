"""Draw ``idea.png``: a perturbed state, and the action that leads back.

python docs/figures/idea.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt

mpl.use("Agg")

INK, DATA, OFF, BACK = "#222222", "#9db8d9", "#d1495b", "#2e8b57"


def path(x: np.ndarray) -> np.ndarray:
    """The path that the behaviour policy walks."""
    return 0.55 * np.sin(1.15 * x) + 0.04 * x


def main() -> None:
    """Draw the figure beside this file."""
    rng = np.random.default_rng(3)
    x = rng.uniform(0.0, 6.4, 260)
    y = path(x) + 0.10 * rng.standard_normal(x.size)
    figure, axes = plt.subplots(figsize=(7, 3.1), layout="constrained")
    axes.scatter(x, y, s=14, color=DATA, linewidths=0)
    state, following = np.array([2.6, path(2.6)]), np.array([4.0, path(4.0)])
    perturbed = state + np.array([0.1, 1.15])

    def arrow(start, end, color, bend=0.0, style="-|>", line="-"):
        options = {"arrowstyle": style, "color": color, "lw": 2.2, "ls": line}
        options |= {"shrinkA": 7, "shrinkB": 7, "connectionstyle": f"arc3,rad={bend}"}
        axes.annotate("", end, start, arrowprops=options)

    arrow(state, following, INK, bend=-0.25)
    arrow(state, perturbed, OFF, line=(0, (4, 2)))
    arrow(perturbed, following, BACK, bend=-0.25)
    for point, color in ((state, INK), (following, INK), (perturbed, OFF)):
        axes.scatter(*point, s=70, color=color, zorder=3)
    texts = (
        (state, (-10, -22), r"state $s$", INK, "right"),
        (following, (12, -18), r"next state $s'$", INK, "left"),
        (perturbed, (-12, 4), "perturbed state\n" r"$\hat s = s + \beta\epsilon$",
         OFF, "right"),
        ((3.75, 1.25), (-4, 0), "inverse dynamics model:\n"
         r"$I(a \mid \hat s, s')$ predicts the action" "\nthat the policy learns",
         BACK, "left"),
        ((0.9, path(0.9)), (0, 34), "data", "#5b7fae", "center"),
    )  # fmt: skip
    for point, offset, text, color, side in texts:
        axes.annotate(
            text, point, offset, textcoords="offset points", color=color, ha=side,
            fontsize=13, va="center",
        )  # fmt: skip
    axes.set(xlim=(-0.2, 6.8), ylim=(-0.8, 1.9))
    axes.axis("off")
    figure.savefig(Path(__file__).with_name("idea.png"), dpi=150)


if __name__ == "__main__":
    main()
