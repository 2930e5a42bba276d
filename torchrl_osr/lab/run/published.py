"""Settings that the authors of a method have told, for each of their data sets.

``conf/published/<loss>.yaml`` has a row for each data set.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from torchrl_osr.lab.run import CONF

log = logging.getLogger(__name__)

FOLDER = Path(CONF) / "published"


@functools.cache
def published_settings() -> dict[str, dict[str, Any]]:
    """Options of a loss by its name in ``conf/loss`` and by ``<env>-<data>``."""
    tables: dict[str, Any] = {
        path.stem: OmegaConf.to_container(OmegaConf.load(path))
        for path in FOLDER.glob("*.yaml")
    }
    return tables


def register_published() -> None:
    """Make each row known to Hydra, as ``<env>-<data>`` in ``published/<loss>``."""
    store = ConfigStore.instance()
    for loss, table in published_settings().items():
        for name, options in table.items():
            store.store(group=f"published/{loss}", name=name, node=options)


def check_published(cfg: DictConfig, choices: Mapping[str, str]) -> None:
    """Warn if a method's authors have published settings for other data than a run's.

    Raises:
        ValueError: if settings of another task or of other data would be taken.
    """
    if cfg.data.source != choices["data"]:
        raise ValueError(
            f"settings go by the group data={choices['data']}, and data.source="
            f"{cfg.data.source} is another: give data={cfg.data.source}."
        )
    task = f"{choices['env']}-{choices['data']}"
    own = Path(CONF) / "preset" / "for_data" / f"{choices['preset']}-{task}.yaml"
    if own.exists() and cfg.env.name != choices["env"]:
        raise ValueError(
            f"preset={choices['preset']} would take its settings for {choices['env']} "
            f"{cfg.data.source}, but env.id={cfg.env.id} is {cfg.env.name}: give "
            f"env={cfg.env.name}."
        )
    loss, name = choices["loss"], f"{cfg.env.name}-{cfg.data.source}"
    table = published_settings().get(loss)
    if table and task not in table:
        log.warning(
            f"There are no published settings of loss={loss} for {cfg.env.name} "
            f"{cfg.data.source}: its defaults are taken. {FOLDER / loss}.yaml has "
            "some."
        )
    elif table and cfg.env.name != choices["env"]:
        raise ValueError(
            f"loss={loss} would take the settings that were published for "
            f"{choices['env']}, but env.id={cfg.env.id} is {cfg.env.name}: give "
            f"env={cfg.env.name}."
        )
    known = cfg.dynamics.published
    if known and not {name, cfg.env.name} & set(known):
        taken = [
            f"dynamics.{key}={cfg.dynamics[key]}" for key in next(iter(known.values()))
        ]
        log.warning(
            f"There are no published roll-outs of loss={loss} for {name}: "
            f"{' and '.join(taken)} are taken."
        )
