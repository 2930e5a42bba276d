"""Record episodes of a policy as a log; ``conf/collect.yaml`` has the help."""

from __future__ import annotations

import shlex
from contextlib import closing
from pathlib import Path
from pkgutil import resolve_name

import hydra
import numpy as np
import torch
from gymnasium.spaces import Discrete
from omegaconf import DictConfig, OmegaConf

from torchrl_osr.lab.cli.console import single_job
from torchrl_osr.lab.data.environment import open_environment
from torchrl_osr.lab.data.record import Act, check_log_path, record_episodes, write_log
from torchrl_osr.lab.run import CONF
from torchrl_osr.lab.run.config import check_environment
from torchrl_osr.lab.run.load import load_run_policy
from torchrl_osr.lab.run.schema import register

register()


@hydra.main(version_base="1.3", config_path=CONF, config_name="collect")
@single_job
def main(cfg: DictConfig) -> None:
    """Play the episodes, write the log, and print a summary."""
    torch.set_num_threads(1)
    path = Path(cfg.path).expanduser()
    check_log_path(path)
    env_id = None if OmegaConf.is_missing(cfg.env, "id") else cfg.env.id
    act: Act | None = None
    if ":" in cfg.policy:
        try:
            act = resolve_name(cfg.policy)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"cannot import policy={cfg.policy}: {error}.") from error
    elif cfg.policy != "random":
        policy = load_run_policy(cfg.policy, cfg.trust)
        known = policy.record["source"].get("env_id")
        if env_id is None and known:
            check_environment(known, cfg.trust)  # the policy may come with it
            env_id = known
        act = policy.act
    if env_id is None:
        raise ValueError("env.id is not given: name the environment to play.")
    with closing(open_environment(env_id)) as env:
        loss = "loss=discrete_osr " if isinstance(env.action_space, Discrete) else ""
        options = {name: cfg[name] for name in ("noise", "seed", "progress")}
        columns = record_episodes(env, act, cfg.episodes, **options)
    write_log(path, columns)
    returns = np.bincount(columns["episode"], weights=columns["reward"])
    print(
        f"{path}: {len(columns['reward']):,} steps, {len(returns)} episodes, "
        f"return {returns.mean():.1f} ({returns.min():.1f} to {returns.max():.1f})"
    )
    source = shlex.quote(f"data.path={path.as_posix()}")
    print(f"  torchrl-osr train env.id={env_id} {loss}data=file {source}")
