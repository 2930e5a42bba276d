"""A switching policy of finished runs; no environment is made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_osr.lab.dynamics import EliteNetworks, SwitchingPolicy
from torchrl_osr.lab.dynamics.training import FILE, load_dynamics
from torchrl_osr.lab.run.build import dynamics_options
from torchrl_osr.lab.run.policy_of_run import policy_from_run
from torchrl_osr.lab.run.run_config import read_run
from torchrl_osr.lab.run.run_folder import CONFIG
from torchrl_osr.lab.run.trained_run import run_folder_of


def load_switching_policy(
    runs: Sequence[Path | str],
    *,
    judges: Sequence[Path | str] | None = None,
    critics_only: bool = False,
    trust: Sequence[str] = (),
    **options: Any,
) -> SwitchingPolicy:
    """Combine runs of a task to one policy, in the environment's units, on the CPU.

    Each run's policy is rolled out in the models of all runs, and the mean of all runs'
    critics values its last state. Several seeds of ``loss=rim`` have all parts.

    Args:
        runs: folders, or checkpoints in them.

    Keyword Args:
        judges: other runs whose models and critics predict. Default: ``runs``.
        critics_only: use no models.
        trust: modules of your own that a run may name.
        options: ``steps`` and ``hold`` of
            :class:`~torchrl_osr.lab.dynamics.SwitchingPolicy`.

    Raises:
        FileNotFoundError: there is no such run, or a judge has no model.
        ValueError: the runs differ in task, discount or units of reward, have discrete
            actions, or a judge lacks critics or has a reverse model.
    """
    paths = [Path(each) for each in runs]
    judging = paths if judges is None else [Path(each) for each in judges]
    once = dict.fromkeys([*paths, *judging])
    policies = {each: policy_from_run(each, trust) for each in once}
    configs = {each: read_run(run_folder_of(each) / CONFIG, trust) for each in policies}
    for path, policy in policies.items():
        if policy.discrete or (path in judging and not policy.critics):
            raise ValueError(
                f"{path} has discrete actions or no critics: choose other runs."
            )
    for which, keys in (
        (policies, ("env.id", "optim.gamma")),
        (judging, ("data.reward_scale", "data.reward_shift")),
    ):
        for group, name in (each.split(".") for each in keys):
            found = {configs[each][group][name] for each in which}
            if len(found) > 1:
                raise ValueError(
                    f"The runs differ in {group}.{name}: {sorted(found)}. Choose runs "
                    "of one task, with the same discount and units of reward."
                )
    critics = [policies[each] for each in judging]

    def value(state: Tensor, action: Tensor) -> Tensor:
        values = [each.smallest_value(state, action) for each in critics]
        return torch.stack(values).mean(0)

    def networks_of(path: Path) -> EliteNetworks:
        file, policy = run_folder_of(path) / FILE, policies[path]
        if not file.exists():
            raise FileNotFoundError(
                f"{file} does not exist: train with loss=rim or dynamics=ensemble, or "
                "choose with critics_only=True."
            )
        model = load_dynamics(file, {"direction of time": "forward"})
        return EliteNetworks(model, policy.loc, policy.scale, policy.low, policy.high)

    first = configs[judging[0]]
    return SwitchingPolicy(
        [policies[each] for each in paths],
        None if critics_only else EliteNetworks.join([*map(networks_of, judging)]),
        value,
        terminated=dynamics_options(first).termination(first.env.id),
        gamma=first.optim.gamma,
        **options,
    )
