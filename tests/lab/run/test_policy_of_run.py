"""The policy of a run acts as in its evaluation; no environment is made."""

from __future__ import annotations

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from untrained_run import make_run

from torchrl_osr.lab.envs import critics_of
from torchrl_osr.lab.run.policy_of_run import load_run_policy


@pytest.mark.parametrize("loss", ["osr", "td3_bc", "iql", "rebrac recovery=osr"])
def test_a_run_acts_as_in_its_evaluation(tmp_path, loss):
    folder = tmp_path / "run"
    evaluated, networks = make_run(folder, *f"loss={loss}".split())
    policy, rows = load_run_policy(folder), 2 + 3 * torch.randn(6, 11)
    actions = evaluated(rows)
    torch.testing.assert_close(policy.act(rows), actions, atol=2e-6, rtol=0)
    states = TensorDict({"observation": (rows - 2) / 3}, [6])
    values = critics_of(networks)(states, actions).amin(0)
    torch.testing.assert_close(policy.value(rows, actions), values)
    source = policy.record["source"]
    assert source["step"] == 900
    assert source["env_id"] == "Hopper-v5"
    assert source["data"]["source"] == "medium-replay"
    best = load_run_policy(folder / "checkpoint/policy/best.torchrl")
    assert best.record["source"]["step"] == 10


def test_a_run_without_critics_acts_and_has_no_values(tmp_path):
    folder, bounds = tmp_path / "run", "[-1.0,-1.0,-1.0]"
    evaluated, _ = make_run(folder, "loss=bc", f"env.action_low={bounds}")
    policy, rows = load_run_policy(folder), 2 + 3 * torch.randn(6, 11)
    torch.testing.assert_close(policy.act(rows), evaluated(rows), atol=2e-6, rtol=0)
    with pytest.raises(ValueError, match="no critics"):
        policy.value(rows)
    with pytest.raises(ValueError, match="no critics"):
        policy.export(tmp_path / "value.pt2", "value")


def test_bounds_of_the_runs_environment(tmp_path):
    folder = tmp_path / "run"
    evaluated, _ = make_run(folder)
    config = OmegaConf.load(folder / "config.yaml")
    low, high = [-2.0, 0.0, 1.0], [2.0, 3.0, 5.0]
    config.env.update({"action_low": low, "action_high": high})
    OmegaConf.save(config, folder / "config.yaml")
    rows = torch.randn(6, 11)
    low, high = torch.tensor(low), torch.tensor(high)
    wanted = low + (evaluated(rows) + 1) / 2 * (high - low)
    torch.testing.assert_close(load_run_policy(folder).act(rows), wanted)
