"""How much of a training step is not the update: sampling, noise, hooks, logging.

    python benchmarks/trainer_overhead.py preset=quick
    python benchmarks/trainer_overhead.py preset=paper bench.steps=50

``OfflineTrainer`` runs with CSV logging, and a clock inside it adds up the time of the
updates (loss, backward, optimizer, targets). Evaluation and checkpoints are left out:
they come by the minute, not by the step. Prints medians over the rounds, in CPU time
of one thread, which other processes disturb least.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from tensordict import TensorDict, TensorDictBase
from torchrl import torchrl_logger
from torchrl.objectives import SoftUpdate
from torchrl.record.loggers import CSVLogger

from torchrl_osr import StatePerturbation
from torchrl_osr.data import make_replay_buffer
from torchrl_osr.experiment import schema as config
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.trainers import OfflineTrainer

OBSERVATION, ACTION, ROWS = 11, 3, 100_000  # Hopper's sizes; random numbers do here


def random_data() -> TensorDict:
    """Return transitions of the right shapes."""
    no = torch.zeros(ROWS, 1, dtype=torch.bool)
    following = {
        "observation": torch.randn(ROWS, OBSERVATION),
        "reward": torch.randn(ROWS, 1),
        "done": no,
        "terminated": no.clone(),
        "truncated": no.clone(),
    }
    now = {
        "observation": torch.randn(ROWS, OBSERVATION),
        "action": torch.rand(ROWS, ACTION) * 1.8 - 0.9,
    }
    return TensorDict(now | {"next": following}, [ROWS])


def main(rounds: int, steps: int, overrides: list[str]) -> dict[str, float | str]:
    """Return the medians over the rounds."""
    torchrl_logger.setLevel("WARNING")
    config.register()
    conf = Path(__file__).resolve().parents[1] / "conf"
    with initialize_config_dir(str(conf), version_base="1.3"):
        cfg = compose("train", overrides=overrides)
    torch.set_num_threads(cfg.trainer.num_threads)
    torch.manual_seed(0)
    cells = list(cfg.network.num_cells)
    number = cfg.loss.num_qvalue_nets
    loss = instantiate(
        cfg.loss,
        tanh_gaussian_actor(OBSERVATION, ACTION, num_cells=cells),
        critic_ensemble(
            OBSERVATION,
            ACTION,
            num_qvalue_nets=number,
            num_cells=cells,
            layer_norm=cfg.network.layer_norm,
        ),
        tanh_gaussian_inverse_dynamics(OBSERVATION, ACTION, num_cells=cells),
    )
    loss.make_value_estimator(gamma=cfg.optim.gamma)
    updater = SoftUpdate(loss, tau=cfg.optim.tau)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-4, fused=True)
    buffer = make_replay_buffer(
        random_data(),
        batch_size=cfg.trainer.batch_size,
        seed=0,
        transform=StatePerturbation(cfg.perturbation.std, seed=0),
    )

    def train() -> tuple[float, float]:
        """Return the CPU seconds of the updates and of all of the training."""
        with tempfile.TemporaryDirectory() as folder:
            trainer = OfflineTrainer(
                loss,
                optimizer,
                buffer,
                total_steps=steps,
                folder=folder,
                loggers=[CSVLogger("csv", log_dir=folder)],
                log_interval=min(cfg.trainer.log_interval, steps),
                eval_interval=steps,
            )
            trainer.save_trainer = lambda force_save=False: None
            original, updating = trainer.optimization_stepper.step, 0.0

            def step(*arguments: Any) -> TensorDictBase:
                nonlocal updating
                start = time.process_time()
                losses = original(*arguments)
                updater.step()
                updating += time.process_time() - start
                return losses

            trainer.optimization_stepper.step = step
            start = time.process_time()
            trainer.train()
            return updating, time.process_time() - start

    train()  # warm-up
    times = [train() for _ in range(rounds)]
    return {
        "overrides": " ".join(overrides),
        "updates_per_cpu_second": steps / statistics.median(part for part, _ in times),
        "steps_per_cpu_second": steps / statistics.median(whole for _, whole in times),
        "share_not_update": statistics.median(
            1 - part / whole for part, whole in times
        ),
    }


if __name__ == "__main__":
    options = dict(a.split("=") for a in sys.argv[1:] if a.startswith("bench."))
    rest = [a for a in sys.argv[1:] if not a.startswith("bench.")]
    numbers = main(
        int(options.get("bench.rounds", 7)), int(options.get("bench.steps", 200)), rest
    )
    json.dump(numbers, sys.stdout, indent=1)
    print()
