"""OSR in TorchRL's own trainer, and the example with it."""

from __future__ import annotations

import json

from omegaconf import OmegaConf


def test_the_example_trains_on_real_data(tmp_path, run) -> None:
    given = (
        *("data=random", "num_transitions=500", "steps=6", "batch_size=16"),
        *("inverse_dynamics_steps=4", "episodes=1", "trainer.progress_bar=false"),
        *("loss.recovery_weight=0.75", f"hydra.run.dir={tmp_path}"),
    )
    assert "never trained" not in run(tmp_path, "torchrl_trainer.py", *given)
    result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert (result["steps"], len(result["returns"])) == (6, 1)
    written = OmegaConf.load(tmp_path / ".hydra" / "config.yaml")
    assert written.loss.recovery_weight == 0.75
