"""Recovery by imagination with lambda-returns of long rollouts and a lower expectile.

learner.py OVERRIDES...   The imagined rows have their lambda-return as reward and end.
"""

import sys

import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType

from torchrl_osr.lab.data.transitions import DATASET_KEYS
from torchrl_osr.lab.dynamics import rollout_buffer, training
from torchrl_osr.lab.dynamics.rollouts import action_of, perturbed_starts
from torchrl_osr.lab.losses.td3 import TD3BCLoss
from torchrl_osr.objectives.actor_critic import ActorCriticLoss

LAMBDA, EXPECTILE = 0.95, 0.1
held = {}
original = training.train_dynamics


def keep_loss(options, data, loss, *args, **kwargs):
    held["loss"] = next(m for m in loss.modules() if isinstance(m, TD3BCLoss))
    return original(options, data, loss, *args, **kwargs)


training.train_dynamics = keep_loss


@torch.no_grad()
def roll_out(self, copied):
    options, data, model, loss = self.options, self.data, self.model, held["loss"]
    terminated = self.bounds["terminated"]

    def mean(state):
        return action_of(copied, state, InteractionType.DETERMINISTIC)

    index = torch.randint(len(data.storage), [options.rollout_starts])
    state = perturbed_starts(
        model,
        data.storage.get(index)["observation"],
        steps=options.perturbed_start_steps,
        **self.bounds,
    )
    steps, B = options.rollout_steps, len(state)
    seen, acts, rewards, ends, alive, nexts, values = [], [], [], [], [], [], []
    going = torch.ones(B, dtype=torch.bool)
    for _ in range(steps):
        obs = model.observed(state)
        action = mean(obs)
        scale = options.action_noise * torch.rand(B, 1)
        action = (action + scale * torch.randn_like(action)).clamp(-1, 1)
        following, reward = state.clone(), torch.zeros(B, 1)
        m, s = model.predict(state[going], action[going])
        sample = model.sample(m, s)
        following[going], reward[going] = state[going] + sample[:, :-1], sample[:, -1:]
        end = terminated(following) & going
        after = model.observed(following)
        value = loss.q(TensorDict({"observation": after}, [B]), mean(after)).amin(0)
        for list_, each in zip(
            (seen, acts, rewards, ends, alive, nexts, values),
            (obs, action, reward, end, going.clone(), after, value.view(B, 1)),
        ):
            list_.append(each)
        going = going & ~end
        state = following
        if not going.any():
            break
    T = len(seen)
    target, rows = None, []
    for t in reversed(range(T)):
        bootstrap = (
            values[t]
            if target is None
            else torch.where(
                (alive[t + 1] if t + 1 < T else going).unsqueeze(-1),
                (1 - LAMBDA) * values[t] + LAMBDA * target,
                values[t],
            )
        )
        target = rewards[t] + data.gamma * ~ends[t].unsqueeze(-1) * bootstrap
        keep = alive[t]
        true = torch.ones(int(keep.sum()), 1, dtype=torch.bool)
        after = {
            "observation": nexts[t][keep],
            "reward": target[keep],
            "done": true,
            "terminated": true.clone(),
            "truncated": ~true,
        }
        rows.append(
            TensorDict(
                {"observation": seen[t][keep], "action": acts[t][keep], "next": after},
                [len(true)],
            )
        )
    rows = torch.cat(rows).select(*DATASET_KEYS)
    if self.n_steps > 1:
        ones = torch.ones_like(rows["next", "done"], dtype=torch.long)
        rows["multi_step"] = rows["next"].copy().set("steps", ones)
    return rows


rollout_buffer.RolloutReplayBuffer.roll_out = roll_out
error_of = ActorCriticLoss.td_error


def td_error(self, batch, pred_value, target):
    _, metrics = error_of(self, batch, pred_value, target)
    difference = target - pred_value
    lower = torch.where(difference.detach() < 0, 1 - EXPECTILE, EXPECTILE) * 2
    weight = torch.where(batch.is_data, torch.ones_like(lower), lower)
    return (weight * difference.square()).sum(0), metrics


TD3BCLoss.td_error = td_error
from torchrl_osr.lab.__main__ import main  # noqa: E402

sys.argv = ["torchrl-osr", "train", *sys.argv[1:]]
main()
