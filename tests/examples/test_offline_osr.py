"""The main example is ``torchrl-osr train`` on one page: the same bits."""

from __future__ import annotations

from pathlib import Path

import pytest


def files(folder: Path) -> dict[str, bytes]:
    """Results, networks and log entries of a run."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for pattern in ("*.json", "config.yaml", "**/*.safetensors", "**/*.csv")
        for path in folder.glob(pattern)
    }


@pytest.mark.parametrize("loss", ["osr", "osr_v"])
def test_it_is_the_command_on_one_page(tmp_path, run, tiny, loss):
    sizes = tiny(steps=20, eval_interval=10)
    for name in ("train", "offline_osr.py"):
        given = [*sizes, f"loss={loss}", f"hydra.run.dir={name}"]
        code, output = run(tmp_path, name, *given)
        assert code == 0, output
    wanted = files(tmp_path / "train")
    assert {"policy.safetensors", "returns.json", "config.yaml"} < wanted.keys()
    assert files(tmp_path / "offline_osr.py") == wanted
    if loss == "osr":  # either continues the other's run
        more = ["resume=train", "trainer.steps=30"]
        code, output = run(tmp_path, "offline_osr.py", *more)
        assert code == 0, output
        assert "goes on from" in output


def test_it_refuses_other_methods(tmp_path, run):
    code, output = run(tmp_path, "offline_osr.py", "loss=iql")
    assert code == 1
    assert "use torchrl-osr train" in output
