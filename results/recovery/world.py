"""The four systems, many states at once: MuJoCo in C, policies in NumPy.

A state is a row ``[time, qpos, qvel]``, in the maze followed by the goal. Steps, limits
and observations are those of the Gymnasium environments; ``check.py`` compares them.

Shapes: ``B`` rows, ``N`` entries of a row, ``S`` observation, ``A`` action, ``T``
steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray
from torchrl_osr.data import load_behavior_policy, make_environment
from torchrl_osr.data.collect.environment import environment_id
from torchrl_osr.data.collect.mazes import waypoint_sampler

Rows = NDArray[np.float64]
Policy = Callable[[Rows], NDArray[np.float32]]
"""Actions ``[B, A]`` for raw observations ``[B, S]``."""

STEPS = {"pointmaze-medium": 600}
"""Steps from a state within which a policy fails or does not; elsewhere 300."""

SPEED_STEPS = 50
"""HalfCheetah's speed is its mean over the last so many steps."""

WITH_FORCES = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_XFRC_APPLIED)


class NoNoise:
    """Stands where a controller draws its noise."""

    def standard_normal(self, size: int) -> Rows:
        return np.zeros(size)


@dataclass
class Played:
    """What came of each row, ``[B]``.

    Attributes:
        alive: steps until it fell, or all; in the maze steps to the goal, or all.
        success: it did not fail.
        speed: HalfCheetah's mean speed in the last steps, m/s; elsewhere 0.
        rows: the last states, ``[B, N]``.
        steps: simulated, over all rows.
    """

    alive: NDArray[np.int64]
    success: NDArray[np.bool_]
    speed: Rows
    rows: Rows
    steps: int


