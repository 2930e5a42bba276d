"""A monitor of a run's policy, from the data of the run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_osr.lab.data.rows import episode_of
from torchrl_osr.lab.evaluation.recovery import STEPS_AFTER
from torchrl_osr.lab.run.config import read_run
from torchrl_osr.lab.run.data import load_data
from torchrl_osr.lab.run.load import run_folder_of
from torchrl_osr.policy import DataMonitor, fit_monitor


@dataclass
class MonitorConfig:
    """Options of a monitor; ``episodes`` is a log of the policy, undisturbed."""

    false_alarms: float = 0.05
    fall_steps: int = STEPS_AFTER
    episodes: str | None = None


def monitor_of_run(
    path: Path | str,
    options: MonitorConfig,
    data_path: str | None = None,
    trust: Sequence[str] = (),
) -> DataMonitor:
    """Fit a monitor to a run's data, now at ``data_path``; print what it is made of."""
    config = read_run(run_folder_of(path), trust)
    log = replace(config.data, path=data_path or config.data.path)
    env = replace(config.env, id=None)  # its bounds are known: no simulator is made
    data, _ = load_data(env, log)
    episode, counts = rows_of(data, options.fall_steps)
    if left_out := int((~counts).sum()):
        print(
            f"{left_out:,} rows in the {options.fall_steps} steps before a terminal "
            "state count as falls; if those are goals, give monitor.fall_steps=0"
        )
    rate, states = options.false_alarms, data["observation"]
    wanted = rate if options.episodes is None else None
    monitor = fit_monitor(states, episode, counts, false_alarms=wanted, seed=log.seed)
    source = "held-out episodes of the log"
    if options.episodes is not None:
        source = f"episodes of {options.episodes}"
        log = replace(
            log, source="lerobot" if log.source == "lerobot" else "file",
            path=options.episodes, num_transitions=None, checksum=None,
            random_share=0.0,
        )  # fmt: skip
        own, _ = load_data(env, log)
        about = rows_of(own, options.fall_steps)
        monitor.calibrate(own["observation"], *about, false_alarms=rate)
    print(
        f"monitor: an alarm beyond {monitor.threshold:.3g}, in at most {rate:.3g} of "
        f"episodes like the {monitor.record['episodes']:,} {source}"
    )
    return monitor


def rows_of(data: TensorDictBase, fall_steps: int) -> tuple[Tensor, Tensor]:
    """Return each row's episode, and whether no fall follows within so many steps."""
    episode, rows = episode_of(data), torch.arange(len(data))
    done, terminated = (data["next", k][:, 0] for k in ("done", "terminated"))
    last = done.nonzero()[episode, 0]  # the last row of all ends one, too
    return episode, ~(terminated[last] & (last - rows < fall_steps))
