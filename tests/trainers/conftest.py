"""What the tests of captured and compiled updates share: runs, and graphs on a CPU.

The graphs stand in for those of CUDA. What is captured is recorded operation by
operation, below autograd, and undone; a replay does the operations again on the very
tensors of the capture, without Python. What CUDA forbids raises as it would there.
"""

from __future__ import annotations

from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torchrl.modules.distributions import continuous
from torchrl.objectives import SoftUpdate

from torchrl_osr import (
    Adversary,
    InverseDynamicsLoss,
    OSRLoss,
    OSRVLoss,
    StatePerturbation,
)
from torchrl_osr.data import make_replay_buffer
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.trainers import OfflineTrainer, captured, offline

# chunk_size=None: the path that a GPU takes.
LOSSES = {
    "OSR": {"num_random": 2, "chunk_size": None},
    "OSR-v": {},
    "CQL": {"recovery_weight": 0, "with_lagrange": True, "chunk_size": None},
    "OSR-10": {"min_q_weight": 0, "deterministic_backup": False},
    "EDAC": {"min_q_weight": 0, "recovery_weight": 0, "diversity_weight": 1.0},
    "adversarial": {
        "adversary": Adversary("min_Q", "gradient", num_samples=3, num_steps=2),
        "max_q_backup": True,
        "num_random": 2,
        "chunk_size": None,
    },
}
CRITICS = {"OSR-10": 10, "EDAC": 3}


def make_data(device: str, rows: int = 64) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(rows, 3, generator=generator)
    ends = torch.arange(rows).unsqueeze(-1) % 5 == 0
    following = {
        "observation": state.roll(1, 0),
        "reward": state[:, :1].clone(),
        "done": ends,
        "terminated": ends & (torch.arange(rows).unsqueeze(-1) % 2 == 0),
    }
    action = torch.rand(rows, 2, generator=generator) - 0.5
    now = {"observation": state, "action": action, "next": following}
    return TensorDict(now, [rows]).to(device)


def build_loss(name: str, *, layer_norm: bool = False, device: str = "cpu", **options):
    """Return a small loss of a name, its networks on the device from the beginning."""
    torch.manual_seed(0)  # of all devices
    model = tanh_gaussian_inverse_dynamics(3, 2, num_cells=[8]).to(device)
    if name == "inverse dynamics":
        return InverseDynamicsLoss(model, **options)
    critics = critic_ensemble(
        3, 2, num_cells=[8], num_qvalue_nets=CRITICS.get(name, 2), layer_norm=layer_norm
    )
    actor = tanh_gaussian_actor(3, 2, num_cells=[8]).to(device)
    options = LOSSES[name] | options
    model = None if options.get("recovery_weight") == 0 else model
    kind = OSRVLoss if name == "OSR-v" else OSRLoss
    return kind(actor, [each.to(device) for each in critics], model, **options)


def build_run(folder, name="OSR", *, device="cpu", loss_options=(), **options):
    """Return a fresh trainer; two of them are the same run up to their folders."""
    loss = build_loss(name, **dict(loss_options)).to(device)
    targets = name != "inverse dynamics"
    perturbation = StatePerturbation(0.1, seed=0)
    options = {
        "total_steps": 12,
        "target_net_updater": SoftUpdate(loss, tau=0.1) if targets else None,
        "components": {"perturbation": perturbation},
        "log_interval": 4,
        "eval_interval": 6,
        "progress": False,
    } | options
    buffer = make_replay_buffer(
        make_data(device), batch_size=8, seed=0, transform=perturbation
    )
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2, fused=True)
    return OfflineTrainer(loss, optimizer, buffer, folder=folder, **options)


def state_of_run(trainer: OfflineTrainer) -> list[torch.Tensor]:
    """Return networks, optimizer and every random generator's state."""
    rows = trainer.optimizer.state_dict()["state"].values()
    tensors = [value for row in rows for value in row.values()]
    tensors += trainer.loss_module.state_dict().values()
    components = trainer.checkpoint_of_run.components
    tensors.append(components["sampler"].state_dict()["state"])
    tensors.append(components["perturbation"].get_extra_state())
    on_gpu = next(trainer.loss_module.parameters()).device.type == "cuda"
    state = torch.cuda.get_rng_state() if on_gpu else torch.get_rng_state()
    return [*tensors, state]


