"""From a flat data set to what a training loop consumes.

Shapes: ``N`` rows of the data set, ``S`` observation.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, LazyTensorStorage, ReplayBuffer
from torchrl.envs.transforms import Transform

from torchrl_osr.data.disk_storage import DiskStorage
from torchrl_osr.data.on_disk import TransitionsOnDisk

# A constant observation entry would otherwise be divided by zero, and one that barely
# moves would be blown up until it drowns the others. 1e-3 is what TD3+BC adds to the
# standard deviation; as a floor it leaves all larger entries exactly unit-variance.
MIN_OBSERVATION_SCALE = 1e-3

MAX_HELD_OUT = 50_000
"""Held-out rows of a set on disk that are read into memory, at most."""


def check_memory(data: TensorDictBase, device: torch.device) -> None:
    """Raise a MemoryError unless a data set fits into a GPU, with a copy to it."""
    if device.type != "cuda":
        return
    there = data.device is not None and data.device.type == "cuda"
    needed = data.bytes() * (1 if there else 2)
    free = torch.cuda.mem_get_info(device)[0]
    # What torch keeps for the next that asks is not free to others, but to us.
    free += torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    if needed > free:
        raise MemoryError(
            f"The data set needs {needed:,} bytes on {device}, which has {free:,} "
            f"free: take fewer than {data.shape[0]:,} rows (data.num_transitions), or "
            "keep it on the CPU (trainer.device=cpu)."
        )


def make_replay_buffer(
    data: TensorDictBase | TransitionsOnDisk,
    *,
    batch_size: int,
    seed: int,
    transform: Transform | None = None,
    device: torch.device | str | None = None,
) -> ReplayBuffer:
    """Put a data set into a replay buffer that samples uniformly with replacement.

    The buffer draws from a generator of its own: the batches depend on ``seed`` alone,
    and sampling leaves torch's global generator as it was. There is no prefetching,
    because threads would make the order of the draws depend on timing.

    A plain :class:`~torchrl.data.ReplayBuffer` is used: it returns tensordicts like
    :class:`~torchrl.data.TensorDictReplayBuffer`, without the priority and index
    book-keeping that uniform sampling has no use for.

    Args:
        data: transitions ``[N]``. Those on disk stay there; a batch is read when it is
            drawn, and the same seed draws the same rows.

    Keyword Args:
        batch_size: rows per ``sample()``.
        seed: seed of the sampling generator.
        transform: applied to each sampled batch. Default: none.
        device: where the rows are stored and sampled, or, of a set on disk, where the
            batches are. Default: the device of ``data``, or CPU if it has none.

    Returns:
        A buffer that holds the ``N`` rows.

    Raises:
        ValueError: ``data`` is not flat or has no rows.
        MemoryError: it does not fit into the GPU that ``device`` is.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.data import make_replay_buffer
        >>> data = TensorDict({"observation": torch.rand(100, 3)}, batch_size=[100])
        >>> buffer = make_replay_buffer(data, batch_size=8, seed=0)
        >>> buffer.sample()["observation"].shape
        torch.Size([8, 3])
    """
    if isinstance(data, TransitionsOnDisk):
        return ReplayBuffer(
            storage=DiskStorage(data, device=device or "cpu"),
            writer=ImmutableDatasetWriter(),
            batch_size=batch_size,
            transform=transform,
            collate_fn=_as_it_is,
            generator=torch.Generator(device or "cpu").manual_seed(seed),
        )
    if data.ndim != 1 or data.shape[0] == 0:
        raise ValueError(
            f"data has batch size {list(data.shape)}; "
            "expected a flat [N] with at least one row."
        )
    device = torch.device(device or data.device or "cpu")
    check_memory(data, device)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(data.shape[0], device=device),
        batch_size=batch_size,
        transform=transform,
        generator=torch.Generator(device).manual_seed(seed),
    )
    buffer.extend(data.to(device))
    return buffer


def _as_it_is(batch: TensorDictBase) -> TensorDictBase:
    return batch


def observation_statistics(
    data: TensorDictBase | TransitionsOnDisk,
) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation of each observation entry.

    Both are accumulated in float64, since the float32 sum of a million rows loses
    digits, and returned in the type of the observations.

    Args:
        data: transitions ``[N]`` with ``observation`` ``[N, S]``. Those on disk are
            not read: both numbers were computed when they were written.

    Returns:
        ``loc`` ``[S]`` and ``scale`` ``[S]``; the scale is at least
        ``MIN_OBSERVATION_SCALE``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.data import observation_statistics
        >>> rows = torch.tensor([[1.0, 5.0], [3.0, 5.0]])
        >>> data = TensorDict({"observation": rows}, batch_size=[2])
        >>> observation_statistics(data)
        (tensor([2., 5.]), tensor([1.0000, 0.0010]))
    """
    if isinstance(data, TransitionsOnDisk):
        loc, scale = data.observation_moments()
        return loc.float(), scale.clamp_min(MIN_OBSERVATION_SCALE).float()
    observation = data.get("observation")
    scale, loc = torch.std_mean(observation.double(), dim=0, correction=0)
    scale = scale.clamp_min(MIN_OBSERVATION_SCALE)
    return loc.to(observation.dtype), scale.to(observation.dtype)


def split_held_out(
    data: TensorDict, held_out: int | float, *, seed: int
) -> tuple[TensorDict, TensorDict]:
    """Split a data set into training and held-out rows, chosen at random.

    Args:
        data: transitions ``[N]``.
        held_out: number of held-out rows (``int``), or their share (``float`` between
            0 and 1, rounded to whole rows).

    Keyword Args:
        seed: seed of the choice, which has a generator of its own.

    Returns:
        Training rows and held-out rows, each in their original order.

    Raises:
        ValueError: one of the two parts would be empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.data import split_held_out
        >>> data = TensorDict({"observation": torch.rand(10, 3)}, batch_size=[10])
        >>> train, held_out = split_held_out(data, 0.2, seed=0)
        >>> len(train), len(held_out)
        (8, 2)
    """
    rows = data.shape[0]
    mask = torch.zeros(rows, dtype=torch.bool)
    mask[_held_out_rows(rows, held_out, seed)] = True
    mask = mask.to(data.device or "cpu")
    return data[~mask], data[mask]


def split_on_disk(
    data: TransitionsOnDisk, held_out: int | float, *, seed: int
) -> tuple[TransitionsOnDisk, TensorDict]:
    """Split a set on disk as :func:`split_held_out` does one in memory.

    The training rows stay on disk: those that are held out are passed over. To choose
    them takes 8 bytes of memory a row, for a moment.

    Args:
        data: transitions ``[N]``.
        held_out: see there.

    Keyword Args:
        seed: see there; the same seed holds out the same rows.

    Returns:
        Training rows, and in memory the held-out rows, or ``MAX_HELD_OUT`` of them.

    Raises:
        ValueError: see there.
    """
    rows = _held_out_rows(len(data), held_out, seed)
    return data.without(rows.sort().values), data[rows[:MAX_HELD_OUT].sort().values]


def _held_out_rows(rows: int, held_out: int | float, seed: int) -> Tensor:
    """Return the numbers of the held-out rows, in random order."""
    count = round(held_out * rows) if isinstance(held_out, float) else held_out
    if not 0 < count < rows:
        raise ValueError(
            f"held_out={held_out!r} would hold out {count} of {rows} rows; "
            "expected at least one row on each side."
        )
    order = torch.randperm(rows, generator=torch.Generator().manual_seed(seed))
    return order[:count].clone()  # not the rest of the memory with it
