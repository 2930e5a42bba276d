"""Draw the figures of docs/results.md: recovery rates, and survival by disturbance.

python docs/figures/recovery.py
"""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib as mpl
from matplotlib import pyplot as plt

mpl.use("Agg")
mpl.rcParams.update({"font.size": 11, "axes.spines.top": False})
mpl.rcParams.update({"axes.spines.right": False, "figure.constrained_layout.use": True})

HERE = Path(__file__).parent
TABLE = HERE.parents[1] / "results" / "recovery" / "dose-walker2d.md"
# Percent of the held-out recoverable states, with 95 % intervals.
RATES = {
    "TD3+BC + noisy BC": {"Walker2d": (11, 8, 15), "Hopper": (13, 8, 17)},
    "RIM, one policy": {"Walker2d": (25, 20, 31), "Hopper": (24, 19, 30)},
    "RIM, policy switching\namong five": {
        "Walker2d": (34, 27, 41),
        "Hopper": (35, 28, 43),
    },
}
METHODS = {  # columns of the table
    "simulator planner": ("planner", "#222222", ":"),
    "RIM, policy switching among five": ("choice", "#009e73", "-"),
    "RIM, one policy": ("disturbed starts", "#d55e00", "-"),
    "OSR": ("OSR", "#0072b2", "-"),
    "TD3+BC + noisy BC": ("noisy cloning", "#777777", "-"),
}
KINDS = {  # kind: title and unit of the strength
    "torque": "random torques (steps)",
    "rest": "no torques (steps)",
    "push": "push (body weights)",
    "kick": "kick, all velocities (SD)",
    "kick-root": "kick, body only (SD)",
    "kick-joints": "kick, joints only (SD)",
}


def rates() -> None:
    """Draw bars of the recovery rates with their intervals."""
    figure, axes = plt.subplots(1, 2, figsize=(7, 2.9), sharey=True)
    colors = "#777777", "#d55e00", "#009e73"
    for panel, robot in zip(axes, ("Walker2d", "Hopper"), strict=True):
        for row, (method, color) in enumerate(zip(RATES, colors, strict=True)):
            mean, low, high = RATES[method][robot]
            error = [[mean - low], [high - mean]]
            panel.barh(row, mean, xerr=error, color=color, capsize=3, height=0.6)
            panel.text(high + 1, row, f"{mean} %", va="center", color=color)
        panel.set(title=robot, xlim=(0, 52), xlabel="recovery rate in %")
        panel.set_yticks(range(len(RATES)), list(RATES))
        panel.invert_yaxis()
    figure.suptitle("Held-out recoverable states, medium-expert data, 95 % intervals")
    figure.savefig(HERE / "recovery_rate.png", dpi=150)


def survival() -> None:
    """Draw the share of disturbed states survived, over the strength."""
    head, *rows = (
        [cell.strip() for cell in line.strip("| \n").split("|")]
        for line in TABLE.read_text(encoding="utf-8").split("By group")[0].splitlines()
        if re.match(r"\| (disturbance|[a-z-]+ [\d.]+) ", line)
    )
    figure, axes = plt.subplots(2, 3, figsize=(9, 5.4), sharey=True)
    for panel, (kind, title) in zip(axes.flat, KINDS.items(), strict=True):
        chosen = [row for row in rows if row[0].split()[0] == kind]
        chosen.sort(key=lambda row: float(row[0].split()[1]))
        strength = [float(row[0].split()[1]) for row in chosen]
        for method, (column, color, line) in METHODS.items():
            share = [100 * float(row[head.index(column)]) for row in chosen]
            marker = "" if line == ":" else "o"
            panel.plot(strength, share, line, color=color, marker=marker, label=method)
        panel.set(title=title, ylim=(0, 100), xticks=strength)
    for panel in axes[:, 0]:
        panel.set_ylabel("survived, %")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
    figure.savefig(HERE / "survival_walker2d.png", dpi=130)


if __name__ == "__main__":
    rates()
    survival()
