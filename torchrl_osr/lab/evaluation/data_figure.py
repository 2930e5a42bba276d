"""A first picture of a data set: returns, lengths, actions, observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_osr.lab.data import sampled_observations
from torchrl_osr.lab.evaluation.drawing import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    new_figure,
    save_figure,
)

COLUMNS, MOST_PANELS = 5, 30


def data_figure(
    data: TensorDict,
    manifest: Mapping[str, Any],
    names: Mapping[str, Sequence[str]],
    path: Path | str,
    *,
    title: str,
) -> None:
    """Draw histograms of the episodes' returns and lengths and of every entry.

    Args:
        data: transitions ``[N]``.
        manifest: of the readers.
        names: of the entries of ``"observation"`` and ``"action"``.
        path: of the PNG file; one that is there is replaced.

    Keyword Args:
        title: what the data are.
    """
    low, high = (np.asarray(each) for each in manifest.get("action_bounds", (-1, 1)))
    actions: NDArray[Any] = low + (data["action"].numpy() + 1) / 2 * (high - low)
    if manifest.get("num_actions") is not None and len(names["action"]) == 1:
        actions = data["action"].numpy().argmax(1)[:, None]
    returns, lengths = (
        [*manifest.get(f"episode_{each}", []), *manifest.get(f"incomplete_{each}", [])]
        for each in ("returns", "lengths")
    )
    panels: list[tuple[str, NDArray[Any], str]] = [
        ("return of an episode", np.array(returns), GREEN),
        ("steps of an episode", np.array(lengths), GREEN),
        ("reward", data["next", "reward"][:, 0].numpy(), GREY),
    ]
    for part, values, colour in (
        ("action", actions, ORANGE),
        ("observation", sampled_observations(data).numpy(), BLUE),
    ):
        panels += [
            (name, column, colour)
            for name, column in zip(names[part], values.T, strict=True)
        ]
    shown = panels[:MOST_PANELS]
    rows = -(-len(shown) // COLUMNS)
    figure = new_figure(2.6 * COLUMNS, 2.0 * rows + 0.6, layout="constrained")
    left = len(panels) - len(shown)
    figure.suptitle(title + (f" ({left} more entries are not shown)" if left else ""))
    axes = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    for axis, (name, values, colour) in zip(axes, shown, strict=False):
        if len(values):
            axis.hist(values, bins=40, color=colour)
        axis.set_title(name, fontsize=9)
        axis.tick_params(labelsize=7)
        axis.set_yticks([])
    for axis in axes[len(shown) :]:
        axis.set_axis_off()
    save_figure(figure, path, dpi=110)
