"""Value of a policy on a log, by rollouts of the robot's identified body.

Shapes: ``N`` transitions, ``B`` states, ``S`` observation, ``E`` episodes.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_osr.fast import FastUpdate
from torchrl_osr.lab.data.rows import episode_of
from torchrl_osr.lab.dynamics import Body, DynamicsEnsemble, DynamicsLoss
from torchrl_osr.lab.dynamics.body import fitted_body
from torchrl_osr.lab.dynamics.rollouts import task_limits, termination
from torchrl_osr.lab.evaluation.episodes import UnitPolicy
from torchrl_osr.lab.evaluation.offline import act, check_discount, first_states, fit
from torchrl_osr.lab.evaluation.statistics import Array

MAX_STARTS = 100


def fitted_grey_box(
    data: TensorDict,
    body: Body,
    *,
    steps: int = 3000,
    seed: int = 0,
    progress: bool = True,
) -> DynamicsEnsemble:
    """Identify the body, and learn rewards and ends, from transitions ``[N]``."""
    sizes = [data[key].shape[-1] for key in ("observation", "action")]
    body.check(*sizes)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        cells = 128, 128, 128
        dynamics = DynamicsEnsemble(
            *sizes, num_networks=1, num_elites=1, num_cells=cells
        )
    dynamics.limits.copy_(task_limits(data))
    dynamics.body, rows = fitted_body(body, data, seed=seed)
    dynamics.standardize_(rows)
    optimizer = torch.optim.Adam(dynamics.parameter_groups(), lr=1e-3, fused=True)
    update = FastUpdate(DynamicsLoss(dynamics), optimizer)
    fit(update, rows, "grey box", steps, seed=seed, progress=progress)
    return dynamics.requires_grad_(False)


@torch.no_grad()
def rolled_out_values(
    model: DynamicsEnsemble,
    data: TensorDict,
    policy: UnitPolicy,
    *,
    gamma: float = 0.997,
) -> Array:
    """Return a policy's discounted returns in a grey box, from first states, ``[E]``.

    The model is one of :func:`fitted_grey_box`. The other arguments are those of
    :func:`~torchrl_osr.lab.evaluation.fitted_values`. Rollouts have ``3 / (1 - gamma)``
    steps: 5 % of the return are left then. Rewards stay within the range of the data.
    Of more than 100 episodes, 100 are drawn.

    Examples:
        >>> import gymnasium
        >>> from torchrl_osr.lab.data import load_dataset
        >>> from torchrl_osr.lab.dynamics import Body
        >>> from torchrl_osr.lab.evaluation import fitted_grey_box, rolled_out_values
        >>> data, _ = load_dataset("hopper", "random", num_transitions=300)
        >>> hopper = Body(gymnasium.make("Hopper-v5").unwrapped.fullpath, 4)
        >>> model = fitted_grey_box(data, hopper, steps=10, progress=False)
        in rollouts, the task ends where observation[1] < -...
        body as described: error ... standard deviations in a step
        body as identified: error ... standard deviations in a step
        >>> values = rolled_out_values(model, data, lambda s: s[:, :3], gamma=0.9)
    """
    check_discount(gamma)
    state, ended = first_states(data, episode_of(data)), termination(None, model.limits)
    generator = torch.Generator().manual_seed(0)
    state = state[torch.randperm(len(state), generator=generator)[:MAX_STARTS]]
    least, most = data["next", "reward"].aminmax()
    value, size = torch.zeros_like(state[:, 0]), data["action"].shape[-1]
    going = torch.arange(len(state))
    for step in range(round(3 / (1 - gamma))):
        change = model.predict(state, act(policy, model.observed(state), size))[0][0]
        value[going] += gamma**step * change[:, -1].clamp(least, most)
        state = state + change[:, :-1]
        finite = state.isfinite().all(-1)  # else the body has exploded
        value[going[~finite]] += gamma ** (step + 1) / (1 - gamma) * least
        goes_on = finite & ~ended(state)
        state, going = state[goes_on], going[goes_on]
        if not len(going):
            break
    return value.double().numpy()
