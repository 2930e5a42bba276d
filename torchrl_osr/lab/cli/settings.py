"""Print the settings that every method gets on a data set.

    torchrl-osr settings env=hopper data=medium-expert
    torchrl-osr settings env=walker2d loss=osr,cql preset=paper

A comparison of methods is fair if the settings that they share are equal.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from torchrl_osr.lab.evaluation.tables import aligned_columns
from torchrl_osr.lab.run import CONF
from torchrl_osr.lab.run.schema import register

KEYS = (
    *("loss.min_q_weight", "loss.num_random", "loss.recovery_weight"),
    "recovery.recovery_weight",
    *("optim.actor_lr", "optim.qvalue_lr", "optim.inverse_dynamics_lr"),
    *("dynamics.rollout_steps", "dynamics.penalty", "dynamics.adversarial_weight"),
)
"""Columns of the table. Those of ``dynamics`` are blank without a model."""


def methods() -> list[str]:
    """Return the names of all methods, the options of the group ``loss``."""
    return sorted(path.stem for path in (Path(CONF) / "loss").glob("*.yaml"))


def settings_of(config: DictConfig) -> dict[str, str]:
    """Return the values of :data:`KEYS`, blank where a method has no such key."""
    found = {key: OmegaConf.select(config, key) for key in KEYS}
    blank = () if config.dynamics.use else ("dynamics.",)
    return {
        key: "" if value is None or key.startswith(blank) else f"{value:g}"
        for key, value in found.items()
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog=sys.argv[0], description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("overrides", nargs="*", help="those of torchrl-osr train")
    overrides = parser.parse_args().overrides
    chosen = [each[5:].split(",") for each in overrides if each.startswith("loss=")]
    rest = [each for each in overrides if not each.startswith("loss=")]
    names = chosen[-1] if chosen else methods()
    short = [key.rpartition(".")[2] for key in KEYS]
    # Two keys of one name also show their groups.
    pairs = zip(short, KEYS, strict=True)
    rows = [("method", *(key if short.count(n) > 1 else n for n, key in pairs))]
    register()
    with initialize_config_dir(CONF, version_base="1.3"):
        for name in names:
            config = compose("train", [f"loss={name}", *rest])
            rows.append((name, *settings_of(config).values()))
    print("\n".join(aligned_columns(rows)))
