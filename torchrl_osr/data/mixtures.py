"""Limited valuable data, section 5.3: a data set of which a share is random."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_osr.data.local import load_local_dataset


def mix_datasets(
    valuable: TensorDict, random: TensorDict, *, random_share: float, seed: int
) -> TensorDict:
    """Replace a share of the rows by rows of another data set; the number stays.

    The rows of each are drawn without replacement, and neither set is changed.

    Args:
        valuable: ``N`` transitions.
        random: at least as many as are needed of it.

    Keyword Args:
        random_share: of the ``N`` rows, rounded to whole ones.
        seed: of the choice, which has a generator of its own.

    Returns:
        ``N`` transitions: those kept of ``valuable``, then those of ``random``.

    Raises:
        ValueError: if the share is not between 0 and 1, or ``random`` is too small.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.data import mix_datasets
        >>> expert = TensorDict({"reward": torch.ones(10)}, [10])
        >>> random = TensorDict({"reward": torch.zeros(10)}, [10])
        >>> mixed = mix_datasets(expert, random, random_share=0.7, seed=0)
        >>> len(mixed), int(mixed["reward"].sum())
        (10, 3)
    """
    if not 0 <= random_share <= 1:
        raise ValueError(f"random_share must be in [0, 1], got {random_share}.")
    number = round(random_share * len(valuable))
    if number > len(random):
        raise ValueError(
            f"random_share={random_share} of {len(valuable)} rows is {number}, but the "
            f"random set has {len(random)}: collect more, or lower the share."
        )
    generator = torch.Generator().manual_seed(seed)
    kept = torch.randperm(len(valuable), generator=generator)[number:].sort().values
    taken = torch.randperm(len(random), generator=generator)[:number].sort().values
    mixed: TensorDict = torch.cat([valuable[kept], random[taken]])
    return mixed


def load_mixture(
    env_name: str,
    level: str,
    *,
    random_share: float,
    num_transitions: int,
    seed: int = 0,
    **options: Any,
) -> tuple[TensorDict, dict[str, Any]]:
    """Load a local data set of which a share of the rows is the level ``random``'s.

    Both sets are those of :func:`~torchrl_osr.data.load_local_dataset`, with its cache.

    Args:
        env_name: as there.
        level: of the valuable rows; the paper's is ``"expert"``.

    Keyword Args:
        random_share: the paper's are 0.5, 0.6, 0.7, 0.8 and 0.9. With 0 it is the level
            itself.
        num_transitions: rows of the mixture.
        seed: of both data sets and of the choice of their rows.
        **options: ``cache_dir`` and ``progress``.

    Returns:
        The transitions, and a manifest: ``"rows"`` of each level, the ``"sources"``'
        own manifests, and as ``"normalized_score"`` their scores' mean over the rows.
    """
    request: dict[str, Any] = {"num_transitions": num_transitions, "seed": seed}
    data, manifest = load_local_dataset(env_name, level, **request, **options)
    if random_share == 0:
        return data, manifest
    random, other = load_local_dataset(env_name, "random", **request, **options)
    data = mix_datasets(data, random, random_share=random_share, seed=seed)
    number = round(random_share * num_transitions)
    rows = {level: num_transitions - number, "random": number}
    scores = [each["normalized_score"] for each in (manifest, other)]
    # A set without a complete episode has none.
    score = None if None in scores else np.average(scores, weights=[*rows.values()])
    return data, {
        "env_name": env_name,
        "level": level,
        "random_share": random_share,
        **request,
        "rows": rows,
        "normalized_score": None if score is None else float(score),
        "sources": {level: manifest, "random": other},
    }
