"""State recovery added to another loss: TorchRL's IQLLoss.

A point mass with data near the origin. The policy is trained with and without the
recovery term. Then its state is pushed out of the data, and its next state is
compared with the s' in the data. ``python iql_with_recovery.py [steps]``
"""

import sys

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import (
    MLP,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import IQLLoss, SoftUpdate

from torchrl_osr import InverseDynamicsLoss, StatePerturbation, StateRecoveryLoss
from torchrl_osr.modules import tanh_gaussian_inverse_dynamics

STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 100
SEEDS, PUSH, CELLS = (0, 1, 2), 1.0, [64, 64]


def move(state, action):
    """Return s' = 0.9 s + a, between walls."""
    return (0.9 * state + action).clamp(-3, 3)


def transitions(number):
    """Start all over [-1, 1]^3; a noisy controller is rewarded near the origin."""
    state = 2 * torch.rand(number, 3) - 1
    action = (-0.3 * state + 0.3 * torch.randn(number, 3)).clamp(-0.95, 0.95)
    next_state, no = move(state, action), torch.zeros(number, 1, dtype=torch.bool)
    reward = -next_state.norm(dim=-1, keepdim=True)
    data = TensorDict({"observation": state, "action": action}, [number])
    data["next"] = {"observation": next_state, "reward": reward, "done": no}
    data["next", "terminated"] = no.clone()
    return data


def train_inverse_dynamics(buffer):
    """Learn which action leads from s to s', from the true states alone.

    The default takes the perturbed ones too, as if the data's action led from there to
    the same s'. Of a push as wide as this one that is far from true.
    """
    network = tanh_gaussian_inverse_dynamics(3, 3, num_cells=CELLS)
    loss = InverseDynamicsLoss(network, states="clean")
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    for _ in range(STEPS):
        loss(buffer.sample())["loss_inverse_dynamics"].backward()
        optimizer.step()
        optimizer.zero_grad()
    return network


def train_policy(buffer, inverse_dynamics, recovery_weight):
    """Train by IQL plus the recovery term, which is nothing at weight 0."""
    head = nn.Sequential(MLP(3, 6, num_cells=CELLS), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(head, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    qvalue = ValueOperator(MLP(6, 1, num_cells=CELLS), ["observation", "action"])
    value = ValueOperator(MLP(3, 1, num_cells=CELLS), ["observation"])
    iql = IQLLoss(actor, qvalue, value, expectile=0.7, temperature=3.0)
    iql.make_value_estimator(gamma=0.9)
    updater = SoftUpdate(iql, tau=5e-3)
    recovery = StateRecoveryLoss(
        actor, inverse_dynamics, recovery_weight=recovery_weight
    )

    # Both losses hold the same actor: its parameters are among those of IQL.
    optimizer = torch.optim.Adam(iql.parameters(), lr=1e-3)
    for _ in range(STEPS):
        batch = buffer.sample()
        losses = {**iql(batch), **recovery(batch)}
        terms = [value for key, value in losses.items() if key.startswith("loss_")]
        sum(terms).backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()
    return actor


@torch.no_grad()
def distance(actor, data, push):
    """Mean distance between the policy's next state from a pushed state and s'."""
    state = data["observation"] + push
    policy = actor.get_dist(TensorDict({"observation": state}, data.batch_size))
    error = move(state, policy.deterministic_sample) - data["next", "observation"]
    return error.norm(dim=-1).mean().item()


results = {0.0: [], 1.0: []}
for seed in SEEDS:
    torch.manual_seed(seed)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(2000), batch_size=128)
    buffer.append_transform(StatePerturbation(std=PUSH))
    buffer.extend(transitions(2000))
    fresh, push = transitions(2000), PUSH * torch.randn(2000, 3)
    inverse_dynamics = train_inverse_dynamics(buffer)
    for weight, rows in results.items():
        torch.manual_seed(seed)
        actor = train_policy(buffer, inverse_dynamics, weight)
        rows.append([distance(actor, fresh, 0.0), distance(actor, fresh, push)])

print(f"Distance of the policy's next state from the data's, mean of seeds {SEEDS}")
for weight, rows in results.items():
    unpushed, pushed = torch.tensor(rows).mean(0).tolist()
    name = "IQL with recovery" if weight else "IQL alone"
    print(f"{name:17} from the data's state {unpushed:.2f}, pushed off it {pushed:.2f}")
