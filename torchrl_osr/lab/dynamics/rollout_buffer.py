"""Batches in part of real rows, in part of rows that a model has imagined.

Shapes: ``B`` batch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from itertools import accumulate, pairwise
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import OfflineToOnlineReplayBuffer, ReplayBuffer

from torchrl_osr._checks import check_positive
from torchrl_osr.lab.dynamics.rollout import Imagined


def check_real_ratio(real_ratio: float, batch_size: int) -> None:
    """Raise a ValueError unless a batch has real rows and others."""
    real = round(real_ratio * batch_size)
    if not 0 < real < batch_size:
        raise ValueError(
            f"real_ratio={real_ratio} of {batch_size} rows are {real}; expected real "
            "and imagined rows in each batch."
        )


class _Rows:
    """Rows to draw from, with replacement.

    No ReplayBuffer: TorchRL 0.14.1's and its storage hold each other, so that every
    generation would stay in memory until the garbage collector happens to come by.
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
        index = torch.randint(len(self), size, generator=self.rng, device=device)
        return self.rows[index]


class ImaginedReplayBuffer(OfflineToOnlineReplayBuffer):
    """TorchRL's buffer of two parts, the second of which is imagined anew now and then.

    Before the first batch, and again after every ``interval`` batches, a copy of the
    policy imagines a generation of rows; the last ``generations`` of them are drawn
    from. Each has a seed of its own and leaves torch's global generator alone.

    Its state holds not the rows but the policies that have imagined them, which are
    small. Loading it imagines the same rows again, bit for bit on the same
    machine.

    Args:
        real: the data, a buffer that has no batch size of its own.
        policy: as it is trained; copied for each generation.
        rows_of: what a policy imagines, as :func:`~torchrl_osr.lab.dynamics.imagine`
            returns it, with torch's global generator as its only source of chance. The
            rows have the entries of the real ones.

    Keyword Args:
        real_ratio: share of real rows in a batch, above 0 and below 1.
        batch_size: ``B``.
        interval: batches between generations.
        generations: how many of the newest are drawn from.
        seed: of the first generation; the next one has the next seed.
        transform: applied to each batch. Default: none.
        before: called with the number of each generation but the first, 0, before the
            policy is copied. Default: nothing.

    Raises:
        ValueError: an option is out of its range, or leaves a batch without real or
            without imagined rows; in :meth:`sample`, if a generation has no rows.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_osr.lab.dynamics import Imagined, ImaginedReplayBuffer
        >>> real = ReplayBuffer(storage=LazyTensorStorage(100))
        >>> indices = real.extend(TensorDict({"state": torch.zeros(100, 1)}, [100]))
        >>> def rows_of(policy):
        ...     return Imagined(TensorDict({"state": torch.rand(9, 1) + 1}, [9]), 0)
        >>> buffer = ImaginedReplayBuffer(
        ...     real, torch.nn.Linear(1, 1), rows_of, real_ratio=0.25, batch_size=8,
        ...     interval=1000, generations=5, seed=0)
        >>> int((buffer.sample()["state"] == 0).sum())
        2
    """

    def __init__(
        self,
        real: ReplayBuffer,
        policy: nn.Module,
        rows_of: Callable[[nn.Module], Imagined],
        *,
        real_ratio: float,
        batch_size: int,
        interval: int,
        generations: int,
        seed: int,
        transform: Callable[[TensorDictBase], TensorDictBase] | None = None,
        before: Callable[[int], None] | None = None,
    ) -> None:
        check_positive("interval", interval, minimum=1)
        check_positive("generations", generations, minimum=1)
        check_real_ratio(real_ratio, batch_size)
        super().__init__(
            real,
            online_capacity=1,
            offline_fraction=real_ratio,
            batch_size=batch_size,
            transform=transform,
        )
        self.policy, self.rows_of, self.before = policy, rows_of, before
        self.interval, self.generations, self.seed = interval, generations, seed
        self.drawn = 0  # batches
        self._rng: torch.Generator | None = None
        self._copy = deepcopy(policy).requires_grad_(False)
        self._policies: list[dict[str, Any]] = []
        self._imagined: list[Imagined] = []

    def set_rng(self, generator: torch.Generator) -> None:
        """Let both parts draw their rows with this generator."""
        self._rng = generator
        for buffer in (self._offline_buffer, self._online_buffer):
            buffer.set_rng(generator)

    def sample(self, batch_size: int | None = None) -> TensorDictBase:
        """Draw a batch ``[B]``; imagine a generation before, if one is due."""
        if self.drawn % self.interval == 0:
            if self.drawn and self.before is not None:
                self.before(self.drawn // self.interval)
            state = self.policy.state_dict()
            weights = {key: value.cpu().clone() for key, value in state.items()}
            self._policies = [*self._policies, weights][-self.generations :]
            latest = self._imagine(weights, self.drawn // self.interval)
            self._hold([*self._imagined, latest][-self.generations :])
        self.drawn += 1
        return super().sample(batch_size)

    def metrics(self) -> dict[str, float]:
        """Share of refused rows, and of the others those that end; mean reward."""
        refused, rows = sum(each.refused for each in self._imagined), self.imagined
        return {
            "imagined_refused": refused / (refused + len(rows)),
            "imagined_ended": rows["next", "terminated"].float().mean().item(),
            "imagined_reward": rows["next", "reward"].mean().item(),
        }

    def _imagine(self, weights: Mapping[str, Any], number: int) -> Imagined:
        """Rows of the policy with these weights, with the seed of this generation."""
        self._copy.load_state_dict(weights)
        device = next(self._copy.parameters()).device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(self.seed + number)
            found = self.rows_of(self._copy)
        if not len(found.rows):
            raise ValueError(
                "no imagined row was taken: the model knows none of the policy's "
                "actions. Train it longer (dynamics.steps), or take its rows all the "
                "same (dynamics.unknown=take)."
            )
        return found

    def _hold(self, generations: list[Imagined]) -> None:
        """Draw from these rows, in their order."""
        rows = torch.cat([each.rows for each in generations])
        ends = [0, *accumulate(len(each.rows) for each in generations)]
        self._imagined = [  # of slices, so that rows are held once
            Imagined(rows[start:end], each.refused)
            for (start, end), each in zip(pairwise(ends), generations, strict=True)
        ]
        self._online_buffer = _Rows(rows, self._rng)

    @property
    def imagined(self) -> TensorDictBase:
        """All rows of the generations that are drawn from, oldest first, ``[n]``."""
        return self._online_buffer.rows

    def state_dict(self) -> dict[str, Any]:
        """Return the number of batches so far, and the policies of the generations."""
        return {"drawn": self.drawn, "policies": self._policies}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Imagine the rows of a saved state again, and go on from there."""
        self.drawn, self._policies = state_dict["drawn"], list(state_dict["policies"])
        following = -(-self.drawn // self.interval)  # rounded up
        first = following - len(self._policies)
        numbers = range(first, following)
        if self._policies:
            self._hold(list(map(self._imagine, self._policies, numbers)))
