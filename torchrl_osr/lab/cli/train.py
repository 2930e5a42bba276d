"""Train a policy on offline data; ``conf/train.yaml`` has the help."""

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
