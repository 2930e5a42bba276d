"""OSRLoss in place of CQLLoss, in a TorchRL user's own pipeline."""

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
from torchrl.objectives import SoftUpdate

from torchrl_osr import InverseDynamicsLoss, OSRLoss, StatePerturbation
from torchrl_osr.modules import tanh_gaussian_inverse_dynamics

# Your transitions: here 1,000 steps of s' = 0.9 s + a, rewarded near the origin.
state, action = torch.randn(1000, 3), torch.rand(1000, 3) * 1.8 - 0.9
next_state, no = 0.9 * state + action, torch.zeros(1000, 1, dtype=torch.bool)
reward = -next_state.norm(dim=-1, keepdim=True)
data = TensorDict({"observation": state, "action": action}, [1000])
data["next"] = {"observation": next_state, "reward": reward, "done": no}
data["next", "terminated"] = no.clone()

# Your buffer, with one line more: a perturbed state beside every state.
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1000), batch_size=64)
buffer.append_transform(StatePerturbation(std=1e-2))
buffer.extend(data)

# Your networks, and a model of the action that led from a state to the next.
head = nn.Sequential(MLP(in_features=3, out_features=6), NormalParamExtractor())
actor = ProbabilisticActor(
    TensorDictModule(head, ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    return_log_prob=True,
)
qvalue = ValueOperator(MLP(in_features=6, out_features=1), ["observation", "action"])
inverse_dynamics = tanh_gaussian_inverse_dynamics(3, 3, low=-1.0, high=1.0)
inverse_dynamics_loss = InverseDynamicsLoss(inverse_dynamics)
optimizer = torch.optim.Adam(inverse_dynamics_loss.parameters(), lr=3e-3)
for _ in range(200):
    inverse_dynamics_loss(buffer.sample())["loss_inverse_dynamics"].backward()
    optimizer.step()
    optimizer.zero_grad()

loss = OSRLoss(actor, qvalue, inverse_dynamics)  # was: CQLLoss(actor, qvalue)
loss.make_value_estimator(gamma=0.99)
updater = SoftUpdate(loss, tau=5e-3)
optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
for _ in range(100):
    losses = loss(buffer.sample())
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    optimizer.step()
    optimizer.zero_grad()
    updater.step()
print({key: round(value.item(), 3) for key, value in losses.items()})
