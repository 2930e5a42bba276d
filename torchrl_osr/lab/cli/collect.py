"""Roll out a policy in any Gymnasium environment and keep the steps as a log.

    torchrl-osr collect env.id=Pendulum-v1 path=pendulum.npz
    torchrl-osr collect env.id=Pendulum-v1 policy=my_package:act path=pendulum.npz
    torchrl-osr collect policy=outputs/Pendulum-v1-file/osr-seed0-... path=new.npz

The log is what ``torchrl-osr train data=file`` reads. See docs/any_environment.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from importlib import import_module
from pathlib import Path

import hydra
import numpy as np
import torch
from gymnasium.spaces import Discrete
from numpy.typing import NDArray
from omegaconf import DictConfig

from torchrl_osr.lab.cli import CONF
from torchrl_osr.lab.cli.console import single_job
from torchrl_osr.lab.data.environment import check_simulated, open_environment
from torchrl_osr.lab.data.record import (
    Act,
    check_log_path,
    record_episodes,
    write_log,
)
from torchrl_osr.lab.run import schema
from torchrl_osr.lab.run.limits import check_values
from torchrl_osr.lab.run.policy_of_run import load_run_policy
from torchrl_osr.lab.run.run_config import (
    chosen_environment,
    import_from_here,
    module_of,
)
from torchrl_osr.policy import Policy

schema.register()


@hydra.main(version_base="1.3", config_path=CONF, config_name="collect")
@single_job
def main(cfg: DictConfig) -> None:
    """Play the episodes, write the log, and say what is in it."""
    check_values({name: cfg[name] for name in ("episodes", "seed")})
    torch.set_num_threads(1)
    path = Path(cfg.path).expanduser()
    check_log_path(path)
    env_id = chosen_environment(cfg)
    act: Act | None = None
    if cfg.policy == "random":
        if cfg.noise:
            raise ValueError(
                f"noise={cfg.noise} is added to a policy's actions, and policy=random "
                "has none of its own: leave it out."
            )
    elif Path(cfg.policy).exists():
        policy = load_run_policy(cfg.policy, cfg.trust)
        env_id, act = env_id or environment_of(policy, cfg.trust), policy.act
    elif ":" in cfg.policy:
        act = imported(cfg.policy)
    else:
        raise ValueError(
            f"policy={cfg.policy} is neither random, nor the folder of a run, nor a "
            "function as in policy=my_package:act."
        )
    if env_id is None:
        raise ValueError("env.id is not given: say which environment to play.")
    with closing(open_environment(env_id)) as env:
        check_simulated(env, env_id)
        loss = "loss=discrete_osr " if isinstance(env.action_space, Discrete) else ""
        columns = record_episodes(
            env,
            act,
            cfg.episodes,
            noise=cfg.noise,
            seed=cfg.seed,
            progress=cfg.progress,
        )
    write_log(path, columns)
    print(description(path, columns))
    print(f"  torchrl-osr train env.id={env_id} {loss}data=file data.path={path}")


def environment_of(policy: Policy, trust: Sequence[str]) -> str | None:
    """Id of the environment that a policy was trained in, if it is known.

    Raises:
        ValueError: if it imports a package that is not trusted: the policy may come
            with it.
    """
    env_id: str | None = policy.record["source"].get("env_id")
    if env_id is not None and not {*module_of(env_id)} <= {*trust}:
        raise ValueError(
            f"the policy is of env.id={env_id}, which imports a package: if you know "
            "it, give env.id yourself, or trust=[...]."
        )
    return env_id


def imported(name: str) -> Act:
    """Function of a module, as in ``"my_package:act"``; the current folder counts."""
    import_from_here()
    module, _, function = name.partition(":")
    try:
        act: Act = getattr(import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"policy={name} cannot be imported: {error}. Give a function of a module "
            "that is installed or in the current folder, as in policy=my_package:act."
        ) from error
    return act


def description(path: Path, columns: dict[str, NDArray[np.generic]]) -> str:
    """Text of what was recorded: steps, episodes and their returns."""
    returns = np.bincount(columns["episode"], weights=columns["reward"])
    return (
        f"{path}: {len(columns['reward']):,} steps, {len(returns)} episodes, "
        f"return {returns.mean():.1f} ({returns.min():.1f} to {returns.max():.1f})"
    )


if __name__ == "__main__":
    main()
