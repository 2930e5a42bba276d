"""OSR in TorchRL's own trainer, and the example with it."""

from __future__ import annotations

import json

import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from torchrl_osr.lab.data import make_replay_buffer
from torchrl_osr.trainers import ReplayBufferCollector


def test_a_buffers_batches_are_a_collectors_frames() -> None:
    data = TensorDict({"row": torch.arange(50.0)}, [50])

    def make(seed: int = 7) -> ReplayBufferCollector:
        buffer = make_replay_buffer(data, batch_size=5, seed=0)
        collector = ReplayBufferCollector(buffer, total_frames=20)
        assert collector.set_seed(seed) == seed
        return collector

    whole, other = (torch.stack([b["row"] for b in make(seed)]) for seed in (7, 8))
    assert whole.shape == (4, 5)
    assert not torch.equal(whole, other)
    first, second = make(), make()
    draws = iter(first)
    assert torch.equal(torch.stack([next(draws)["row"] for _ in range(2)]), whole[:2])
    second.load_state_dict(first.state_dict())
    assert torch.equal(torch.stack([batch["row"] for batch in second]), whole[2:])


def test_the_example_trains_on_real_data(tmp_path, run) -> None:
    code, printed = run(
        tmp_path,
        "torchrl_trainer.py",
        *("data=random", "num_transitions=500", "steps=6", "batch_size=16"),
        *("inverse_dynamics_steps=4", "episodes=1", "trainer.progress_bar=false"),
        *("loss.recovery_weight=0.75", f"hydra.run.dir={tmp_path}"),
    )
    assert code == 0, printed
    assert "never trained" not in printed
    result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert result["steps"] == 6
    assert len(result["returns"]) == 1
    written = OmegaConf.load(tmp_path / ".hydra" / "config.yaml")
    assert written.loss.recovery_weight == 0.75
