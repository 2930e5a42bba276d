"""Step 1: how near OSR's gradient is to noisy cloning's, as its model is trained.

    python results/recovery/gradients.py

By proposition A (docs/method.md) the policy's gradients of the two terms are equal in
expectation once the inverse dynamics model is at its optimum. Here both are taken on
the same rows with the same noise, and compared by the cosine of their expectations:
products of sums over different chunks of rows, so that the chance of the rows does not
look like a difference. Writes ``gradients.md``.

Shapes: ``N`` rows, ``A`` action, ``C`` chunks, ``P`` parameters of the policy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from tables import table
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl_osr.data import (
    load_local_dataset,
    make_replay_buffer,
    observation_statistics,
    split_held_out,
)

from torchrl_osr import InverseDynamicsLoss, StatePerturbation, StateRecoveryLoss
from torchrl_osr._files import write_atomically
from torchrl_osr.functional import state_recovery
from torchrl_osr.modules import tanh_gaussian_actor, tanh_gaussian_inverse_dynamics

PATH = Path(__file__).parent / "gradients.md"
SYSTEMS = "hopper", "walker2d"
WIDTHS = 1e-3, 0.1
ROWS, HELD_OUT, CHUNKS = 200_000, 64_000, 64
CELLS, RATE, BATCH = [128, 128], 1e-3, 256
STEPS = 100, 1000, 10_000, 30_000
"""Updates of the model after which it is compared."""

CLONED = 0, 100, 1000
"""Updates of noisy cloning of the policies at which it is compared."""

NEAR_BOUND = 0.99
"""Rows with an action beyond it are left out of one of the comparisons."""

Value = Callable[[TensorDict], Tensor]

TITLE = """# How near OSR's gradient is to noisy cloning's

Written by `gradients.py`: `medium-expert`, 136,000 rows to train on and 64,000 others
to compare on, states standardised, noise of β standard deviations, layers of 2 x 128,
batches of 256. *all*: cosine between the expected gradients of the policy, with the
95 % interval of a jackknife over 64 chunks. *size*: of OSR's gradient, in units of the
other. *NLL*: of the model on the rows compared, in nats. *policy*, *model*: their
updates, the policy's of noisy cloning. *inside*: of rows without an action beyond 0.99.
*mean*, *scale*: through the policy's mean alone, and through its scale. *error /
variance*: the model's squared error before the tanh, of the rows compared, over the
variance that it names, 1 where it is as sure as it may be; *worst 1 %*: the share of
the squared error that one row in a hundred has."""


def trained(
    loss: nn.Module, rows: TensorDict, noise: nn.Module, stops: Sequence[int]
) -> Iterator[int]:
    """Train by a loss; stop after each number of updates."""
    buffer = make_replay_buffer(rows, batch_size=BATCH, seed=0, transform=noise)
    optimizer = torch.optim.Adam(loss.parameters(), lr=RATE)
    for update in range(max(stops) + 1):
        if update in stops:
            yield update
        out = loss(buffer.sample())
        optimizer.zero_grad()
        sum(value for key, value in out.items() if key.startswith("loss")).backward()
        optimizer.step()


def gradients(value: Value, policy: nn.Module, rows: TensorDict) -> Tensor:
    """Of the policy, on each chunk of rows, ``[C, P]``."""
    parameters = list(policy.parameters())
    found = []
    for chunk in rows.chunk(CHUNKS):
        of_chunk = torch.autograd.grad(value(chunk), parameters)
        found.append(torch.cat([each.flatten() for each in of_chunk]))
    return torch.stack(found)


def compared(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine of two expectations, and the first one's size in units of the second's.

    Of gradients on the same chunks, ``[C, P]``: a product of two expectations is a sum
    over pairs of different chunks. With the jackknife's: ``[C + 1]``, the first with
    all chunks, then without each of them.
    """

    def product(one: Tensor, other: Tensor) -> Tensor:
        pairs = one @ other.T
        pairs.fill_diagonal_(0)
        total = pairs.sum()
        return torch.cat([total[None], total - pairs.sum(0) - pairs.sum(1)])

    size, other = product(first, first), product(second, second)
    return product(first, second) / (size * other).sqrt(), (size / other).sqrt()


def told(first: Tensor, second: Tensor) -> tuple[str, str]:
    """``0.98 [0.97, 0.99]``, and the size."""
    cosine, size = compared(first.double(), second.double())
    count = len(first)
    error = ((count - 1) * cosine[1:].var(correction=0)).sqrt()
    low, high = (cosine[0] + sign * 1.96 * error for sign in (-1, 1))
    return f"{cosine[0]:.3f} [{low:.3f}, {high:.3f}]", f"{size[0]:.2f}"


