"""Value of a policy on data alone, by rollouts in a learned model of the task.

Shapes: ``N`` transitions, ``B`` states, ``S`` observation, ``K`` networks, ``E``
episodes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch.nn.functional import binary_cross_entropy_with_logits
from torchrl.modules import MLP

from torchrl_osr.lab.data import observation_statistics
from torchrl_osr.lab.data.rows import episode_of
from torchrl_osr.lab.dynamics import DynamicsEnsemble, DynamicsLoss
from torchrl_osr.lab.dynamics.body import Body, fitted_body
from torchrl_osr.lab.dynamics.rollouts import Termination, never
from torchrl_osr.lab.evaluation.episodes import Policy
from torchrl_osr.lab.evaluation.offline import act, check_discount, first_states, fit
from torchrl_osr.lab.evaluation.statistics import Array

MAX_STARTS = 100


class TaskModel(NamedTuple):
    """Networks that predict the next state and the reward, and where the task ends."""

    dynamics: DynamicsEnsemble
    ended: Termination


def fitted_task(
    data: TensorDict,
    *,
    steps: int = 10_000,
    num_networks: int = 5,
    batch_size: int = 128,
    seed: int = 0,
    progress: bool = True,
    body: Body | None = None,
) -> TaskModel:
    """Learn a model of the task from transitions ``[N]``, its end from their flags.

    With a ``body``, in the units of the data, the model is a grey box of one network.
    """
    num_networks = 1 if body is not None else num_networks
    sizes = (data[key].shape[-1] for key in ("observation", "action"))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        dynamics = DynamicsEnsemble(
            *sizes,
            num_networks=num_networks,
            num_elites=num_networks,
            num_cells=(128, 128, 128),
        )
        ended = fitted_end(data)
    if body is not None:
        dynamics.body, data = fitted_body(body, data, seed=seed)
    dynamics.standardize_(data)
    optimizer = torch.optim.Adam(dynamics.parameter_groups(), lr=1e-3, fused=True)
    fit(
        DynamicsLoss(dynamics),
        optimizer,
        None,
        data,
        "model of the task",
        batch_size=num_networks * batch_size,
        steps=steps,
        seed=seed,
        progress=progress,
    )
    return TaskModel(dynamics.requires_grad_(False), ended)


def fitted_end(data: TensorDict, *, steps: int = 1000) -> Termination:
    """Learn which states end the task; draws from torch's global generator."""
    ended = data["next", "terminated"].squeeze(-1)
    if not ended.any():
        return never
    loc, scale = observation_statistics(data)
    states = (data["next", "observation"] - loc) / scale
    network = MLP(states.shape[-1], 1, num_cells=[64, 64])
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    groups = [flags.nonzero()[:, 0] for flags in (ended, ~ended)]
    for _ in range(steps):  # as many rows of either kind
        drawn = [each[torch.randint(len(each), [64])] for each in groups]
        logit = network(states[rows := torch.cat(drawn)]).squeeze(-1)
        loss = binary_cross_entropy_with_logits(logit, ended[rows].float())
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    network.requires_grad_(False)
    # Log-odds among all rows are those among the drawn ones and this.
    odds = math.log(len(groups[0]) / len(groups[1]))
    return lambda state: network((state - loc) / scale).squeeze(-1) + odds > 0


@torch.no_grad()
def rolled_out_values(
    task: TaskModel,
    data: TensorDict,
    policy: Policy,
    *,
    gamma: float = 0.99,
    steps: int | None = None,
    seed: int = 0,
) -> Array:
    """Return a policy's discounted return in a model, from each first state.

    Each network makes rollouts of its own, with noise. Rewards stay within the range
    of the data, and states too, unless a body moves them.

    Args:
        task: of :func:`fitted_task`.
        data: transitions ``[N]`` in order of time.
        policy: as of :func:`~torchrl_osr.lab.evaluation.fitted_values`.

    Keyword Args:
        gamma: discount factor, below 1.
        steps: length of a rollout; default ``3 / (1 - gamma)``: 5 % are left then.
        seed: of the noise.

    Returns:
        Values ``[K, E]``, one for each network and episode, of at most 100 episodes.

    Examples:
        >>> from torchrl_osr.lab.data import load_dataset
        >>> from torchrl_osr.lab.evaluation import fitted_task, rolled_out_values
        >>> data, _ = load_dataset("hopper", "random", num_transitions=300)
        >>> task = fitted_task(data, steps=10, num_networks=2, progress=False)
        >>> len(rolled_out_values(task, data, lambda state: state[:, :3].tanh()))
        2
    """
    check_discount(gamma)
    model, starts = task.dynamics, first_states(data, episode_of(data))
    generator = torch.Generator().manual_seed(seed)
    starts = starts[torch.randperm(len(starts), generator=generator)[:MAX_STARTS]]
    low, high = data["observation"].aminmax(dim=0)
    least, most = data["next", "reward"].aminmax()
    state = starts.expand(model.num_networks, *starts.shape)
    going = torch.ones_like(state[..., 0])
    value, size = torch.zeros_like(going), data["action"].shape[-1]
    for step in range(round(3 / (1 - gamma)) if steps is None else steps):
        seen = model.observed(state.flatten(0, 1))
        action = act(policy, seen, size).view(*going.shape, size)
        mean, log_variance = model.standardized(torch.cat([state, action], -1))
        noise = torch.randn(mean.shape, generator=generator)
        change = mean + noise * (log_variance / 2).exp()
        change = change * model.target_scale + model.target_loc
        value += going * gamma**step * change[..., -1].clamp(least, most)
        if model.body is None:
            state = (state + change[..., :-1]).clamp(low, high)
        else:
            moved = model.body(state.flatten(0, 1), action.flatten(0, 1))
            state = moved.view_as(state) + change[..., :-1]
        going = going * ~task.ended(state)
        if not going.any():
            break
    found: Array = value.double().numpy()
    return found
