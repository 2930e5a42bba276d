"""What the tests of the trainer share: a small run of any loss, and its state."""

from __future__ import annotations

import io
import zipfile
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torch.utils._pytree import tree_leaves
from torchrl.objectives import SoftUpdate

from torchrl_osr import (
    CQLLoss,
    InverseDynamicsLoss,
    OSRLoss,
    OSRVLoss,
    StatePerturbation,
)
from torchrl_osr.fast import fast_update
from torchrl_osr.lab.data import make_replay_buffer
from torchrl_osr.lab.losses import EDACLoss
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.trainers import Evaluation, OfflineTrainer

LOSSES = {
    "OSR": {"num_random": 2},
    "OSR-v": {},
    "CQL": {"target_action_gap": 0.0},
    "OSR-10": {"min_q_weight": 0, "deterministic_backup": False},
    "EDAC": {},
}
UPDATE = {
    "target_updater",
    "policy_delay",
    "policy_params",
    "autocast_dtype",
    "trace",
    "warm_up",
}
CRITICS = {"OSR-10": 10, "EDAC": 3}


def make_data(device: str, rows: int = 64) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(rows, 3, generator=generator)
    ends = torch.arange(rows).unsqueeze(-1) % 5 == 0
    next_ = {
        "observation": state.roll(1, 0),
        "reward": state[:, :1].clone(),
        "done": ends,
        "terminated": ends & (torch.arange(rows).unsqueeze(-1) % 2 == 0),
    }
    action = torch.rand(rows, 2, generator=generator) - 0.5
    now = {"observation": state, "action": action, "next": next_}
    return TensorDict(now, [rows]).to(device)


def build_loss(name: str, *, layer_norm=False, cells=8, device="cpu", **options):
    """Return a small loss of a name, its networks on the device from the beginning."""
    torch.manual_seed(0)  # of all devices
    inverse_dynamics = tanh_gaussian_inverse_dynamics(3, 2, num_cells=[cells]).to(
        device
    )
    if name == "inverse dynamics":
        return InverseDynamicsLoss(inverse_dynamics, **options)
    critics = critic_ensemble(
        3,
        2,
        num_cells=[cells],
        num_qvalue_nets=CRITICS.get(name, 2),
        layer_norm=layer_norm,
    )
    actor = tanh_gaussian_actor(3, 2, num_cells=[cells]).to(device)
    options = LOSSES[name] | options
    critics = [each.to(device) for each in critics]
    if name == "EDAC":
        return EDACLoss(actor, critics, **options)
    if name == "CQL":
        return CQLLoss(actor, critics, **options)
    kind = OSRVLoss if name == "OSR-v" else OSRLoss
    return kind(actor, critics, inverse_dynamics, **options)


def policy_params(loss) -> list[torch.nn.Parameter]:
    """What a delay of the policy is about: all but the critics."""
    critics = set(getattr(loss, "qvalue_network_params", loss).parameters())
    return [each for each in loss.parameters() if each not in critics]


def build_run(folder, name="OSR", *, device="cpu", loss_options=(), **options):
    """Return a fresh trainer; two of them are the same run up to their folders."""
    loss = build_loss(name, **dict(loss_options)).to(device)
    targets = name != "inverse dynamics"
    perturbation = StatePerturbation(0.1, seed=0)
    update = {
        "target_updater": SoftUpdate(loss, tau=0.1) if targets else None,
        "policy_params": policy_params(loss),
        "trace": False,
    }
    update |= {name: options.pop(name) for name in UPDATE & options.keys()}
    options = {
        "total_steps": 12,
        "components": {"perturbation": perturbation},
        "log_interval": 4,
        "checkpoint_interval": 6,
        "progress": False,
    } | options
    if evaluate := options.pop("evaluate", None):
        interval = options.pop("eval_interval", 6)
        options["evaluation"] = Evaluation(
            evaluate, interval, *options.pop("metric", ())
        )
    buffer = make_replay_buffer(
        make_data(device), batch_size=8, seed=0, transform=perturbation
    )
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2, fused=True)
    update = fast_update(loss, optimizer, **update)
    return OfflineTrainer(update, buffer, folder=folder, **options)


def state_of_run(trainer: OfflineTrainer) -> list[torch.Tensor]:
    """All tensors of the newest checkpoint: networks, optimizer, random generators."""
    tensors = []
    with zipfile.ZipFile(trainer.checkpoints.latest()) as archive:
        for name in sorted(archive.namelist()):
            if name.endswith("state.pt"):
                content = io.BytesIO(archive.read(name))
                state = torch.load(content, weights_only=True, map_location="cpu")
                # Nothing here seeds Python's and NumPy's generators.
                for other in ("python", "numpy"):
                    state.pop(other, None)
                tensors += [
                    each for each in tree_leaves(state) if torch.is_tensor(each)
                ]
    assert len(tensors) > 10
    return tensors


def log_of(numbers: list) -> SimpleNamespace:
    """Logger that appends name, step and value of every number."""
    return SimpleNamespace(
        log_scalar=lambda name, value, step: numbers.append((name, step, value))
    )


def assert_same_bits(mine, theirs) -> None:
    assert all(torch.equal(a, b) for a, b in zip(mine, theirs, strict=True))


@pytest.fixture
def runs() -> SimpleNamespace:
    """What makes runs and compares them."""
    return SimpleNamespace(
        make=build_run,
        make_loss=build_loss,
        make_data=make_data,
        state=state_of_run,
        log_of=log_of,
        assert_same_bits=assert_same_bits,
    )
