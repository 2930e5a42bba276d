"""Configurations as the commands are given them."""

from __future__ import annotations

from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from torchrl_osr.lab.run import schema, suite

CONF = Path(__file__).parents[1] / "conf"


def composed(config: str, *overrides: str) -> DictConfig:
    """``composed("train", "seed=1")`` is what ``torchrl-osr train seed=1`` reads.

    A command has the configuration of its name; that of ``data`` is ``check_data``.
    """
    schema.register()
    suite.register()
    folder = CONF / "evaluation" if config == "evaluate" else CONF
    with initialize_config_dir(str(folder), version_base="1.3"):
        return compose(config, list(overrides))


SMALL = (
    "data=random", "data.num_transitions=600", "data.held_out=0.1",
    "network.num_cells=[8]", "trainer.batch_size=8",
    "trainer.inverse_dynamics_steps=10", "trainer.log_interval=1",
    "trainer.eval_episodes=1", "trainer.progress=false",
)  # fmt: skip
"""Overrides of a run of a second."""
