"""Evaluating runs on their data, without a simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any

import torch
from torchrl import torchrl_logger

from torchrl_osr._files import check_writable, read_json, sha256_of, write_json
from torchrl_osr.lab.data.columns import NO_REWARDS, has_rewards
from torchrl_osr.lab.dynamics import Body
from torchrl_osr.lab.evaluation import deterministic_policy, fitted_values
from torchrl_osr.lab.evaluation.grey_box import fitted_grey_box, rolled_out_values
from torchrl_osr.lab.evaluation.offline import check_discount, episode_values
from torchrl_osr.lab.evaluation.statistics import mean_of_networks
from torchrl_osr.lab.run.data import load_data
from torchrl_osr.lab.run.folder import package_versions
from torchrl_osr.lab.run.load import load_trained, run_folder_of

OFFLINE = "offline_evaluation.json"
"""Result of a run's last checkpoint, in its folder; others have a name in front."""


@dataclass
class OfflineEvaluator:
    """Estimate the values of runs' policies on the runs' data.

    A run's folder keeps the result, which the same call then returns at once. Runs on
    the same data share them, and a grey box.

    Args:
        steps, seed: of the training. Default steps: as many as it needs.
        discount: default: that of the run. A body bears longer rollouts: 0.997.
        data: place of the data, if they have been moved.
        xml, frame_skip: of the robot's :class:`~torchrl_osr.lab.dynamics.Body`, for
            rollouts in it instead of fitted Q evaluation.
        trust: modules of yours that the run may name.
    """

    steps: int | None = None
    discount: float | None = None
    seed: int = 0
    data: str | None = None
    xml: str | None = None
    frame_skip: int = 1
    trust: Sequence[str] = ()
    _known: dict[str, Any] = field(default_factory=dict, init=False)

    def __call__(self, path: Path) -> dict[str, Any]:
        """Return the estimate of a run, a folder, or of a checkpoint."""
        torchrl_logger.setLevel("WARNING")
        trained = load_trained(path, trust=self.trust)
        # Without its simulator: the run knows sizes and bounds.
        env, options = replace(trained.config.env, id=None), trained.config.data
        options.path = self.data or options.path
        gamma = trained.config.optim.gamma if self.xml is None else 0.997
        gamma = gamma if self.discount is None else self.discount
        check_discount(gamma)  # before a model is trained
        request: dict[str, Any] = {
            "versions": package_versions(),
            "checkpoint": sha256_of(trained.path),
            "data": options.checksum,
            "discount": gamma,
            "steps": self.steps,
            "seed": self.seed,
        }
        if self.xml is not None:
            request |= {"xml": sha256_of(Path(self.xml)), "frame_skip": self.frame_skip}
        parts = [path.stem] * path.is_file() + ["body"] * (self.xml is not None)
        file = run_folder_of(path) / "-".join([*parts, OFFLINE])
        if file.exists() and request.items() <= (known := read_json(file)).items():
            return known
        check_writable(file.parent)
        key = repr((env, options))  # one file may be read in several ways
        if key not in self._known:
            self._known.clear()  # before another set is in memory
            self._known[key] = load_data(env, options)
        rows, manifest = self._known[key]
        if not has_rewards(manifest):
            raise ValueError(f"{path} cannot be evaluated on its data. {NO_REWARDS}")
        policy = deterministic_policy(trained.actor, trained.observation_norm)
        torch.set_num_threads(trained.config.trainer.num_threads)
        steps = {} if self.steps is None else {"steps": self.steps}
        training: dict[str, Any] = {"seed": self.seed} | steps
        if self.xml is None:
            values = fitted_values(rows, policy, gamma=gamma, **training)
        else:
            if "box" not in self._known:
                low, high = env.action_low or -1.0, env.action_high or 1.0
                body = Body(self.xml, self.frame_skip, low=low, high=high)
                print(f"row spacing: {self.frame_skip} x {body.model.opt.timestep:g} s")
                self._known["box"] = fitted_grey_box(rows, body, **training)
            model = self._known["box"]
            values = rolled_out_values(model, rows, policy, gamma=gamma)[None]
        if not isfinite(values.sum()):
            raise ValueError(f"{path}: its estimated values are not finite numbers.")
        found = mean_of_networks(values)
        results = request | {
            "env": env.name,
            "source": options.source,
            "step": trained.step,
            "episodes": values.shape[1],
            "value": found.mean,
            "value_low": found.low,
            "value_high": found.high,
            "values": values.mean(0).tolist(),
            "data_value": episode_values(rows, gamma).mean(),
        }
        write_json(file, results)
        return results
