"""The main example is ``torchrl-osr train`` on one page: the same bits."""

from __future__ import annotations

import pytest
from processes import files_of


@pytest.mark.parametrize("loss", ["osr", "osr_v"])
def test_it_is_the_command_on_one_page(tmp_path, run, tiny, loss):
    sizes = tiny(steps=20, eval_interval=10)
    for name in ("train", "offline_osr.py"):
        run(tmp_path, name, *sizes, f"loss={loss}", f"hydra.run.dir={name}")
    wanted = files_of(tmp_path / "train", "config.yaml")
    assert {"policy.safetensors", "returns.json", "config.yaml"} < wanted.keys()
    assert files_of(tmp_path / "offline_osr.py", "config.yaml") == wanted
    if loss == "osr":  # either continues the other's run
        more = ["resume=train", "trainer.steps=30"]
        assert "goes on from" in run(tmp_path, "offline_osr.py", *more)


def test_it_refuses_other_methods(tmp_path, run):
    output = run(tmp_path, "offline_osr.py", "loss=iql", code=1)
    assert "use torchrl-osr train" in output
