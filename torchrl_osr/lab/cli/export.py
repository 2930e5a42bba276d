"""Write a trained policy to one file, and check the file against the policy.

    torchrl-osr export outputs/hopper-medium-replay/osr-seed0-... policy.safetensors
    torchrl-osr export policy.safetensors policy.onnx
    torchrl-osr export policy.safetensors value.onnx --output value

The suffix decides: .safetensors for load_policy, .onnx for ONNX Runtime, .pt2 for
torch.export. docs/deploy.md shows how to use each.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from torchrl_osr._extras import needed_by
from torchrl_osr.lab.run.load import load_run_policy
from torchrl_osr.policy import Policy, load_policy
from torchrl_osr.policy.policy import GRAPHS, SUFFIX

ROWS, TOLERANCE = 256, 1e-5
"""Random observations that a file is checked on, and its largest deviation, relative to
the larger of 1 and the number itself."""


def main() -> None:
    """Load, write and check the policy; print a summary."""
    parser = argparse.ArgumentParser(prog=sys.argv[0], description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("source", type=Path, help="a run's folder, a checkpoint, or a .safetensors")
    add("path", type=Path, help="the file to write")
    add("--output", choices=("action", "value"), default="action", help="of the graph")
    add("--trust", action="append", default=[], metavar="MODULE", help="yours")
    options = parser.parse_args()
    if options.path.suffix not in (SUFFIX, *GRAPHS):
        parser.error(f"the path must end in {SUFFIX}, {' or '.join(GRAPHS)}.")
    policy = load_run_policy(options.source, options.trust)
    if options.path.suffix == SUFFIX:
        policy.save(options.path)
    else:
        policy.export(options.path, options.output)
    deviation = check(policy, options.path, options.output)
    origin = {"env_id": "?", "step": "?"} | policy.record["source"]
    print(
        f"{options.path}: {options.path.stat().st_size:,} bytes, "
        "{loss}, {env_id}, step {step}\n".format(**origin)
        + f"largest deviation on {ROWS} observations: {deviation:.1e}"
    )


def check(policy: Policy, path: Path, output: str) -> float:
    """Return the largest deviation of a written file from the policy."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(ROWS, policy.observation_size, generator=generator)
    observation = policy.loc + policy.scale * noise
    inputs = {"observation": observation}
    wanted = policy.act(observation)
    if output == "value":
        inputs["action"], wanted = wanted, policy.value(observation)
    deviation = (read(path, output)(**inputs) - wanted).abs() / wanted.abs().clamp(1)
    largest = deviation.max().item()
    if not largest <= TOLERANCE:
        raise ValueError(
            f"{path} was written, but deviates from the policy by {largest:.1e}, more "
            f"than {TOLERANCE}: do not use it."
        )
    return largest


def read(path: Path, output: str) -> Callable[..., Tensor]:
    """Return what a written file computes, as a function of named tensors."""
    if path.suffix == SUFFIX:
        policy = load_policy(path)
        return policy.value if output == "value" else policy.act
    if path.suffix == ".pt2":
        return torch.export.load(path).module()
    with needed_by("a check of the ONNX file needs", "export"):
        import onnxruntime
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])

    def run(**inputs: Tensor) -> Tensor:
        arrays = {name: each.numpy() for name, each in inputs.items()}
        return torch.from_numpy(session.run(None, arrays)[0])

    return run
