"""Configurations as the commands get them, and runs of a second in this process."""

from __future__ import annotations

from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from torchrl_osr.lab.run.build import set_sizes_from_environment
from torchrl_osr.lab.run.config import checked
from torchrl_osr.lab.run.folder import open_run
from torchrl_osr.lab.run.schema import EvaluateConfig, TrainConfig, register
from torchrl_osr.lab.run.train import train

CONF = Path(__file__).parents[1] / "conf"

SMALL = (
    "data=random", "data.num_transitions=${rolled_out:600}", "data.held_out=0.1",
    "network.num_cells=[8]", "trainer.batch_size=8",
    "trainer.inverse_dynamics_steps=10", "trainer.steps=10", "trainer.log_interval=10",
    "trainer.eval_interval=10", "trainer.eval_episodes=1",
    "trainer.checkpoint_interval=10", "trainer.progress=false",
)  # fmt: skip
"""Overrides of a run of a second."""


def composed(config: str, *overrides: str) -> DictConfig:
    """``composed("train", "seed=1")`` is what ``torchrl-osr train seed=1`` reads.

    A command has the configuration of its name; that of ``data`` is ``check_data``.
    """
    register()
    folder = CONF / "evaluation" if config == "evaluate" else CONF
    with initialize_config_dir(str(folder), version_base="1.3"):
        return compose(config, list(overrides))


def options(group: str) -> list[str]:
    """The names of a group's configurations."""
    return sorted(x.stem for x in (CONF / group).iterdir() if x.suffix == ".yaml")


def configured(*overrides: str) -> TrainConfig:
    """The checked configuration of a run, with the sizes of its environment."""
    config = checked(composed("train", *overrides))
    set_sizes_from_environment(config.env)
    return config


def evaluating(*overrides: str) -> EvaluateConfig:
    """The configuration of an evaluation."""
    return OmegaConf.to_object(composed("evaluate", "progress=false", *overrides))


def job(*overrides: str) -> DictConfig:
    """Hydra's part of a configuration, as far as a run keeps it."""
    groups = dict(each.split("=", 1) for each in overrides if "." not in each)
    choices = {"loss": groups.get("loss", "osr"), "recovery": groups.get("recovery")}
    runtime = {"choices": choices}
    return OmegaConf.create({"overrides": {"task": overrides}, "runtime": runtime})


def trained(folder: Path, *overrides: str) -> Path:
    """Train in this process as the command does, and return the run's folder."""
    given = (*SMALL, *overrides)
    with open_run(composed("train", *given), folder, job(*overrides)) as run:
        train(run)
    return folder
