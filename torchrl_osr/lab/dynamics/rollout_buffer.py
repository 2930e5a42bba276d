"""Batches of recorded and of synthetic transitions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from itertools import accumulate, pairwise
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import OfflineToOnlineReplayBuffer, ReplayBuffer

from torchrl_osr.lab.dynamics.rollouts import Rollout


def check_real_ratio(real_ratio: float, batch_size: int) -> None:
    """Raise a ValueError unless batches have rows of both kinds."""
    real = round(real_ratio * batch_size)
    if not 0 < real < batch_size:
        raise ValueError(
            f"real_ratio={real_ratio} of {batch_size} rows are {real}; expected real "
            "and synthetic rows in each batch."
        )


class _Rows:
    """Rows to sample from, with replacement.

    TorchRL 0.14.1's ReplayBuffer and its storage refer to each other, so that every
    generation would stay in memory until the garbage collector runs.
    """

    def __init__(self, rows: TensorDictBase, rng: torch.Generator | None) -> None:
        self.rows, self.rng = rows, rng

    def __len__(self) -> int:
        return len(self.rows)

    def set_rng(self, generator: torch.Generator) -> None:
        self.rng = generator

    def sample(self, batch_size: int) -> TensorDictBase:
        device = None if self.rng is None else self.rng.device
        size = (batch_size,)
        index = torch.randint(len(self.rows), size, generator=self.rng, device=device)
        return self.rows[index]


class RolloutReplayBuffer(OfflineToOnlineReplayBuffer):
    """Mix recorded rows with roll-outs of the policy's newest copies.

    Before the first batch, and after every ``interval`` batches, a copy of the policy
    is rolled out; the last ``generations`` of roll-outs are sampled from. Each has its
    own seed and leaves torch's global generator alone. The state dict holds the
    policies instead of the rows; loading it repeats the roll-outs.

    Args:
        real: the data, a buffer without a batch size.
        policy: as it is trained.
        rollout: makes the rows of a policy, with torch's global generator as its only
            source of randomness.

    Keyword Args:
        real_ratio: share of real rows in a batch.
        batch_size: rows of a batch, the real ones first.
        interval: batches between roll-outs.
        generations: number of newest roll-outs that are kept.
        seed: of the first roll-out; the next one has the next seed.
        transform: of each batch. Default: none.
        before: called with the number of each roll-out but the first, before the
            policy is copied. Default: nothing.

    Raises:
        ValueError: batches lack real or synthetic rows; in :meth:`sample`, if a
            roll-out has no rows.
    """

    def __init__(
        self,
        real: ReplayBuffer,
        policy: nn.Module,
        rollout: Callable[[nn.Module], Rollout],
        *,
        real_ratio: float,
        batch_size: int,
        interval: int,
        generations: int,
        seed: int,
        transform: Callable[[TensorDictBase], TensorDictBase] | None = None,
        before: Callable[[int], None] | None = None,
    ) -> None:
        check_real_ratio(real_ratio, batch_size)
        super().__init__(
            real,
            online_capacity=1,
            offline_fraction=real_ratio,
            batch_size=batch_size,
            transform=transform,
        )
        self.policy, self.rollout, self.before = policy, rollout, before
        self.interval, self.generations, self.seed = interval, generations, seed
        self.num_batches = 0
        self._rng: torch.Generator | None = None
        self._copy = deepcopy(policy).requires_grad_(False)
        self._policies: list[dict[str, Any]] = []
        self._rollouts: list[Rollout] = []

    def set_rng(self, generator: torch.Generator) -> None:
        """Sample both kinds of rows with this generator."""
        self._rng = generator
        for buffer in (self._offline_buffer, self._online_buffer):
            buffer.set_rng(generator)

    def sample(self, batch_size: int | None = None) -> TensorDictBase:
        """Return a batch; roll the policy out before, if that is due."""
        if self.num_batches % self.interval == 0:
            number = self.num_batches // self.interval
            if number and self.before is not None:
                self.before(number)
            state = self.policy.state_dict()
            weights = {key: value.cpu().clone() for key, value in state.items()}
            self._policies = [*self._policies, weights][-self.generations :]
            latest = self._rolled_out(weights, number)
            self._keep([*self._rollouts, latest][-self.generations :])
        self.num_batches += 1
        return super().sample(batch_size)

    def metrics(self) -> dict[str, float]:
        """Return the share of rejected rows, and of the others that end the task."""
        rejected = sum(each.num_rejected for each in self._rollouts)
        following = self.synthetic["next"]
        return {
            "rollout_rejected": rejected / (rejected + len(following)),
            "rollout_terminated": following["terminated"].float().mean().item(),
            "rollout_reward": following["reward"].mean().item(),
        }

    def _rolled_out(self, weights: Mapping[str, Any], number: int) -> Rollout:
        self._copy.load_state_dict(weights)
        device = next(self._copy.parameters()).device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(self.seed + number)
            found = self.rollout(self._copy)
        if not len(found.rows):
            raise ValueError(
                "The model rejects all rows of a roll-out. Train it longer "
                "(dynamics.steps), or keep them (dynamics.unknown=take)."
            )
        return found

    def _keep(self, rollouts: list[Rollout]) -> None:
        """Sample from these rows, in their order."""
        rows = torch.cat([each.rows for each in rollouts])
        ends = [0, *accumulate(len(each.rows) for each in rollouts)]
        self._rollouts = [  # of slices, so that rows are in memory once
            Rollout(rows[start:end], each.num_rejected)
            for (start, end), each in zip(pairwise(ends), rollouts, strict=True)
        ]
        self._online_buffer = _Rows(rows, self._rng)

    @property
    def synthetic(self) -> TensorDictBase:
        """All rows of the roll-outs, oldest first, ``[n]``."""
        return self._online_buffer.rows

    def state_dict(self) -> dict[str, Any]:
        """Return the number of batches and the policies that were rolled out."""
        return {"num_batches": self.num_batches, "policies": self._policies}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Repeat the roll-outs of a state."""
        self.num_batches = state_dict["num_batches"]
        self._policies = list(state_dict["policies"])
        following = -(-self.num_batches // self.interval)  # rounded up
        numbers = range(following - len(self._policies), following)
        if self._policies:
            self._keep(list(map(self._rolled_out, self._policies, numbers)))
