"""docs/extend.md as it is read: its files saved, its lines typed, in a new folder."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
from mktestdocs import grab_code_blocks

PAGE = (Path(__file__).parents[3] / "docs" / "extend.md").read_text(encoding="utf-8")


def save_files(folder: Path) -> None:
    """Write each block whose text before it names a file."""
    block = r"(?s)`([\w/.]+\.(?:py|yaml))`[^`]*:\n\n```\w+\n(.*?)```"
    blocks = re.findall(block, PAGE)
    names = ["my_losses.py", "conf/loss/awac.yaml", "point_mass.py"]
    assert [name for name, _ in blocks] == names
    for name, text in blocks:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")


def typed(command: str) -> list[str]:
    """Arguments of the line that begins with this command, in the page's last block."""
    block = grab_code_blocks(PAGE, lang="bash")[-1]
    (line,) = (line for line in block.splitlines() if line.startswith(command))
    return shlex.split(line)[1:]


def test_your_algorithm_in_your_environment(tmp_path, run, tiny):
    save_files(tmp_path)

    def read(command: str, *sizes: str) -> str:
        output = run(tmp_path, *typed(command), *sizes)
        assert "Warning" not in output
        return output

    # A policy of one's own, from the current folder as well.
    pilot = "import numpy\n\n\ndef act(state):\n    return numpy.sign(-state[:2])\n"
    (tmp_path / "pilot.py").write_text(pilot)
    printed = read("torchrl-osr collect", "episodes=12", "policy=pilot:act")
    assert "random.npz: 600 steps, 12 episodes" in printed
    with np.load(tmp_path / "random.npz") as columns:
        assert set(columns["action"].ravel()) == {-1.0, 1.0}
    read("torchrl-osr train", *tiny("file"))
    folder = tmp_path / "runs" / "awac"
    scalars = folder / "csv" / "scalars" / "policy"
    assert {path.stem for path in scalars.iterdir()} >= {"loss_actor", "pred_value"}
    evaluations = json.loads((folder / "returns.json").read_text())["evaluations"]
    assert evaluations[0]["returns"] != evaluations[-1]["returns"], "it learns"
    read("torchrl-osr evaluate", "suite=observation_noise", "episodes=2", "last=1")
    results = json.loads((folder / "robustness-observation_noise.json").read_text())
    assert results["env"] == "PointMass-v0"
    read("torchrl-osr report")
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "awac" in page
    assert "PointMass-v0" in page
    # One's own run is exported without trust: nothing of the modules is needed.
    for name in ("my_losses.py", "point_mass.py"):
        (tmp_path / name).unlink()
    run(tmp_path, "export", "runs/awac", "policy.pt2")
