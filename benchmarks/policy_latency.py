"""How long one call of a trained policy takes: in this process, and as a file.

    python benchmarks/policy_latency.py            # needs torchrl-osr[export]

Policies of Hopper's sizes, untrained, for weights do not matter. Every way of calling
has its turn in each round; a round is the mean of a fifth of a second of calls. One
thread. Writes ``results/deploy/latency.json`` with every round, and prints a table of
the fastest rounds, in CPU time: whatever else runs on the machine only slows down.
"""

from __future__ import annotations

import argparse
import os
import platform
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torchrl.envs import ObservationNorm

from torchrl_osr import OSRLoss
from torchrl_osr._files import write_json
from torchrl_osr.lab.evaluation import deterministic_policy
from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
from torchrl_osr.policy import Policy, policy_from_loss

ROOT = Path(__file__).resolve().parents[1]
OUTPUT = ROOT / "results" / "deploy" / "latency.json"
SIZES = (11, 3)  # Hopper's observation and action
CELLS = [256, 256]
SECONDS = 0.2  # of calls, in a round
Call = Callable[[], object]


def networks() -> tuple[Policy, Callable[[torch.Tensor], torch.Tensor]]:
    """Return a policy, and the same as the evaluation during training calls it."""
    torch.manual_seed(0)
    actor = tanh_gaussian_actor(*SIZES, num_cells=CELLS)
    critics = critic_ensemble(*SIZES, num_cells=CELLS)
    loss = OSRLoss(actor, critics, recovery_weight=0)
    norm = ObservationNorm(
        torch.zeros(SIZES[0]),
        torch.ones(SIZES[0]),
        in_keys=["observation"],
        standard_normal=True,
    )
    return policy_from_loss(loss, norm), deterministic_policy(actor, norm)


def calls(rows: int, folder: Path) -> dict[str, Call]:
    """Return each way of calling, with its inputs ready."""
    policy, evaluation = networks()
    array = np.random.default_rng(0).normal(size=(rows, SIZES[0])).astype(np.float32)
    tensor = torch.from_numpy(array)
    action = policy.act(array)
    one = array[0] if rows == 1 else array
    ways: dict[str, Call] = {
        "evaluation's policy": lambda: evaluation(tensor),
        "policy.act, NumPy": lambda: policy.act(one),
        "policy(tensor), unchecked": torch.no_grad()(lambda: policy(tensor)),
        "policy.value, NumPy": lambda: policy.value(array, action),
    }
    for output, inputs in (
        ("action", {"observation": array}),
        ("value", {"observation": array, "action": action}),
    ):
        for suffix in (".pt2", ".onnx"):
            policy.export(folder / f"{output}{suffix}", output)
        tensors = {name: torch.from_numpy(each) for name, each in inputs.items()}
        graph = torch.export.load(folder / f"{output}.pt2").module()
        ways[f"torch.export, {output}"] = torch.no_grad()(
            lambda graph=graph, tensors=tensors: graph(**tensors)
        )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        session = onnxruntime.InferenceSession(
            folder / f"{output}.onnx", options, providers=["CPUExecutionProvider"]
        )
        ways[f"ONNX Runtime, {output}"] = lambda session=session, inputs=inputs: (
            session.run(None, inputs)
        )
    return ways


def microseconds(call: Call) -> tuple[float, float]:
    """Return the mean time of a call: wall clock, and this process's CPU time."""
    number, start, cpu = 0, time.perf_counter(), time.process_time()
    while (elapsed := time.perf_counter() - start) < SECONDS:
        for _ in range(20):
            call()
        number += 20
    return 1e6 * elapsed / number, 1e6 * (time.process_time() - cpu) / number


def main() -> None:
    """Measure, write, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=25)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    torch.set_num_threads(1)
    load = os.getloadavg()[0]
    results: dict[str, dict[str, dict[str, list[float]]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for rows in (1, 256):
            ways = calls(rows, Path(folder))
            timings = {way: {"wall": [], "cpu": []} for way in ways}
            for call in ways.values():
                microseconds(call)  # not counted: the first calls allocate
            for _ in range(options.rounds):
                for way, call in ways.items():
                    wall, cpu = microseconds(call)
                    timings[way]["wall"].append(round(wall, 2))
                    timings[way]["cpu"].append(round(cpu, 2))
            results[str(rows)] = timings
    packages = ("torch", "torchrl", "tensordict", "onnx", "onnxruntime", "numpy")
    machine = {
        "processor": platform.processor() or platform.machine(),
        "python": platform.python_version(),
        "load_average": load,
        "versions": {name: version(name) for name in packages},
    }
    settings = {"sizes": SIZES, "num_cells": CELLS, "critics": 2, "threads": 1}
    write_json(options.output, {**machine, **settings, "microseconds": results})
    print("| a call, microseconds | 1 observation | 256 observations |\n|---|---|---|")
    for way in results["1"]:
        fastest = [f"{min(results[rows][way]['cpu']):.0f}" for rows in ("1", "256")]
        print(f"| {way} | {' | '.join(fastest)} |")


if __name__ == "__main__":
    main()