FORBIDDEN = {
    "_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "_unique",
    "_unique2", "unique_dim", "unique_consecutive", "bincount", "repeat_interleave",
    "lift_fresh",
}  # fmt: skip
"""Operations that wait for numbers on the host, have shapes that depend on them, or
copy numbers from the host (``lift_fresh``, as by ``torch.tensor(1.0)``)."""


class Recorder(TorchDispatchMode):
    """Notes all operations with their tensors, and what they overwrite."""

    def __init__(self, generators: list[torch.Generator]) -> None:
        super().__init__()
        self.generators = generators
        self.operations, self.overwritten = [], []

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        options = options or {}
        name = function.overloadpacket.__name__
        indices = arguments[1] if name.startswith("index") else ()
        masks = isinstance(indices, (list, tuple)) and any(
            each is not None and each.dtype == torch.bool for each in indices
        )
        if name in FORBIDDEN or masks:
            raise RuntimeError(f"operation not permitted when capturing: {name}")
        states = [each.get_state() for each in self.generators]
        for argument, value in zip(function._schema.arguments, arguments, strict=False):
            if argument.alias_info is not None and argument.alias_info.is_write:
                for each in tree_leaves(value):
                    self.overwritten.append((each, each.detach().clone()))
        out = function(*arguments, **options)
        # The dispatcher hands over another object for the same generator.
        if options.get("generator") is not None and all(
            torch.equal(each.get_state(), before)
            for each, before in zip(self.generators, states, strict=True)
        ):
            raise RuntimeError("draws from a generator that was not registered")
        self.operations.append((function, arguments, options, tree_leaves(out)))
        return out


@contextmanager
def below_autograd():
    guard = torch._C._AutoDispatchBelowAutograd()
    try:
        yield
    finally:
        del guard


class RecordedGraph:
    """Stands in for torch.cuda.CUDAGraph."""

    made: list[RecordedGraph]
    capturing = False

    def __init__(self) -> None:
        self.generators, self.replays = [torch.default_generator], 0
        self.operations = []
        self.made.append(self)

    def register_generator_state(self, generator: torch.Generator) -> None:
        self.generators.append(generator)

    @contextmanager
    def capture(self):
        recorder = Recorder(self.generators)
        states = [(each, each.get_state()) for each in self.generators]
        RecordedGraph.capturing = True
        try:
            with recorder:
                yield
        finally:
            RecordedGraph.capturing = False
            with below_autograd():
                for tensor, before in reversed(recorder.overwritten):
                    tensor.copy_(before)
            for generator, state in states:
                generator.set_state(state)
        self.operations = recorder.operations

    def replay(self) -> None:
        self.replays += 1
        with below_autograd():
            for function, arguments, options, outputs in self.operations:
                again = tree_leaves(function(*arguments, **options))
                for old, new in zip(outputs, again, strict=True):
                    if isinstance(old, torch.Tensor) and (
                        old.untyped_storage().data_ptr()
                        != new.untyped_storage().data_ptr()
                    ):
                        old.copy_(new)


class Stream:
    """Stands in for torch.cuda.Stream: a CPU does one thing after the other."""

    def __init__(self, device=None) -> None: ...

    def wait_stream(self, other) -> None: ...


@pytest.fixture
def graphs(monkeypatch) -> list[RecordedGraph]:
    """Let CUDA graphs be recorded on the CPU; return those that will be made."""
    RecordedGraph.made = []

    @contextmanager
    def stream(_):
        yield

    stand_ins = {
        "CUDAGraph": RecordedGraph,
        "Stream": Stream,
        "current_stream": Stream,
        "stream": stream,
        "graph": lambda graph, stream: graph.capture(),
        "default_generators": (torch.default_generator,),
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(torch.cuda, name, stand_in)
    # A CPU's generator cannot be replaced from within; nor need it be.
    monkeypatch.setattr(captured, "restore", torch.Generator.set_state)
    monkeypatch.setattr(offline, "check_cudagraph", lambda device: None)
    # What TorchRL's distributions ask before they read numbers.
    monkeypatch.setattr(
        continuous, "safe_is_current_stream_capturing", lambda: RecordedGraph.capturing
    )
    return RecordedGraph.made


@pytest.fixture
def runs() -> SimpleNamespace:
    """Return what makes runs and compares them."""
    return SimpleNamespace(
        make=build_run, make_loss=build_loss, make_data=make_data, state=state_of_run
    )
