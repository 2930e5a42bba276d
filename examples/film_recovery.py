"""Draw figure 3 of the paper: three controllers after the same push.

    torchrl-osr train env=hopper data=medium-expert hydra.run.dir=outputs/hopper
    python examples/film_recovery.py outputs/hopper --push 0.5

The behaviour policy plays until the push is over. Then it continues, or the inverse
dynamics model or the OSR policy takes over. The model's target is a state of the
undisturbed episode: the one at the next step, as in the paper, or with ``--nearest``
the successor of the state nearest to the present one. Rendering needs
``MUJOCO_GL=egl`` (the default on Linux) or ``osmesa``.
"""

import argparse
import os
import sys
from pathlib import Path

if sys.platform == "linux":  # before MuJoCo is imported; egl needs no display
    os.environ.setdefault("MUJOCO_GL", "egl")

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import RecordVideo
from matplotlib.figure import Figure
from tensordict import TensorDict

from torchrl_osr.lab.data import load_behavior_policy
from torchrl_osr.lab.envs import ExternalPush
from torchrl_osr.lab.run.config import check_environment
from torchrl_osr.lab.run.load import load_trained

BEGIN, DURATION, EVERY, FRAMES = 100, 5, 25, 9  # steps; a frame every 25 from the push


def play(env, before, after, seed):
    """Return observations ``[T, S]``, frames, and the step of the fall or ``None``."""
    observation, _ = env.reset(seed=seed)
    observations, frames = [observation], []
    for step in range(BEGIN + EVERY * (FRAMES - 1) + 1):
        if step >= BEGIN and (step - BEGIN) % EVERY == 0:
            frames.append(env.render())
        controller = before if step < BEGIN + DURATION else after
        action = np.clip(controller(observation, step), -1, 1)
        observation, _, terminated, _, _ = env.step(action)
        observations.append(observation)
        if terminated:
            return np.stack(observations), [*frames, env.render()], step - BEGIN
    return np.stack(observations), frames, None


def draw(rows, title, path):
    """Draw a row of frames for each controller."""
    figure = Figure(figsize=(1.3 * FRAMES + 0.5, 1.4 * len(rows) + 0.6))
    grid = figure.subplots(len(rows), FRAMES)
    for (name, (_, frames, fell)), line in zip(rows.items(), grid, strict=True):
        line[0].set_ylabel(name.replace("_", " "))
        for column, axes in enumerate(line):
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            if column < len(frames):
                last = fell is not None and column == len(frames) - 1
                axes.imshow(frames[column])
                axes.set_title(f"falls at {fell}" if last else column * EVERY)
    figure.suptitle(title)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main(arguments=None):
    """Play the three episodes, and draw them into the run's folder."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="folder of a run of OSR")
    parser.add_argument("--push", type=float, default=0.5, help="in body weights")
    parser.add_argument("--seed", type=int, default=30_000, help="of the episode")
    parser.add_argument("--nearest", action="store_true", help="target of the model")
    parser.add_argument("--video", help="folder for mp4 files; needs moviepy")
    given = parser.parse_args(arguments)

    trained = load_trained(given.run)
    task, norm = trained.config.env, trained.observation_norm
    check_environment(task.id)  # a run of others may name a module of theirs
    if trained.inverse_dynamics is None:
        parser.error(f"{given.run} has no inverse dynamics model: give a run of OSR.")
    expert = load_behavior_policy(task.name, "expert").deterministic

    def state_of(observation):
        return (torch.as_tensor(observation).float() - norm.loc) / norm.scale

    def mode(network, **state):
        return network.get_dist(TensorDict(state, [])).deterministic_sample.numpy()

    def behaviour(observation, _):
        return expert(observation[None])[0]

    def inverse_dynamics(observation, step):
        state = state_of(observation)
        if given.nearest:
            step = int((reference[:-1] - state).square().sum(-1).argmin())
        target = {"observation": reference[min(step + 1, len(reference) - 1)]}
        return mode(trained.inverse_dynamics, observation=state, next=target)

    def osr(observation, _):
        return mode(trained.actor, observation=state_of(observation))

    def episode(controller, push):
        view = {"camera_name": "track", "width": 240, "height": 240}
        env = gymnasium.make(task.id, render_mode="rgb_array", **view)
        if given.video and push:
            env = RecordVideo(env, given.video, name_prefix=controller.__name__)
        options = {"duration": DURATION, "at": BEGIN}
        with ExternalPush(env, push, **options) as env, torch.no_grad():
            return play(env, behaviour, controller, given.seed)

    reference = state_of(episode(behaviour, 0.0)[0])
    controllers = (behaviour, inverse_dynamics, osr)
    rows = {each.__name__: episode(each, given.push) for each in controllers}
    path = given.run / "recovery.png"
    draw(rows, f"{task.id}, steps after a push of {given.push:g} body weights", path)
    print({n: "up" if fell is None else fell for n, (*_, fell) in rows.items()}, path)


if __name__ == "__main__":
    main()