class World:
    """One of the four systems.

    Args:
        system: ``"hopper"``, ``"walker2d"``, ``"halfcheetah"``, ``"pointmaze-medium"``.
    """

    def __init__(self, system: str) -> None:
        self.system = system
        self.env = make_environment(environment_id(system))
        self.env.reset(seed=0)
        bare = self.env.unwrapped
        self.is_maze = system.startswith("pointmaze")
        self.maze = bare.maze if self.is_maze else None
        self.simulation = bare.point_env if self.is_maze else bare
        self.model = self.simulation.model
        self.frame_skip = self.simulation.frame_skip
        self._data = mujoco.MjData(self.model)
        self.nq, self.nv, self.nu = self.model.nq, self.model.nv, self.model.nu
        self.size = 1 + self.nq + self.nv
        full = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
        assert mujoco.mj_stateSize(self.model, full) == self.size
        self.steps = STEPS.get(system, 300)
        self.seconds = self.frame_skip * self.model.opt.timestep
        self.least_speed = 0.0  # of HalfCheetah; set from the expert's walks

    def current(self) -> Rows:
        """Row of the environment's own state, ``[N]``."""
        data = self.simulation.data
        goal = [self.env.unwrapped.goal] if self.is_maze else []
        return np.concatenate([[0.0], data.qpos, data.qvel, *goal])

    def observe(self, rows: Rows) -> Rows:
        """Observations ``[B, S]``."""
        position = rows[:, 1 : 1 + self.nq]
        velocity = rows[:, 1 + self.nq : self.size]
        if self.is_maze:
            return np.hstack([position, rows[:, self.size :], position, velocity])
        if self.system != "halfcheetah":
            velocity = np.clip(velocity, -10, 10)
        return np.hstack([position[:, 1:], velocity])

    def step(self, rows: Rows, action: NDArray, force: Rows | None = None) -> Rows:
        """Rows after one step of the agent.

        Args:
            rows: ``[B, N]``.
            action: ``[B, A]``, clipped to -1 and 1.
            force: on the torso along x, in newtons, ``[B]``. Default: none.
        """
        state, task = rows[:, : self.size], rows[:, self.size :]
        if self.is_maze:  # as PointEnv does before a step
            state = state.copy()
            state[:, 1 + self.nq :] = np.clip(state[:, 1 + self.nq :], -5, 5)
        control = np.clip(action, -1, 1).astype(np.float64)[:, None]
        options = {}
        if force is not None:
            forces = np.zeros((len(rows), 1, self.model.nbody, 6))
            forces[:, 0, self.model.body("torso").id, 0] = force
            flat = forces.reshape(len(rows), 1, -1)
            control = np.concatenate([control, flat], axis=-1)
            options["control_spec"] = WITH_FORCES
        control = np.repeat(control, self.frame_skip, axis=1)
        after, _ = rollout.rollout(self.model, self._data, state, control, **options)
        return np.hstack([after[:, -1], task])

    def standing(self, rows: Rows) -> NDArray[np.bool_]:
        """Within the limits of Gymnasium's task, ``[B]``; the others have none."""
        finite = np.isfinite(rows).all(1)
        if self.system not in ("hopper", "walker2d"):
            return finite
        height, angle = rows[:, 2], rows[:, 3]
        if self.system == "walker2d":
            return finite & (height > 0.8) & (height < 2) & (np.abs(angle) < 1)
        inside = (np.abs(rows[:, 3 : self.size]) < 100).all(1)
        return finite & (height > 0.7) & (np.abs(angle) < 0.2) & inside

    def at_goal(self, rows: Rows) -> NDArray[np.bool_]:
        """Whether the point is at its goal, ``[B]``."""
        return np.linalg.norm(rows[:, 1:3] - rows[:, self.size :], axis=1) <= 0.45

    def play(
        self,
        rows: Rows,
        policy: Policy,
        steps: int,
        offsets: NDArray[np.float32] | None = None,
    ) -> Played:
        """Let a policy act from each row.

        Args:
            rows: ``[B, N]``.
            policy: acts.
            steps: at most so many.
            offsets: added to its actions in the first steps, ``[B, T, A]``.
        """
        rows, count = rows.copy(), len(rows)
        alive = np.full(count, steps)
        success = np.full(count, not self.is_maze)
        active = np.arange(count)
        simulated, marked = 0, np.zeros(count)
        for step in range(steps):
            if self.is_maze:
                there = self.at_goal(rows[active])
                success[active[there]], alive[active[there]] = True, step
                active = active[~there]
            if not len(active):
                break
            if step == steps - SPEED_STEPS:
                marked = rows[:, 1].copy()
            now = rows[active]
            action = policy(self.observe(now))
            if offsets is not None and step < offsets.shape[1]:
                action = action + offsets[active, step]
            rows[active] = after = self.step(now, action)
            simulated += len(active)
            fell = ~self.standing(after)
            alive[active[fell]], success[active[fell]] = step, False
            active = active[~fell]
        speed = np.zeros(count)
        if self.system == "halfcheetah":
            speed = (rows[:, 1] - marked) / (SPEED_STEPS * self.seconds)
            success &= speed >= self.least_speed
        return Played(alive, success, speed, rows, simulated)

    def changed(self, rows: Rows, std: Rows, rng: np.random.Generator) -> Rows:
        """Rows with noise on positions and velocities, but not on x, which nobody sees.

        Args:
            rows: ``[B, N]``.
            std: of each position and velocity, ``[nq + nv]``.
            rng: of the noise.
        """
        noise = std * rng.standard_normal((len(rows), self.nq + self.nv))
        if not self.is_maze:
            noise[:, 0] = 0
        rows = rows.copy()
        rows[:, 1 : self.size] += noise
        return rows

    def policy(self, name: str) -> Policy:
        """Mean action of a policy that ships; the maze's controller without noise."""
        if not self.is_maze:
            return load_behavior_policy(self.system, name).deterministic
        sample = waypoint_sampler(self.maze)

        def act(observation: Rows) -> NDArray[np.float32]:
            return np.stack([sample(row, NoNoise()) for row in observation])

        return act
