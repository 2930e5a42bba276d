"""Train a policy on offline data, with one command.

    torchrl-osr train env=hopper
    torchrl-osr train env.id=Pendulum-v1 data=file data.path=log.npz
    torchrl-osr train env=walker2d data=medium-expert seed=3 preset=paper
    torchrl-osr train -m env=hopper,walker2d seed=0,1,2 hydra/launcher=pool
    torchrl-osr train resume=<folder of a run> trainer.steps=40_000

Data of the built-in tasks are rolled out on this machine at the first run and cached;
docs/any_environment.md is about all others. A run leaves ``curve.png``,
``returns.json``, ``inverse_dynamics.json``, ``policy.safetensors``, ``config.yaml``,
``status.json``, CSV files and ``checkpoint/`` in its folder.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from torchrl_osr.lab.cli.console import single_job
from torchrl_osr.lab.run import CONF
from torchrl_osr.lab.run.folder import open_run
from torchrl_osr.lab.run.schema import register
from torchrl_osr.lab.run.train import train

register()


@hydra.main(version_base="1.3", config_path=CONF, config_name="train")
@single_job
def main(cfg: DictConfig) -> float:
    """Do or continue one run; return its last score or return, for a sweeper."""
    with open_run(cfg) as run:
        return train(run)
