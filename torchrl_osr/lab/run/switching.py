"""A switching policy of finished runs; no environment is made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from torchrl_osr.lab.dynamics import EliteNetworks, SwitchingPolicy
from torchrl_osr.lab.dynamics.training import FILE, load_dynamics
from torchrl_osr.lab.run.build import dynamics_options
from torchrl_osr.lab.run.policy_of_run import policy_from_run
from torchrl_osr.lab.run.run_config import read_run
from torchrl_osr.lab.run.run_folder import CONFIG
from torchrl_osr.lab.run.trained_run import run_folder_of
from torchrl_osr.policy.policy import Policy


def load_switching_policy(
    runs: Sequence[Path | str],
    *,
    judges: Sequence[Path | str] | None = None,
    critics_only: bool = False,
    trust: Sequence[str] = (),
    **options: Any,
) -> SwitchingPolicy:
    """One policy of several runs of a task, in the environment's units, on the CPU.

    Each run's policy is rolled out in the models of all runs, and the mean of all runs'
    critics values where that ends; the best one acts. Needs ``torchrl-osr[train]``.

    Args:
        runs: folders, or checkpoints in them, as for :func:`~torchrl_osr.load_policy`.
            Several seeds of ``loss=rim`` have what it takes.

    Keyword Args:
        judges: other runs whose models and critics predict. Default: ``runs``.
        critics_only: roll nothing out; the critics value each policy's action here.
        trust: modules of your own that a run may name, see docs/extend.md.
        options: ``steps`` and ``hold`` of
            :class:`~torchrl_osr.lab.dynamics.SwitchingPolicy`.

    Raises:
        FileNotFoundError: there is no such run, or a judge has no model.
        ValueError: there is no run, they are of different tasks or discounts, their
            actions are discrete, the judges' rewards are in different units, a judge
            has no critics or a model that runs backwards, or the models' layers differ.
    """
    paths = [Path(each) for each in runs]
    judging = paths if judges is None else [Path(each) for each in judges]
    if not paths or not judging:
        raise ValueError("a switching policy needs at least one run and one judge.")
    once = dict.fromkeys([*paths, *judging])
    policies = {each: policy_from_run(each, trust) for each in once}
    for name in ("env_id", "discount"):
        found = {str(each.record["source"][name]) for each in policies.values()}
        if len(found) > 1:
            raise ValueError(
                f"the runs differ in their {name}: {', '.join(sorted(found))}; switch "
                "between runs of one task and one discount."
            )
    critics = [policies[each] for each in judging]
    for path, policy in policies.items():
        if policy.discrete:
            raise ValueError(f"{path} has discrete actions, which cannot be switched.")
        if path in judging and not policy.critics:
            raise ValueError(f"{path} has no critics, and so it cannot be a judge.")

    def value(state: Tensor, action: Tensor) -> Tensor:
        values = [each.smallest_value(state, action) for each in critics]
        return torch.stack(values).mean(0)

    configs = [read_run(run_folder_of(each) / CONFIG, trust) for each in judging]
    units = {(each.data.reward_scale, each.data.reward_shift) for each in configs}
    if len(units) > 1:
        raise ValueError(
            "the judges predict and value rewards in different units: their "
            f"data.reward_scale and data.reward_shift are {sorted(units)}."
        )
    networks = None
    if not critics_only:
        parts = map(_networks, judging, configs, critics)
        networks = EliteNetworks.join(list(parts))
    return SwitchingPolicy(
        [policies[each] for each in paths],
        networks,
        value,
        terminated=dynamics_options(configs[0]).termination(configs[0].env.id),
        gamma=configs[0].optim.gamma,
        **options,
    )


def _networks(path: Path, config: DictConfig, policy: Policy) -> EliteNetworks:
    """The model of a run, in its policy's units."""
    folder = run_folder_of(path)
    if not (folder / FILE).exists():
        raise FileNotFoundError(
            f"{folder} has no model of the dynamics to roll policies out in: train "
            "with loss=rim or dynamics=ensemble; or in Python, name runs that have one "
            "as judges, or choose with critics_only=True."
        )
    if config.dynamics.reverse_policy is not None:
        raise ValueError(f"{folder} has a model that runs backwards in time.")
    units = policy.loc, policy.scale, policy.low, policy.high
    return EliteNetworks(load_dynamics(folder / FILE), *units)
