"""Draw a pushed episode, the monitor's score, its threshold and the fall.

    MUJOCO_GL=egl python docs/figures/monitor.py RUN docs/figures/monitor.png

Add ``--search 16`` to print the steps from alarm to fall for so many seeds instead.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gymnasium
import numpy as np
from matplotlib.figure import Figure

from torchrl_osr.lab.envs import ExternalPush
from torchrl_osr.lab.run.load import load_run_policy
from torchrl_osr.lab.run.monitor import MonitorConfig, monitor_of_run

AT, STEPS, DURATION, FRAMES = 150, 350, 5, 8


def main() -> None:
    """Play and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("run", type=Path)
    add("path", type=Path)
    add("--push", type=float, default=1.0, help="in body weights")
    add("--seed", type=int, default=710_000, help="of the episode")
    add("--search", type=int, default=0, help="number of seeds")
    given = parser.parse_args()
    policy = load_run_policy(given.run)
    policy.attach(monitor := monitor_of_run(given.run, MonitorConfig()))
    limit = float(monitor.threshold)
    env = gymnasium.make(
        policy.record["source"]["env_id"],
        render_mode="rgb_array", camera_name="track", width=240, height=300,
    )  # fmt: skip
    env = ExternalPush(env, given.push, duration=DURATION, at=AT)
    for seed in range(given.seed, given.seed + max(given.search, 1)):
        state, _ = env.reset(seed=seed)
        states, frames, fell = [state], [], False
        while len(states) < STEPS and not fell:
            if not given.search:
                frames.append(env.render())
            state, _, fell, _, _ = env.step(policy.act(state))
            states.append(state)
        score, alarm = policy.monitor(np.stack(states))
        alarms = np.flatnonzero(alarm)
        first = alarms[0] if len(alarms) else None
        print(f"seed {seed}: push {AT}, alarm {first}, fall {fell and len(states) - 1}")
    env.close()
    if given.search:
        return
    figure = Figure(figsize=(10, 5), layout="constrained")
    top, below = figure.subfigures(2, height_ratios=[1, 1.3])
    shown = np.linspace(AT - 20, len(frames) - 1, FRAMES).astype(int)
    for step, axes in zip(shown, top.subplots(1, FRAMES), strict=True):
        axes.imshow(frames[step])
        axes.set(xticks=[], yticks=[])
        red = first is not None and step >= first
        axes.set_title(f"step {step}", color="#d55e00" if red else "black", fontsize=10)
        axes.spines[:].set(color="#d55e00" if red else "black", linewidth=2)
    axes = below.subplots()
    axes.plot(score, color="#0072b2")
    axes.axhline(limit, color="#777777", ls="--")
    axes.text(2, limit, "threshold: 5 % false alarms an episode", va="bottom")
    axes.axvspan(AT, AT + DURATION, color="#e69f00", alpha=0.5)
    top_of_axes = float(score.max()) * 1.05
    marks = [(AT, "push", "right"), (first, " alarm", "left")]
    marks += [(len(states) - 1, "fall ", "right")] if fell else []
    for step, text, side in marks:
        if step is not None:
            axes.axvline(step, color="black", lw=0.8)
            axes.text(step, top_of_axes, text, ha=side, va="top", fontweight="bold")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set(xlabel="step (8 ms)", ylabel="distance to the data", ylim=(0, None))
    figure.savefig(given.path, dpi=110)


if __name__ == "__main__":
    main()
