"""Batches of recorded and of synthetic transitions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import InteractionType
from torch import Tensor, nn

from torchrl_osr.lab.data.rows import take_multi_step
from torchrl_osr.lab.data.transitions import DATASET_KEYS
from torchrl_osr.lab.dynamics.model_adversary import ModelAdversary
from torchrl_osr.lab.dynamics.models import DynamicsEnsemble
from torchrl_osr.lab.dynamics.options import DynamicsOptions, ModelData
from torchrl_osr.lab.dynamics.rollouts import (
    action_of,
    perturbed_starts,
    rollout,
    termination,
)


class RolloutReplayBuffer:
    """Mix recorded rows with rollouts of the policy's newest copies.

    Before the first batch, and after every ``options.rollout_interval`` batches, a copy
    of the policy is rolled out, after the adversary has trained the model. The last
    ``options.generations`` of rollouts, ``synthetic``, are sampled from. Recorded rows
    come first in a batch and may be of ``n_steps``; synthetic ones are single steps.

    Each rollout has its own seed and leaves torch's global generator alone. The state
    dict holds policies instead of rows; loading it repeats the rollouts.
    """

    def __init__(
        self,
        options: DynamicsOptions,
        data: ModelData,
        model: DynamicsEnsemble,
        actor: nn.Module,
        adversary: ModelAdversary | None = None,
        *,
        batch_size: int,
        n_steps: int,
        transform: Callable[[TensorDictBase], TensorDictBase],
    ) -> None:
        self.options, self.data, self.model = options, data, model
        self.adversary, self.n_steps = adversary, n_steps
        self.batch_size, self.transform = batch_size, transform
        self.real = data.buffer()
        # The adversary's model is copied too: a rollout must be repeatable.
        self.policy = actor if adversary is None else nn.ModuleList([actor, model])
        self.bounds = self._bounds()
        self.num_batches = 0
        self.synthetic: TensorDictBase = TensorDict({}, [0])
        self._rng: torch.Generator | None = None
        self._copy = deepcopy(self.policy).requires_grad_(False)
        self._policies: list[dict[str, Any]] = []
        self._rollouts: list[TensorDict] = []

    @torch.no_grad()
    def _bounds(self) -> dict[str, Any]:
        """Return options of :func:`rollout` for ends and for unknown rows."""
        options, data, held_out = self.options, self.data, self.data.held_out
        rule = termination(data.env_id, self.model.limits, data.loc, data.scale)
        bounds: dict[str, Any] = {"terminated": rule}
        if options.unknown == "take":
            return bounds
        mean, _ = self.model.predict(held_out["observation"], held_out["action"])
        known = self.model.disagreement(mean).quantile(options.known_share)
        bounds["max_disagreement"] = known.item()
        # An end must not be better than the data's worst rewards for ever.
        worst = held_out["next", "reward"].quantile(0.01).clamp(max=0)
        bounds["halt_reward"] = worst.item() / (1 - data.gamma)
        return bounds

    def set_rng(self, generator: torch.Generator) -> None:
        """Sample both kinds of rows with this generator."""
        self._rng = generator
        self.real.set_rng(generator)

    def sample(self) -> TensorDictBase:
        """Return a batch; roll the policy out before, if that is due."""
        options = self.options
        if self.num_batches % options.rollout_interval == 0:
            number = self.num_batches // options.rollout_interval
            if number and self.adversary is not None:
                self.adversary(number)
            state = self.policy.state_dict()
            weights = {key: value.cpu().clone() for key, value in state.items()}
            newest = slice(-options.generations, None)
            self._policies = [*self._policies, weights][newest]
            self._keep([*self._rollouts, self._repeatable(weights, number)][newest])
        self.num_batches += 1
        num_real = round(options.real_ratio * self.batch_size)
        size, rng = (self.batch_size - num_real,), self._rng
        real, device = self.real.sample(num_real), None if rng is None else rng.device
        index = torch.randint(len(self.synthetic), size, generator=rng, device=device)
        batch = self.transform(torch.cat([real, self.synthetic[index]]))
        order = torch.arange(len(batch), device=batch.device)
        batch["is_synthetic"] = order.unsqueeze(-1) >= num_real
        return take_multi_step(batch) if self.n_steps > 1 else batch

    def roll_out(self, copied: nn.Module) -> TensorDict:
        """Roll out a copy of the policy, by torch's global generator alone."""
        options, data, policy, model = self.options, self.data, copied, self.model
        if self.adversary is not None:
            policy, model = cast(tuple[nn.Module, DynamicsEnsemble], copied.children())

        def act(state: Tensor) -> Tensor:
            action = action_of(policy, state, InteractionType.RANDOM)
            if noise := options.action_noise:
                scale = noise * torch.rand(len(action), 1, device=action.device)
                action = (action + scale * torch.randn_like(action)).clamp(-1, 1)
            return action

        index = torch.randint(len(data.storage), [options.rollout_starts])
        starts: Tensor = data.storage.get(index)["observation"]
        if steps := options.perturbed_start_steps:
            starts = perturbed_starts(model, starts, steps=steps, **self.bounds)
        sizes = data.scale.expand(model.observation_dim)
        units = torch.cat([sizes, sizes.new_tensor([1 / data.reward_scale])])
        limits = self.bounds | {"steps": options.rollout_steps, "units": units}
        rows = rollout(model, act, starts, **limits)
        penalty = options.penalty * abs(data.reward_scale)
        rows["next", "reward"] -= penalty * rows["uncertainty"]
        rows = rows.select(*DATASET_KEYS)
        if self.n_steps > 1:
            ones = torch.ones_like(rows["next", "done"], dtype=torch.long)
            rows["multi_step"] = rows["next"].copy().set("steps", ones)
        return rows

    def _repeatable(self, weights: Mapping[str, Any], number: int) -> TensorDict:
        """Roll out a policy with these weights, with the seed of this number."""
        self._copy.load_state_dict(weights)
        device = next(self._copy.parameters()).device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(((self.data.seed << 20) + number) % 2**63)
            return self.roll_out(self._copy)

    def _keep(self, rollouts: list[TensorDict]) -> None:
        self.synthetic = torch.cat(rollouts)
        # Slices: the rows are in memory once.
        self._rollouts = list(self.synthetic.split([len(each) for each in rollouts]))

    def state_dict(self) -> dict[str, Any]:
        """Return the number of batches and the policies that were rolled out."""
        state = {"num_batches": self.num_batches, "policies": self._policies}
        if self.adversary is not None:
            state["adversary"] = self.adversary.state_dict()
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Repeat the rollouts of a state."""
        self.num_batches = state_dict["num_batches"]
        self._policies = list(state_dict["policies"])
        if self.adversary is not None:
            self.adversary.load_state_dict(state_dict["adversary"])
        following = -(-self.num_batches // self.options.rollout_interval)  # rounded up
        numbers = range(following - len(self._policies), following)
        if self._policies:
            self._keep(list(map(self._repeatable, self._policies, numbers)))
