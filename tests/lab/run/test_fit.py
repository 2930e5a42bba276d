"""Training on columns in one call."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch
from composed import SMALL

from torchrl_osr.lab import fit
from torchrl_osr.lab.run.config import read_run
from torchrl_osr.lab.run.folder import read_status


def test_columns_become_a_run_that_the_same_call_continues(tmp_path):
    rng, folder = np.random.default_rng(0), tmp_path / "o'neil" / "my arm"
    states = [f"obs_{number}" for number in range(11)]
    names = [*states[::-1], "act", "reward"]
    frame = pd.DataFrame(rng.random((60, 13)), columns=names)
    frame = frame.assign(terminated=0, episode=[f"run{row // 20}" for row in range(60)])
    frame["time"] = pd.date_range("2026-03-29", periods=60, freq="20ms", tz="CET")
    small = [each for each in SMALL if not each.startswith("data.num")][1:]
    given = "loss=td3_bc", "data.action_bounds=[-1,3]", "data.columns.step=time"
    with pytest.raises(ValueError, match=r"'act' holds other than numbers"):
        fit(frame.assign(act="left"), folder, *small, *given)
    (folder / "policy.safetensors").touch()
    with pytest.raises(FileExistsError, match="has a policy of no run: move it away"):
        fit(frame, folder, *small, *given)
    (folder / "policy.safetensors").unlink()
    with pytest.raises(ValueError, match=r"reward.*data\.missing"):
        fit({**frame, "reward": [None, *frame["reward"][1:]]}, folder, *small, *given)
    before = torch.get_rng_state(), torch.get_num_threads()
    policy = fit(frame, folder, *small, *given, "trainer.num_threads=2")
    assert torch.equal(torch.get_rng_state(), before[0])
    assert torch.get_num_threads() == before[1]
    state = np.arange(11.0)  # obs_10 comes last, as in the log
    named = dict(zip(states, state, strict=True))
    assert policy.act(named) == policy.act(state) != policy.act(state[::-1])
    assert (policy.low, policy.high) == (-1, 3)
    assert read_run(folder).env.name == "log-my-arm"
    with pytest.raises(ValueError, match=r"my arm.npz has other contents than those"):
        fit(frame.assign(reward=0.5), folder, *small, *given)
    assert read_status(folder)["status"] == "done", "it is as it was"
    again = fit(frame, folder, *small, *given)  # its columns are still there
    assert again.act(state) == policy.act(state)