def recovery(policy: Any, *model: Any, **options: Any) -> Value:
    """The package's own term, of OSR or of noisy cloning."""
    loss = StateRecoveryLoss(policy, *model, **options)

    def value(rows: TensorDict) -> Tensor:
        return loss(rows)["loss_recovery"]

    return value


def parts(policy: Any, model: Any, part: str) -> tuple[Value, Value]:
    """OSR's term and noisy cloning's through the policy's mean, or its scale, alone."""

    def held(rows: TensorDict) -> tuple[Tensor, Tensor, TensorDict]:
        state = torch.cat([rows["observation"], rows["perturbed", "observation"]])
        following = rows["next", "observation"].repeat(2, 1)
        both = {"observation": state, "next": {"observation": following}}
        batch = TensorDict(both, [len(state)])
        pi = policy.get_dist(batch)
        loc, scale = pi.loc, pi.scale
        if part == "mean":
            return loc, scale.detach(), batch
        return loc.detach(), scale, batch

    def osr(rows: TensorDict) -> Tensor:
        loc, scale, batch = held(rows)
        with torch.no_grad():
            label = model.get_dist(batch)
        return state_recovery(loc, scale, label.loc, label.scale).mean()

    def cloning(rows: TensorDict) -> Tensor:
        loc, scale, _ = held(rows)
        label = rows["action"].atanh().repeat(2, 1)
        return (((label - loc) / scale).square() / 2 + scale.log()).sum(-1).mean()

    return osr, cloning


def study(system: str, width: float) -> list[dict[str, str]]:
    """A row for each policy and each number of updates of the model."""
    data, _ = load_local_dataset(
        system, "medium-expert", num_transitions=ROWS, progress=False
    )
    data = data.select("observation", "action", "next")
    mean, std = observation_statistics(data)
    for key in ("observation", ("next", "observation")):
        data[key] = (data[key] - mean) / std
    rows, others = split_held_out(data, HELD_OUT, seed=0)
    noise = StatePerturbation(width, seed=0)
    others = StatePerturbation(width, seed=1)(others[~others["next", "done"].flatten()])
    others = others[torch.randperm(len(others), generator=torch.manual_seed(0))]
    inside = others[(others["action"].abs() < NEAR_BOUND).all(-1)]
    sizes = data["observation"].shape[-1], data["action"].shape[-1]

    torch.manual_seed(0)
    policies = {}
    policy = tanh_gaussian_actor(*sizes, num_cells=CELLS)
    cloning = StateRecoveryLoss(policy, recovery_target="data")
    for update in trained(cloning, rows, noise, CLONED):
        policies[update] = deepcopy(policy)
    model = tanh_gaussian_inverse_dynamics(*sizes, num_cells=CELLS)
    likelihood = InverseDynamicsLoss(model)
    found = []
    for update in trained(likelihood, rows, noise, STEPS):
        with torch.no_grad():
            nll = likelihood(others)["loss_inverse_dynamics"].item()
            label = model.get_dist(others)
            error = (others["action"].atanh() - label.loc).square()
            variance = label.scale.square()
            few = error.sum(-1).topk(len(error) // 100).values.sum() / error.sum()
        for cloned, policy in policies.items():
            osr = recovery(policy, model)
            data_only = recovery(policy, recovery_target="data")
            terms = {
                "all": (osr, data_only, others),
                "inside": (osr, data_only, inside),
                "mean": (*parts(policy, model, "mean"), others),
                "scale": (*parts(policy, model, "scale"), others),
            }
            row = {"data": system, "β": f"{width:g}", "policy": f"{cloned:,}"}
            row |= {"model": f"{update:,}", "NLL": f"{nll:.2f}"}
            row["error / variance"] = f"{error.sum() / variance.sum():.2f}"
            row["worst 1 %"] = f"{few:.2f}"
            for name, (first, second, each) in terms.items():
                cosine, size = told(
                    gradients(first, policy, each), gradients(second, policy, each)
                )
                row[name] = cosine
                if name == "all":
                    row["size"] = size
            found.append(row)
    return found


def main() -> None:
    """Write the table."""
    torch.set_num_threads(1)
    rows = []
    for system in SYSTEMS:
        for width in WIDTHS:
            found = study(system, width)
            rows += sorted(found, key=lambda row: len(row["policy"]))
    write_atomically(PATH, f"{TITLE}\n\n{table(rows)}\n")


if __name__ == "__main__":
    main()
