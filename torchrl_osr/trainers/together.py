"""Several runs as one: scripts of a single run that are trained at once."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import suppress
from typing import Any

import torch

from torchrl_osr.trainers.member_noise import OwnRandomness
from torchrl_osr.trainers.offline import OfflineTrainer
from torchrl_osr.trainers.population import PopulationTrainer


def train_together(runs: Sequence[Generator[OfflineTrainer, None, Any]]) -> list[Any]:
    """Do several runs at once; return what they return.

    A run is a generator: what a script of one run does, but that it yields each trainer
    in the place of calling its ``train``. It may seed the global random generators and
    draw from them as if it were alone.

    Args:
        runs: with the same trainers, one after the other; see
            :class:`PopulationTrainer`. A single one is trained as ever.

    Raises:
        ValueError: if there is none, or trainers cannot be trained together.

    Examples:
        >>> def run(seed):
        ...     torch.manual_seed(seed)
        ...     trainer = make_trainer(seed)
        ...     yield trainer
        ...     return trainer.best()
        >>> train_together([run(seed) for seed in range(8)])  # doctest: +SKIP
    """
    if not runs:
        raise ValueError("A population has at least one member.")
    if len(runs) > 1 and torch.cuda.is_available():
        torch.cuda.init()  # type: ignore[no-untyped-call]  # it has a state from then on
    randomness = [OwnRandomness() for _ in runs]
    results: list[Any] = []
    try:
        while not results:
            trainers = []
            for run, own in zip(runs, randomness, strict=True):
                with own.active():
                    try:
                        trainers.append(next(run))
                    except StopIteration as end:
                        results.append(end.value)
            if results and trainers:
                raise ValueError("The runs of a population have different phases.")
            if len(trainers) == 1:
                with randomness[0].active():
                    trainers[0].train()
            elif trainers:
                PopulationTrainer(trainers, randomness).train()
    except BaseException as error:
        # Each run shall know, and write down, that and why it came to nothing.
        for run in runs:
            with suppress(BaseException):
                run.throw(error)
        raise
    return results
