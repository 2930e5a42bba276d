"""Write a trained policy to one file, and check the file against the policy.

    torchrl-osr export outputs/hopper-medium-replay/osr-seed0-... policy.safetensors
    torchrl-osr export policy.safetensors policy.onnx
    torchrl-osr export policy.safetensors value.onnx --output value
    torchrl-osr export outputs/arm/osr-seed0-... policy.onnx monitor.false_alarms=0.05

The suffix decides: .safetensors for load_policy, .onnx for ONNX Runtime, .pt2 for
torch.export. docs/deploy.md shows how to use each.

Any of these adds a monitor of the distance to the run's data, with an alarm:
  monitor.false_alarms=0.05   share of undisturbed episodes with a false alarm
  monitor.fall_steps=100      steps before a terminal state that count as a fall
  monitor.episodes=FILE       log of undisturbed episodes of the policy to calibrate on
  data.path=PATH              of a log that has moved since the run
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from torch import Tensor

from torchrl_osr._checks import needed_by
from torchrl_osr.lab.run.load import load_run_policy
from torchrl_osr.lab.run.monitor import MonitorConfig, monitor_of_run
from torchrl_osr.policy import Policy, load_policy
from torchrl_osr.policy.policy import GRAPHS, SUFFIX

Outputs = tuple[Tensor, ...]

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
    add("settings", nargs="*", metavar="key=value", help="of the monitor")
    add("--output", choices=("action", "value"), default="action", help="of the graph")
    add("--trust", action="append", default=[], help="module that the run may import")
    options = parser.parse_intermixed_args()
    if options.path.suffix not in (SUFFIX, *GRAPHS):
        parser.error(f"the path must end in {SUFFIX}, {' or '.join(GRAPHS)}.")
    if options.settings and options.output == "value":
        parser.error("the monitor belongs to the action: leave out --output value.")
    options.path.parent.mkdir(parents=True, exist_ok=True)
    policy = load_run_policy(options.source, options.trust)
    if options.settings:
        known = OmegaConf.create({"monitor": MonitorConfig, "data": {"path": None}})
        OmegaConf.set_struct(known, True)
        given: Any = OmegaConf.merge(known, OmegaConf.from_dotlist(options.settings))
        own: Any = OmegaConf.to_object(given.monitor), given.data.path, options.trust
        policy.attach(monitor_of_run(options.source, *own))
    beside = options.path.with_stem(f".{options.path.stem}.new")
    if options.path.suffix == SUFFIX:
        policy.save(beside)
    else:
        policy.export(beside, options.output)
    deviation = check(policy, beside, options.output)
    beside.replace(options.path)  # an earlier file is kept until this one is checked
    origin = {"env_id": "?", "step": "?"} | policy.record["source"]
    alarm = "with a monitor" if policy.data_monitor is not None else "without a monitor"
    print(
        f"{options.path}: {options.path.stat().st_size:,} bytes, {origin['loss']}, "
        f"{origin['env_id'] or 'no simulator'}, step {origin['step']}, {alarm}\n"
        f"largest deviation on {ROWS} observations: {deviation:.1e}"
    )


def check(policy: Policy, path: Path, output: str) -> float:
    """Return the largest deviation of a written file from the policy."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(ROWS, policy.observation_size, generator=generator)
    observation = policy.loc + policy.scale * noise
    inputs = {"observation": observation}
    if output == "value":
        inputs["action"] = policy.act(observation)
    deviations: list[Tensor] = []
    found, wanted = read(path, output, inputs), outputs_of(policy, output, inputs)
    if len(wanted) > 1:  # a score is a root, which rounds where it is near 0
        found, wanted = ((act, x.square(), alarm) for act, x, alarm in (found, wanted))
    for one, other in zip(found, wanted, strict=True):
        size = other.float().abs().clamp(1)  # alarms are bool
        deviations.append(((one.float() - other.float()).abs() / size).max())
    largest = torch.stack(deviations).max().item()  # NaN, which max() would pass
    if not largest <= TOLERANCE:
        raise ValueError(
            f"{path} was written, but deviates from the policy by {largest:.1e}, more "
            f"than {TOLERANCE}: do not use it."
        )
    return largest


def outputs_of(policy: Policy, output: str, inputs: dict[str, Tensor]) -> Outputs:
    """Return what a graph of the policy computes."""
    if output == "value":
        return (policy.value(**inputs),)
    more = policy.monitor(**inputs) if policy.data_monitor is not None else ()
    return policy.act(**inputs), *more


def read(path: Path, output: str, inputs: dict[str, Tensor]) -> Outputs:
    """Return what a written file computes."""
    if path.suffix == SUFFIX:
        return outputs_of(load_policy(path), output, inputs)
    if path.suffix == ".pt2":
        found = torch.export.load(path).module()(**inputs)
        return found if isinstance(found, tuple) else (found,)
    with needed_by("a check of the ONNX file needs", "export"):
        import onnxruntime
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    arrays = {name: each.numpy() for name, each in inputs.items()}
    return tuple(map(torch.from_numpy, session.run(None, arrays)))
