"""Check data before training; ``conf/check_data.yaml`` has the help."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr.lab.cli.console import single_job
from torchrl_osr.lab.data import make_environment
from torchrl_osr.lab.data.columns import has_rewards
from torchrl_osr.lab.data.overview import (
    actions_at_bounds,
    findings,
    out_of_space,
    recorded_columns,
)
from torchrl_osr.lab.run import CONF
from torchrl_osr.lab.run.data import load_data
from torchrl_osr.lab.run.schema import register

MOST_ENTRIES = 40  # in the table

register()


@hydra.main(version_base="1.3", config_path=CONF, config_name="check_data")
@single_job
def main(cfg: DictConfig) -> None:
    """Read the data and print a summary; write nothing."""
    torchrl_logger.setLevel("ERROR")  # warnings are among the findings
    options: Any = OmegaConf.to_object(cfg.data)
    missing = OmegaConf.is_missing(cfg.env, "id")
    env: Any = None if missing else OmegaConf.to_object(cfg.env)
    data, manifest = load_data(env, options, progress=cfg.progress)
    entries = recorded_columns(data, manifest).agg(["min", "mean", "max", "std"]).T
    wrong = [*findings(data, manifest, entries)]
    if env is not None and env.id is not None:
        with closing(make_environment(env.id)) as made:
            space: Any = made.observation_space
        wrong += out_of_space(entries, space.low.tolist(), space.high.tolist())
        if keys := getattr(space, "entries", None):
            ends = [f" -> {key}" for key in keys] + [""] * (len(entries) - len(keys))
            pairs = zip(entries.index, ends, strict=True)  # the observation comes first
            shown = [(part, f"{name}{end}") for (part, name), end in pairs]
            entries.index = entries.index.from_tuples(shown)
    files = [options.path] if isinstance(options.path, str) else options.path
    names = [Path(each).name for each in files or ()]
    title = ", ".join(names) or f"{env.name} {options.source}"
    print(f"{title}: {overview(data, manifest, entries.loc['action'].index)}\n")
    print(entries.to_string(max_rows=MOST_ENTRIES, float_format="{:.4g}".format))
    print("\nWhat looks wrong:" if wrong else "\nNothing looks wrong.")
    for number, sentence in enumerate(wrong, 1):
        print(f"  {number}. {sentence}")


def overview(
    data: TensorDict, manifest: Mapping[str, Any], actions: Sequence[str]
) -> str:
    """Return text about rows, episodes and actions."""
    dropped, ends = manifest.get("dropped_rows", 0), data["next", "done"].sum().item()
    lines = [f"{len(data) + dropped:,} rows, {ends:,} episodes"]
    if dropped:
        lines.append(
            f"rows      {len(data):,} to train on, {dropped:,} dropped: ends of "
            "episodes without a next state"
        )
    if "unmarked_ends" in manifest:
        kinds = ("terminated", "truncated", "unmarked")
        numbers = [f"{manifest[f'{kind}_ends']:,} {kind}" for kind in kinds]
        lines.append(f"ends      {', '.join(numbers)}")
    kind = "episode" if manifest.get("episode_returns") else "incomplete"
    for name in ("lengths", "returns") if has_rewards(manifest) else ("lengths",):
        if values := manifest.get(f"{kind}_{name}"):
            mean, known = sum(values) / len(values), kind.replace("episode", "complete")
            lines.append(
                f"{name:<10}{mean:.5g} ({min(values):.5g} to {max(values):.5g}), "
                f"{len(values):,} {known} episodes"
            )
    if (number := manifest.get("num_actions")) is None:
        bounds = manifest.get("action_bounds", (-1, 1))
        low, high = (np.round(bound, 4).tolist() for bound in bounds)
        what = f"{low} to {high} become -1 to 1; rows at a bound"
        shares = actions_at_bounds(data).tolist()
    else:
        what = f"discrete, {number}; shares of the rows"
        actions, shares = [*map(str, range(number))], data["action"].mean(0).tolist()
    each = [f"{share:.1%} {name}" for name, share in zip(actions, shares, strict=True)]
    lines.append(f"actions   {what}: {', '.join(each)}")
    lines += [f"{n:<10}{manifest[n]}" for n in ("steps", "text") if n in manifest]
    if unused := manifest.get("unused_columns"):
        more = "" if len(unused) <= MOST_ENTRIES else f", ... ({len(unused):,})"
        lines.append(f"not read  {', '.join(unused[:MOST_ENTRIES])}{more}")
    return "\n  ".join(lines)
