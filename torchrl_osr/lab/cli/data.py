"""Look at data before anything is trained on them.

    torchrl-osr data data.path=log.csv env.id=Pendulum-v1
    torchrl-osr data data=minari data.path=mujoco/hopper/medium-v0

Prints what was understood (rows, episodes, ends, ranges), what looks wrong and what to
do about it, and draws a picture. The options are those of ``torchrl-osr train``, and
what that refuses is refused here. See docs/your_data.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr.lab.cli.console import single_job
from torchrl_osr.lab.data import environment_spec, load_dataset, make_environment
from torchrl_osr.lab.data.overview import (
    PARTS,
    Entry,
    actions_at_bounds,
    describe_entries,
    findings,
    out_of_space,
)
from torchrl_osr.lab.data.sources import RECORDED, open_recorded
from torchrl_osr.lab.data.store import CHUNK_ROWS, is_memmap_folder
from torchrl_osr.lab.evaluation.figures import data_figure
from torchrl_osr.lab.run import CONF
from torchrl_osr.lab.run.schema import register

MOST_ENTRIES = 40  # in the table

register()


@hydra.main(version_base="1.3", config_path=CONF, config_name="check_data")
@single_job
def main(cfg: DictConfig) -> None:
    """Read the data, print what they are, draw them; nothing else is written."""
    torchrl_logger.setLevel("ERROR")  # warnings are among the findings
    chosen: Any = OmegaConf.to_object(cfg.data)
    env_id = None if OmegaConf.is_missing(cfg.env, "id") else str(cfg.env.id)
    env_name = None if env_id is None else cfg.env.get("name")
    options = asdict(chosen)
    read = ("columns", "action_bounds", "clip_actions", "missing", "download")
    reading = {name: options[name] for name in read}
    recipe = {name: options[name] for name in ("num_transitions", "seed")}
    source, path = chosen.source, chosen.path
    files = [path] if isinstance(path, str) else path
    title = Path(files[0]).name if path else f"{env_name or 'data'} {source}"
    entries: list[Entry] = []
    try:
        if source not in RECORDED and env_id is None:
            raise ValueError(f"data={source} needs its task, as in env=hopper.")
        if source in RECORDED and path and not is_memmap_folder(files[0]):
            # As it was recorded; also of a log that is then refused.
            spec = None if env_id is None else environment_spec(env_id)
            log = open_recorded(
                source, path, spec=spec, progress=cfg.progress, **reading
            )
            names = log.about.get("columns", {})
            entries = describe_entries(log.parts(), names)
        data, manifest = load_dataset(
            str(env_name),
            source,
            env_id=env_id,
            path=path,
            progress=cfg.progress,
            on_disk=chosen.storage == "disk",
            random_share=chosen.random_share,
            **reading,
            **recipe,
        )
    except (OSError, ValueError) as error:
        if entries:
            print(entries_table(entries) + "\n")
        raise SystemExit(f"{title} cannot be trained on: {error}") from error
    entries = entries or describe_entries(own_columns(data), {})
    wrong = [*findings(data, manifest, entries)]
    if env_id is not None:
        with closing(make_environment(env_id)) as env:
            space: Any = env.observation_space
        wrong += out_of_space(entries, space.low.tolist(), space.high.tolist())
    name = (title.removesuffix(".gz").rpartition(".")[0] or title).replace(" ", "-")
    picture = Path(cfg.picture or f"{name}-data.png")
    by_part = {part: [e.name for e in entries if e.part == part] for part in PARTS}
    print(f"{title}: {overview(data, manifest, by_part['action'])}\n")
    print(entries_table(entries) + "\n")
    print("What looks wrong:" if wrong else "Nothing looks wrong.")
    for number, sentence in enumerate(wrong, 1):
        print(f"  {number}. {sentence}")
    data_figure(data, manifest, by_part, picture, title=title)
    print(f"\nPicture: {picture.absolute()}")


def own_columns(data: TensorDict) -> Iterator[Mapping[str, Any]]:
    """Columns of transitions that this package has made, some rows at a time."""
    for rows in data.split(CHUNK_ROWS):
        yield {
            "observation": rows["observation"].numpy(),
            "action": rows["action"].numpy(),
            "reward": rows["next", "reward"].numpy(),
        }


def overview(
    data: TensorDict, manifest: Mapping[str, Any], actions: Sequence[str]
) -> str:
    """Text about rows, episodes and actions."""
    dropped, ends = manifest.get("dropped_rows", 0), data["next", "done"].sum().item()
    lines = [f"{len(data) + dropped:,} rows, {ends:,} episodes"]
    if dropped:
        lines.append(
            f"  rows      {len(data):,} to train on, {dropped:,} dropped: ends of "
            "episodes without a next state"
        )
    if "unmarked_ends" in manifest:
        kinds = ("terminated", "truncated", "unmarked")
        numbers = [f"{manifest[f'{kind}_ends']:,} {kind}" for kind in kinds]
        lines.append(f"  ends      {', '.join(numbers)}")
    known = "complete" if manifest.get("episode_returns") else "incomplete"
    kept = "episode" if known == "complete" else known
    for label, key in (("length", f"{kept}_lengths"), ("return", f"{kept}_returns")):
        if values := manifest.get(key):
            mean = sum(values) / len(values)
            lines.append(
                f"  {label:<10}{mean:.5g} ({min(values):.5g} to {max(values):.5g}), "
                f"{len(values):,} {known} episodes"
            )
    known = f"discrete, {manifest.get('num_actions')}; shares of the rows"
    shares = data["action"].mean(0).tolist()
    if manifest.get("num_actions") is None:
        low, high = manifest.get("action_bounds", (-1, 1))
        known = f"{low} to {high} become -1 to 1; rows at a bound"
        shares = actions_at_bounds(data).tolist()
    else:
        actions = [str(number) for number in range(len(shares))]
    each = [f"{share:.1%} {name}" for name, share in zip(actions, shares, strict=True)]
    lines.append(f"  actions   {known}: {', '.join(each)}")
    if unused := manifest.get("unused_columns"):
        lines.append(f"  not read  {', '.join(unused)}")
    return "\n".join(lines)


def entries_table(entries: Sequence[Entry]) -> str:
    """Text table of the range of every entry, as it was recorded."""
    numbers = ("low", "mean", "high", "deviation")
    width = max(len(entry.name) for entry in entries) + 2
    head = f"  {'column':<{width}}{'part':<13}" + "".join(f"{n:>12}" for n in numbers)
    lines = [head + f"{'not finite':>12}"]
    for entry in entries[:MOST_ENTRIES]:
        cells = "".join(f"{getattr(entry, name):>12.4g}" for name in numbers)
        missing = f"{entry.missing:>12,}"
        lines.append(f"  {entry.name:<{width}}{entry.part:<13}{cells}{missing}")
    if left := len(entries) - MOST_ENTRIES:
        lines += [f"  and {left} more entries"] if left > 0 else []
    return "\n".join(lines)
