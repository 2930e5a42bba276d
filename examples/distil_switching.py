"""Distil a choice among policies into one network, in the body that chooses.

    python examples/distil_switching.py multirun/2026-01-01 --output distilled

The runs, of which one has a grey box (``dynamics=grey_box``), become one switching
policy. It acts in the robot's identified body, from states of the log that random
actions have disturbed. In the second round the network acts, and the switching policy
says what it would do (DAgger, Ross et al. 2011, https://arxiv.org/abs/1011.0686).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from torchrl_osr.lab import fit
from torchrl_osr.lab.run.data import load_data
from torchrl_osr.lab.run.load import load_switching_policy, load_trained


def disturbed(states, networks, size, most=10):
    """Return states after 0 to ``most`` random actions in the body."""
    left = torch.randint(most + 1, [len(states)])
    for step in range(most):
        action = 2 * torch.rand(len(states), size) - 1
        following = states + networks(states[None], action[None])[0, :, :-1]
        states = torch.where((step < left)[:, None], following, states)
    return states


def imagined(states, switching, networks, steps, student=None):
    """Return rows of rollouts in the body, labelled by the switching policy."""
    rows, going = [], ~switching.terminated(states)
    switching.reset()
    for _ in range(steps):
        seen = networks.observed(states)
        action = switching(seen)
        rows.append((seen[going], action[going]))
        taken = action if student is None else student.act(seen)
        states = states + networks(states[None], taken[None])[0, :, :-1]
        going = going & ~switching.terminated(states)
        # States after an end stay finite; their rows are left out.
        states = torch.where(going[:, None], states, rows[0][0][:1])
    return [torch.cat(column) for column in zip(*rows, strict=True)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Roll out, imitate, and do so once more with the network acting."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add = parser.add_argument
    add("runs", nargs="+", type=Path, help="folders of finished runs")
    add("--output", type=Path, default=Path("distilled"))
    add("--starts", type=int, default=500, help="rollouts of a round")
    add("--steps", type=int, default=150, help="steps of a rollout")
    add("--horizon", type=int, default=40, help="predicted steps of a choice")
    add("--hold", type=int, default=10, help="steps between choices")
    add("--rounds", type=int, default=2)
    add("--updates", type=int, default=20_000, help="gradient steps of a round")
    options = parser.parse_args(arguments)
    torch.manual_seed(0)
    torch.set_num_threads(1)
    chosen = {"steps": options.horizon, "hold": options.hold}
    switching = load_switching_policy(options.runs, **chosen)
    networks, config = switching.networks, load_trained(options.runs[0]).config
    data, _ = load_data(config.env, config.data)
    states, actions, student = [], [], None
    for number in range(options.rounds):
        index = torch.randint(len(data), [options.starts])
        starts = disturbed(
            data["observation"][index], networks, data["action"].shape[-1]
        )
        found = imagined(starts, switching, networks, options.steps, student)
        states.append(found[0])
        actions.append(found[1])
        seen = torch.cat(states).numpy()
        log = {"observation": seen, "action": torch.cat(actions).numpy()}
        # For cloning, rows are enough: each is an episode.
        log |= {"next_observation": seen, "terminated": np.zeros(len(seen))}
        log["truncated"] = np.ones(len(seen))
        student = fit(
            log,
            options.output / f"round{number}",
            "loss=bc",
            "network.num_cells=[256,256]",
            f"trainer.steps={options.updates}",
            "trainer.batch_size=256",
            "data.action_bounds=[-1,1]",
        )
        print(f"round {number}: {len(log['action']):,} rows, {options.output}")


if __name__ == "__main__":
    main()
