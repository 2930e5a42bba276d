"""The plug-in does not know the laboratory."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "torchrl_osr"


def test_no_file_outside_the_laboratory_imports_it() -> None:
    lab, files = PACKAGE / "lab", PACKAGE.rglob("*.py")
    core = [file for file in files if not file.is_relative_to(lab)]
    imports = [
        ast.unparse(node)
        for file in core
        for node in ast.walk(ast.parse(file.read_bytes()))
        if isinstance(node, (ast.Import, ast.ImportFrom))
    ]
    assert len(core) > 20
    assert [each for each in imports if "torchrl_osr" in each and "lab" in each] == []


def test_plug_in_loads_torch_tensordict_and_torchrl_alone() -> None:
    code = """
import sys
import torchrl.envs, torchrl.trainers  # TorchRL 0.14.1 loads mujoco by itself
before = set(sys.modules)
from torchrl_osr import *
print(sorted({"gymnasium", "mujoco", "hydra", "pandas"} & (set(sys.modules) - before)))
"""
    command = [sys.executable, "-W", "ignore", "-c", code]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
