"""The constraint of OSR-v by itself, at a state without data: does it come to an end?

    python results/osr_v/bound.py

A critic of one action (an MLP), a policy N(0.5, 0.3) and a model N(0, 0.1), both
squashed by tanh; nothing but the constraint of equation (8) is minimised, as printed (a
mean) and with CQL(H)'s log-sum-exp on the policy's side. The second is bounded below by
the model's entropy (Gibbs), the first by nothing. Writes ``bound.json``.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from torchrl.modules import MLP, TanhNormal

from torchrl_osr._files import write_json
from torchrl_osr.functional import value_constraint

STEPS, EVERY, ACTIONS = 3000, 100, 256


def constraint(critic: nn.Module, policy: TanhNormal, model: TanhNormal, name: str):
    """The printed gap, or with a log-sum-exp over the policy's and uniform actions."""
    ours, target = policy.sample((ACTIONS,)), model.sample((ACTIONS,))
    value, wanted = critic(ours)[:, 0], critic(target)[:, 0]
    if name == "mean":
        return value_constraint(value, wanted)
    uniform = 2 * torch.rand(ACTIONS, 1) - 1
    values = torch.cat([critic(uniform)[:, 0], value])
    density = torch.cat([torch.full((ACTIONS,), 0.5).log(), policy.log_prob(ours)])
    # Not divided by the number of actions there: two estimates of one integral.
    shift: Tensor = torch.tensor(2.0 * ACTIONS).log()
    return value_constraint(values, wanted, log_prob=density) - shift


def main() -> None:
    """Minimise both for the same number of steps."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    policy = TanhNormal(torch.tensor([0.5]), torch.tensor([0.3]), low=-1.0, high=1.0)
    model = TanhNormal(torch.tensor([0.0]), torch.tensor([0.1]), low=-1.0, high=1.0)
    curves: dict[str, list[float]] = {}
    for name in ("mean", "logsumexp"):
        critic = MLP(1, 1, num_cells=[64, 64])
        optimizer = torch.optim.Adam(critic.parameters(), lr=1e-3)
        curves[name] = []
        for step in range(STEPS + 1):
            gap = constraint(critic, policy, model, name)
            if step % EVERY == 0:
                curves[name].append(gap.item())
            optimizer.zero_grad()
            gap.backward()
            optimizer.step()
    entropy = -model.log_prob(model.sample((100_000,))).mean().item()
    found = {"every": EVERY, "curves": curves, "entropy_of_the_model": entropy}
    write_json(Path(__file__).with_name("bound.json"), found)
    for name, curve in curves.items():
        print(f"{name:10} {' '.join(f'{gap:.1f}' for gap in curve[::5])}")
    print(f"the model's entropy: {entropy:.2f}")


if __name__ == "__main__":
    main()
