"""Time a policy's ONNX file with and without a monitor: CPU microseconds a call.

python results/monitor/latency.py
"""

import tempfile
import time

import numpy as np
import onnxruntime
import torch

from torchrl_osr import CQLLoss
from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
from torchrl_osr.policy import fit_monitor, policy_from_loss

CALLS, ROUNDS = 300, 25

if __name__ == "__main__":
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    for size, actions, cells in ((11, 3, 128), (11, 3, 256), (17, 6, 256)):
        actor = tanh_gaussian_actor(size, actions, num_cells=[cells] * 2)
        critics = critic_ensemble(size, actions, num_cells=[cells] * 2)
        policy = policy_from_loss(CQLLoss(actor, critics))
        sessions = {}
        for name in ("alone", "monitored"):
            if name == "monitored":
                rows = torch.randn(20_000, size)
                policy.attach(fit_monitor(rows, torch.arange(20_000) // 100))
            with tempfile.TemporaryDirectory() as folder:
                policy.export(f"{folder}/policy.onnx")
                sessions[name] = onnxruntime.InferenceSession(
                    f"{folder}/policy.onnx", options, providers=["CPUExecutionProvider"]
                )
        for number in (1, 256):
            given = {"observation": torch.randn(number, size).numpy()}
            best = dict.fromkeys(sessions, np.inf)
            for _ in range(ROUNDS):
                for name, session in sessions.items():
                    start = time.process_time()
                    for _ in range(CALLS):
                        session.run(None, given)
                    took = 1e6 * (time.process_time() - start) / CALLS
                    best[name] = min(best[name], took)
            alone, monitored = best.values()
            print(
                size, cells, number, f"{alone:.1f} {monitored:.1f}", monitored / alone
            )
