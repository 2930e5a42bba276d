"""A rough description of a robot's body, and its identification from a log.

Shapes: ``B`` states, ``S`` observation, ``A`` action, ``F`` factors.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.minimize import least_squares
from mujoco.rollout import rollout as simulate
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_osr.lab.data.transitions import VECTOR_KEYS, has_next_state

Numbers = Sequence[float]


@cache
def compiled(xml: str, changed: float) -> Any:
    """Return the model of a description; read a changed file again."""
    return mujoco.MjModel.from_xml_path(xml)


@dataclass(frozen=True)
class Body:
    """Simulate a robot from a description of its body.

    Observations are ``[qpos[hidden:], qvel]``, as those of Gymnasium's MuJoCo tasks:
    positions and velocities. If they are shorter than that, the first positions are
    hidden, and 0 in the simulation. States may go beyond what the sensors show, see
    :meth:`observed`.

    Args:
        xml: file of the description, MJCF.
        frame_skip: physics steps of an action.
        factors: ``[F]``, of each mass (with its inertia), of each gear, of all damping
            and of all friction. Default: 1.
        loc, scale: observations are ``(s - loc) / scale``.
        low, high: controls of the actions -1 and 1.
        least, most: limits of the sensors.

    Examples:
        >>> import gymnasium
        >>> env = gymnasium.make("Hopper-v5").unwrapped
        >>> body = Body(env.fullpath, env.frame_skip)
        >>> body(torch.zeros(7, 11), torch.zeros(7, 3)).shape
        torch.Size([7, 11])
    """

    xml: str
    frame_skip: int
    factors: Numbers = ()
    loc: Numbers | float = 0.0
    scale: Numbers | float = 1.0
    low: Numbers | float = -1.0
    high: Numbers | float = 1.0
    least: Numbers | float = -math.inf
    most: Numbers | float = math.inf

    @cached_property
    def model(self) -> Any:
        """The compiled description, times the factors."""
        changed = os.path.getmtime(self.xml) if os.path.exists(self.xml) else 0.0
        model: Any = deepcopy(compiled(self.xml, changed))
        # Or an unstable body would be back in its start pose, upright and healthy.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        if len(self.factors):
            masses, gears, others = np.split(self.factors, [model.nbody - 1, -2])
            model.body_mass[1:] *= masses
            model.body_inertia[1:] *= masses[:, None]
            model.actuator_gear[:] *= gears[:, None]
            model.dof_damping[:] *= others[0]
            model.geom_friction[:, 0] *= others[1]
            mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def check(self, observation_size: int, action_size: int) -> None:
        """Raise a ValueError if the description is of another robot."""
        positions, velocities = self.model.nq, self.model.nv
        fits = velocities <= observation_size <= positions + velocities
        if not fits or action_size != self.model.nu:
            raise ValueError(
                f"{self.xml} has {positions} positions, {velocities} velocities and "
                f"{self.model.nu} actuators, and the data have {observation_size} "
                f"observed numbers and {action_size} actions. Expected: all velocities "
                "after all positions, or after the last of them."
            )

    def __call__(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return the next states ``[B, S]``, without a gradient."""
        model = self.model
        seen = observation.detach().cpu().double().numpy() * self.scale + self.loc
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.zeros((len(seen), mujoco.mj_stateSize(model, kind)))
        end = 1 + model.nq + model.nv  # time comes first
        observed = slice(end - seen.shape[1], end)
        state[:, observed] = seen
        share = (action.detach().cpu().double().numpy() + 1) / 2
        low, high = np.asarray(self.low), np.asarray(self.high)
        control = (low + share * (high - low))[:, None].repeat(self.frame_skip, 1)
        states, _ = simulate(model, mujoco.MjData(model), state, control)
        found = (states[:, -1, observed] - self.loc) / self.scale
        return torch.from_numpy(found).to(observation)

    def observed(self, state: Tensor) -> Tensor:
        """Return what the sensors show of states."""
        return state.clamp(state.new_tensor(self.least), state.new_tensor(self.most))

    def in_own_units(self) -> Body:
        """Return the body for observations and controls as they are."""
        least, most = (
            (np.asarray(each) * self.scale + self.loc).tolist()
            for each in (self.least, self.most)
        )
        units: Any = {"loc": 0.0, "scale": 1.0, "low": -1.0, "high": 1.0}
        return replace(self, least=least, most=most, **units)

    def shows(self, rows: TensorDictBase) -> Tensor:
        """Return which transitions ``[N]`` are within the limits, bool ``[N]``."""
        states = torch.stack([rows["observation"], rows["next", "observation"]])
        low, high = states.new_tensor(self.least), states.new_tensor(self.most)
        return ((states > low) & (states < high)).all(-1).all(0)

    def limited(self, rows: TensorDictBase) -> Body:
        """Return the body with the limits that transitions ``[N]`` show.

        A limit is a column's lowest or highest number that 0.1 % of the rows share.
        Gymnasium clips the velocities of Hopper and Walker2d, for example.
        """
        states = rows["observation"]
        low, high = states.aminmax(dim=0)
        few = max(10, len(states) // 1000)
        shared = [(states == each).sum(0) >= few for each in (low, high)]
        least, most = low.where(shared[0], -math.inf), high.where(shared[1], math.inf)
        return replace(self, least=least.tolist(), most=most.tolist())


def identify(body: Body, rows: TensorDictBase) -> Body:
    r"""Return the body with the factors that explain a log best.

    .. math::
        \min_f \sum_i \lVert \operatorname{clip}(\hat s'_i(f) - s'_i)
            \rVert_2^2 + N S\, w^2 \lVert \log f \rVert_2^2, \quad
            0.25 \le f \le 4

    by MuJoCo's least squares, with errors in standard deviations. The second term, with
    :math:`w = 10^{-3}`, decides between factors that explain the rows alike: a robot
    with twice all masses, gears and damping moves the same.

    Args:
        body: as described.
        rows: transitions ``[N]`` within the limits of the sensors; 1,000 take seconds.
    """
    states, following, actions = map(rows.get, VECTOR_KEYS)
    weight, unit = 1e-3 * states.numel() ** 0.5, states.std(0)

    def residual(logs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``[N S + F, n]`` of the logarithms of the factors ``[F, n]``."""
        bodies = [replace(body, factors=column) for column in np.exp(logs.T)]
        found = [(each(states, actions) - following) / unit for each in bodies]
        errors = torch.stack(found, -1).nan_to_num(1.0).clamp(-1, 1)
        return np.concatenate([errors.flatten(0, -2).double().numpy(), weight * logs])

    start = np.zeros(len(body.model.body_mass) - 1 + body.model.nu + 2)
    bounds = [start - np.log(4), start + np.log(4)]
    logs, _ = least_squares(
        start, residual, bounds, eps=1e-4, xtol=1e-4, max_iter=40, verbose=0
    )
    return replace(body, factors=np.exp(logs).tolist())


def fitted_body(body: Body, rows: TensorDict, *, seed: int) -> tuple[Body, TensorDict]:
    """Identify a body by 1,000 rows of a log ``[N]``, and print the errors.

    Returns:
        The body, and the rows within its limits, with ``"simulated"``: what it predicts
        instead of the next observation.
    """
    rows = rows[has_next_state(rows)]
    body = body.limited(rows)
    rows = rows[body.shows(rows)].cpu()
    if not len(rows):
        raise ValueError(
            "In every row, an observed number is at its limit or never changes: the "
            "body needs all positions and velocities."
        )
    generator = torch.Generator().manual_seed(seed)
    some = rows[torch.randperm(len(rows), generator=generator)[:1000]]
    found = identify(body, some)
    state, following, action = map(some.get, VECTOR_KEYS)
    for name, each in (("described", body), ("identified", found)):
        change = (each(state, action) - following) / state.std(0)
        error = change.square().mean().sqrt()
        print(f"body as {name}: error {error:.2g} standard deviations in a step")
    # MuJoCo keeps every physics step in float64.
    pieces = (rows[key].split(100_000) for key in ("observation", "action"))
    rows["simulated"] = torch.cat([found(*each) for each in zip(*pieces, strict=True)])
    return found, rows[rows["simulated"].isfinite().all(-1)]
